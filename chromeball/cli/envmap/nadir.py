"""``chromeball envmap nadir``: the hole under the tripod filled."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    parse_numbers,
    print_figures,
    read_camera,
    write_panorama,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.ground_view import Placed
    from chromeball.envmap.nadir import Hole, Lightmap
    from chromeball.envmap.picture import Radiance
    from chromeball.scene.camera import CameraModel

type Expose = Literal["auto", "keep", "white-balance"]

#: Of a hole that is left open: less is an edge that the filling closes (share).
CLOSED = 0.002


def nadir(
    env: Path,
    shot: Path | None = None,
    /,
    *,
    camera: Path | None = None,
    mask: Path | None = None,
    points: str | None = None,
    hole: str | None = None,
    patch: str | None = None,
    exposure: Expose = "auto",
    feather: float = 4.0,
    output: Out,
    json: Json = False,
) -> None:
    """Fill the hole under the tripod with a shot of the ground, or with a patch.

    The shot is held by hand, from anywhere: the ground is a plane. Channel `completed` marks
    what is filled: 4 by the shot (alpha 1), 5 by a patch (alpha 0).

    Parameters
    ----------
    env
        The map, a lat-long EXR in world axes.
    shot
        A radiance EXR of the ground, hole and surroundings; without it --patch fills all.
    camera
        The shot's calibrated camera.
    mask
        A picture of the shot's size, white where it may be used: no feet, no shadow.
    points
        Four points or more on the ground instead of features, each x,y in the shot, a colon,
        and x,y in the map: "10,20:512,480 ...".
    hole
        Degrees about the nadir, or a picture of the map's size, white in the hole; by default
        what has alpha 0 below.
    patch
        "fill" for the colours around, or a picture laid over them, as seen from above, +Z at
        its top. With a shot it fills what the shot leaves.
    exposure
        auto matches the shot's brightness to the map's around the hole, white-balance each
        channel; keep leaves it. A picture as a patch is as bright as what it covers, but with
        keep.
    feather
        Degrees over which map and shot blend outside the hole.
    output
        The map, env.exr.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.nadir import find_hole, make_patch, with_patch
    from chromeball.envmap.picture import read_latlong
    from chromeball.scene.record import Stage, check_output

    if shot is None and patch is None:
        raise UserError("give a shot of the ground, or --patch fill or a picture")
    if shot is None and any(option is not None for option in (camera, mask, points)):
        raise UserError("--camera, --mask and --points are for a shot of the ground")
    if shot is not None and camera is None:
        raise UserError("the shot needs its --camera")
    if not 0 <= feather <= 30:
        raise UserError(f"--feather {feather:g}: degrees, from 0 to 30")
    cone, area = _hole(hole)
    image_patch = Path(patch) if patch not in (None, "fill") else None
    inputs = [p for p in (env, shot, camera, mask, area, image_patch) if p is not None]
    check_output(output, inputs, ".exr")
    with Stage("envmap nadir", inputs, exposure=exposure, feather=feather) as stage:
        image = read_latlong(env)
        _check_upright(image, env)
        before = _lightmap(env, image)
        marked = None if area is None else _mask(area, image.size, env)
        found = find_hole(before.alpha, cone, marked)
        solid = before.solid_angles
        whole = float(solid[found.mask].sum())
        stage.figures |= {
            "size": image.size,
            "hole_degrees": math.degrees(found.reach),
            "hole_solid_angle": whole,
        }
        after, left = before, found.mask
        if shot is not None:
            assert camera is not None
            after = _shot(
                stage, before, found, shot, camera, mask, points, exposure, feather, env
            )
            left = found.mask & (after.alpha == 0)
            open_ = float(solid[left].sum()) / whole
            stage.figures["left_by_shot"] = open_
            if open_ > CLOSED and patch is None:
                raise UserError(
                    f"the shot leaves {100 * open_:.1f} % of the hole open: take in more of "
                    "the ground, or let --patch fill the rest",
                    file=shot,
                )
        if left.any():
            picture = None if image_patch is None else _patch(image_patch)
            filling = make_patch(after, found, left, picture, match=exposure != "keep")
            after = with_patch(after, left, filling)
        everything = max(after.energy(), 1e-300)
        stage.figures |= {
            "by_shot_solid_angle": float(solid[found.mask & ~left].sum()),
            "by_patch_solid_angle": float(solid[left].sum()),
            "light_by_shot": after.energy(found.mask & ~left) / everything,
            "light_by_patch": after.energy(left) / everything,
            "light_changed_around": (
                (after.energy(~found.mask) - before.energy(~found.mask)) / everything
            ),
            "before": before.energy(found.mask) / everything,
        }
        if image.sigma is not None:
            note = "channels sigma.R, sigma.G and sigma.B are left out: the filling has none"
            print(f"note: {note}", file=sys.stderr)
            stage.figures["notes"] = [note]
        _pictures(stage, output, before, after, found)
        kept = dict(image.attributes)
        write_panorama(
            stage,
            output,
            np.ascontiguousarray(after.radiance),
            after.alpha,
            kept,
            kept.get("origin"),
            after.completed,
            after.clipped,
        )
    print_figures(stage.figures, json, output)


