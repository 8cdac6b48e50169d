"""``chromeball envmap lights``: a map as light samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from chromeball.cli.envmap.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError

#: Normals over the sphere on which the lights' irradiance is compared with the map's.
_NORMALS = 162


def lights(
    env: Path,
    /,
    *,
    count: int = 64,
    depth: Path | None = None,
    method: Literal["variance-cut", "grid", "random"] = "variance-cut",
    seed: int = 0,
    ambient: bool = True,
    lamps: Path | None = None,
    rest: Path | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """A map as light samples of the same total irradiance.

    Parameters
    ----------
    env
        A lat-long map.
    count
        How many lights at most.
    depth
        A light-depth map, env_depth.exr: the lights get positions.
    method
        variance-cut (Viriyothai and Debevec 2009) is the most accurate; grid takes the bright
        cells of a grid (Pomi 2005), the dimmer of them merged into the brighter; random a
        random sub-list of those cells.
    seed
        Of the random sub-list.
    ambient
        Keep the order-2 harmonics of what the lights leave out. Without them the lights of
        grid and random are dimmer than the map, by what `total_error` says.
    lamps
        Write the map's lamps and windows as [[light]] of a scene file: with a depth at their
        places and as large as they are, else as suns. They are in lights.json, too.
    rest
        The map without those lamps, an EXR: beside it they give the map's light once.
    output
        The lights, lights.json.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.grid import grid_lights
    from chromeball.envmap.irradiance import irradiance, spread_directions
    from chromeball.envmap.lamps import as_scene_lights, find_lamps
    from chromeball.envmap.lights import variance_cut
    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.scene.image import write_exr
    from chromeball.scene.record import Stage, write_json

    if not 1 <= count <= 65536:
        raise UserError(f"--count {count}: between 1 and 65536 lights")
    if method != "variance-cut" and depth is not None:
        raise UserError("--depth is for the variance cut: cells of a grid have no one place")
    if rest is not None and lamps is None:
        raise UserError("--rest is the map without the lamps that --lamps writes")
    if seed < 0:
        raise UserError(f"--seed {seed}: it must not be negative")
    if seed and method != "random":
        raise UserError("--seed is for --method random")
    image = read_latlong(env)
    radiance, size, kept = image.rgb, image.size, image.attributes
    distance = _read_depth(depth, size) if depth is not None else None
    origin = kept.get("origin")
    if distance is not None and origin is None:
        raise UserError(
            "no attribute `origin`: positions need the probe's place; make the map with "
            "`envmap probe --align`",
            file=env,
        )
    inputs = [env, *([depth] if depth else [])]
    options = {"count": count, "method": method, "seed": seed, "ambient": ambient}
    with Stage("envmap lights", inputs, **options) as stage:
        try:
            if method == "variance-cut":
                result = variance_cut(
                    radiance,
                    count,
                    depth=distance,
                    origin=np.zeros(3) if origin is None else np.ravel(origin),
                    ambient=ambient,
                )
            else:
                pick: Literal["merged", "random"] = "merged" if method == "grid" else "random"
                result = grid_lights(radiance, count, pick=pick, seed=seed, ambient=ambient)
        except UserError as error:
            raise UserError(error.what, file=env) from error
        everywhere = spread_directions(_NORMALS)
        truth = irradiance(radiance, everywhere)
        off = result.own_irradiance(everywhere) - truth
        energy = (result.radiance * result.solid_angles[:, None]).sum(axis=0)
        scale = np.maximum(truth.max(axis=0), 1e-300)
        display = tone_mapped(radiance)
        small = LatLong((display.shape[1], display.shape[0]))
        stage.figures |= {
            "lights": len(result.directions),
            "positioned": int(np.isfinite(result.positions).all(axis=1).sum()),
            "total": result.total,
            "total_error": float(np.max(np.abs(energy / np.maximum(result.total, 1e-300) - 1))),
            "irradiance_error": float(np.sqrt(np.mean((off / scale) ** 2))),
            "preview": write_preview(
                output, "preview", _dots(display, small.pixels_of(result.directions))
            ),
        }
        value = result.to_json()
        if lamps is not None:
            found, left = find_lamps(
                radiance,
                depth=distance,
                origin=np.zeros(3) if origin is None else np.ravel(origin),
            )
            value["lamps"] = [lamp.to_json() for lamp in found]
            stage.figures["lamps"] = len(found)
            with stage.output(lamps) as temporary:
                temporary.write_text(as_scene_lights(found))
            if rest is not None:
                with stage.output(rest) as temporary:
                    write_exr(temporary, left, attributes=latlong_attributes(kept))
        with stage.output(output) as temporary:
            write_json(temporary, value)
    print_figures(stage.figures, json, output)


def _read_depth(path: Path, size: tuple[int, int]) -> Any:
    """Metres, (H, W) at `size`, the nearest sample of a light-depth map."""
    import numpy as np

    from chromeball.scene.image import read_image

    image = read_image(path)
    if "Z" not in image.channels:
        raise UserError("no channel Z: not a light-depth map", file=path)
    distance = image.pixels[..., image.channels.index("Z")].astype(np.float32)
    height, width = distance.shape
    if width != 2 * height:
        raise UserError(f"{width}x{height} is no lat-long map: it must be 2:1", file=path)
    x = (np.arange(size[0]) + 0.5) * width / size[0]
    y = (np.arange(size[1]) + 0.5) * height / size[1]
    return np.ascontiguousarray(distance[y.astype(int)[:, None], x.astype(int)[None, :]])


def _dots(display: Any, pixels: Any) -> Any:
    import cv2
    import numpy as np

    picture = np.ascontiguousarray(display)
    for x, y in np.round(pixels).astype(int):
        cv2.circle(picture, (int(x), int(y)), 3, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.circle(picture, (int(x), int(y)), 2, (255, 220, 0), -1, cv2.LINE_AA)
    return picture