def _shot(
    stage: Any,
    before: Lightmap,
    hole: Hole,
    file: Path,
    camera: Path,
    mask: Path | None,
    points: str | None,
    exposure: Expose,
    feather: float,
    env: Path,
) -> Lightmap:
    """The map with the shot in its hole, and what there is to say of it."""
    from dataclasses import replace

    import numpy as np

    from chromeball.envmap.ground_view import OnGround
    from chromeball.envmap.nadir import (
        blend_weight,
        match_light,
        seen_from_map,
        with_shot,
    )
    from chromeball.envmap.picture import read_radiance

    image = read_radiance(file)
    model = read_camera(camera, image.size, file)
    valid = image.valid
    if mask is not None:
        allowed = _mask(mask, image.size, file)
        valid = allowed if valid is None else valid & allowed
    try:
        placed = _placed(before, hole, image, valid, model, points)
        size = (before.alpha.shape[1], before.alpha.shape[0])
        mapping = OnGround(model, placed.homography).mapping()
        seen = seen_from_map(image.rgb, mapping, size, valid, image.clipped)
        usable = before.alpha > 0.999
        if exposure == "keep":
            gain, scatter, pixels = np.ones(3), None, None
        else:
            light = match_light(
                before.radiance, usable, hole, seen, channels=exposure == "white-balance"
            )
            gain, scatter, pixels = light.gain, light.scatter, light.pixels
    except UserError as error:
        raise UserError(error.what, file=error.file or file) from error
    seen = replace(seen, radiance=np.asarray(seen.radiance * gain, np.float32))
    weight = blend_weight(hole, usable, seen, math.radians(feather))
    stage.figures |= {
        "shot": file.name,
        "placed_by": "features" if points is None else "points",
        "matches": placed.matches,
        "inliers": placed.inliers,
        "residual_px": {"median": placed.residual, "rms": placed.rms},
        "edge_sigma_degrees": math.degrees(placed.sigma),
        "condition": placed.condition,
        "homography": placed.homography,
        "gain": gain,
        "ring_scatter": scatter,
        "ring_pixels": pixels,
        "energy_error": seen.energy_error,
    }
    return with_shot(before, hole, seen, weight)


def _placed(
    before: Lightmap,
    hole: Hole,
    image: Radiance,
    valid: Any,
    model: CameraModel,
    points: str | None,
) -> Placed:
    import numpy as np

    from chromeball.envmap.ground_view import place, place_by_points
    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.nadir import edge_of, look_down

    edge = edge_of(hole)
    if points is not None:
        pairs = np.array([_pair(part) for part in points.split()])
        size = (before.alpha.shape[1], before.alpha.shape[0])
        target = LatLong(size)
        world = target.unproject(pairs[:, 2:]) @ target.rotation.T
        return place_by_points(pairs[:, :2], world, model, edge)
    usable = (before.alpha > 0.999) & ~hole.mask
    view, ground, seen = look_down(before.radiance, usable, hole.view_reach)
    return place(image.rgb, model, ground, view, edge, valid=valid, seen=seen)


def _pair(text: str) -> list[float]:
    shot, colon, panorama = text.partition(":")
    if not colon:
        raise UserError(f"--points {text!r}: write each as x,y:X,Y, shot and map")
    return [*parse_numbers(shot, "--points", 2), *parse_numbers(panorama, "--points", 2)]


def _hole(text: str | None) -> tuple[float | None, Path | None]:
    """A cone in radians, or a picture."""
    if text is None:
        return None, None
    try:
        degrees = float(text)
    except ValueError:
        return None, Path(text)
    if not 0 < degrees < 90:
        raise UserError(f"--hole {text}: degrees about the nadir, above 0 and below 90")
    return math.radians(degrees), None


def _check_upright(image: Radiance, file: Path) -> None:
    import numpy as np

    from chromeball.envmap.picture import map_from_world

    if not np.allclose(map_from_world(image.attributes), np.eye(3), atol=1e-6):
        raise UserError(
            "the map is turned (worldToCamera): fill it before it is exported", file=file
        )


def _lightmap(file: Path, image: Radiance) -> Lightmap:
    """The map with its own channels for what is not seen, completed and clipped."""
    import numpy as np

    from chromeball.envmap.nadir import Lightmap
    from chromeball.scene.image import read_image

    picture = read_image(file)
    names, pixels = list(picture.channels), picture.radiance()

    def channel(name: str) -> Any:
        return np.array(pixels[..., names.index(name)], np.float32) if name in names else None

    alpha, completed = channel("A"), channel("completed")
    if alpha is None:
        alpha = np.ones((image.size[1], image.size[0]), np.float32)
    if completed is None:
        completed = np.zeros_like(alpha)
    return Lightmap(image.rgb, alpha, completed, channel("clipped"))


def _mask(path: Path, size: tuple[int, int], of: Path) -> Any:
    from chromeball.cli.envmap.arguments import read_mask

    return read_mask(path, size, of)


def _patch(path: Path) -> tuple[Any, Any]:
    """A picture in linear light and its opacity."""
    import numpy as np

    from chromeball.scene.color import srgb_decode
    from chromeball.scene.image import read_image

    image = read_image(path, straight_alpha=True)
    pixels = image.pixels.astype(np.float32)
    if not image.linear:
        pixels = pixels / np.float32(np.iinfo(image.pixels.dtype).max)
    colours = 3 if pixels.shape[2] >= 3 else 1
    opacity = np.ones(pixels.shape[:2], np.float32)
    if "A" in image.channels:
        opacity = np.ascontiguousarray(pixels[..., list(image.channels).index("A")])
    rgb = np.repeat(pixels[..., :colours], 3 // colours, axis=2)
    if not image.linear:
        rgb = srgb_decode(rgb).astype(np.float32)
    rgb = np.where(opacity[..., None] > 0, rgb, np.float32(0))
    if not np.isfinite(rgb).all() or (rgb < 0).any():
        raise UserError("the patch has pixels that are NaN, infinite or negative", file=path)
    return np.ascontiguousarray(rgb), np.clip(opacity, 0, 1)


def _pictures(stage: Any, output: Path, before: Lightmap, after: Lightmap, hole: Hole) -> None:
    """The view downwards, before and after."""
    import numpy as np

    from chromeball.envmap.nadir import look_down
    from chromeball.envmap.picture import tone_mapped, write_preview

    views = []
    for one in (before, after):
        everything = np.ones(one.alpha.shape, bool)
        views.append(look_down(one.radiance, everything, hole.view_reach, 800)[1])
    shown = tone_mapped(np.concatenate(views, axis=1), width=1600)
    stage.figures["view"] = write_preview(output, "nadir", shown)
