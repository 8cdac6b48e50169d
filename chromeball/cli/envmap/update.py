"""``chromeball envmap update``: a map brought up to date by frames taken later."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, print_figures, read_camera
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from chromeball.envmap.predict import Comparison, Frame
    from chromeball.envmap.several import Cast
    from chromeball.envmap.update import Change


def update(
    env: Path,
    /,
    *,
    frames: Annotated[list[Path], Parameter(consume_multiple=True)],
    cameras: Annotated[list[Path], Parameter(consume_multiple=True)],
    stand_in: Path | None = None,
    model: Literal["auto", "global", "lamps", "regions"] = "auto",
    series: bool = False,
    output: Out,
    json: Json = False,
) -> None:
    """Bring a map up to date: compare frames with what the map predicts for them.

    What moved and what is clipped is left out. The change is one factor for all light, one for
    each lamp, or one for each region: the simplest that explains the frames.

    Parameters
    ----------
    env
        A lat-long map.
    frames
        Radiance EXRs, taken with the exposure scale of the map.
    cameras
        Camera models with their poses, one a frame, or one for all.
    stand_in
        The set's geometry, stand_in.ply; without it all light is far away.
    model
        Allow this one alone.
    series
        The frames follow each other: each is explained by itself, the last one updates the
        map, and how the light drifted is written beside it.
    output
        The map as it is now, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        read_marks,
        tone_mapped,
        write_map,
        write_preview,
    )
    from chromeball.envmap.predict import compare
    from chromeball.envmap.several import ProbeMap
    from chromeball.envmap.update import find_change, ratio_map, strange
    from chromeball.scene.record import Stage, check_output

    if not frames:
        raise UserError("--frames: at least one frame is needed")
    if len(cameras) not in (1, len(frames)):
        raise UserError(
            f"{len(cameras)} cameras for {len(frames)} frames: give one camera, or one a frame"
        )
    inputs = [env, *frames, *dict.fromkeys(cameras), *([stand_in] if stand_in else [])]
    check_output(output, inputs, ".exr")
    image = read_latlong(env)
    place, cast = _place(image.attributes.get("origin"), env, stand_in)
    old = ProbeMap(image.rgb, place, image.valid)
    shots = [
        _frame(frame, cameras[k] if len(cameras) > 1 else cameras[0])
        for k, frame in enumerate(frames)
    ]
    kind = None if model == "auto" else model
    with Stage("envmap update", inputs, model=model, series=series) as stage:
        found: list[Comparison] = []
        for path, shot in zip(frames, shots, strict=True):
            try:
                found.append(compare(old, shot, cast))
            except UserError as error:
                raise UserError(error.what, file=path) from error
        moments = [[c] for c in found] if series else [found]
        changes = [find_change(old, moment, cast, kind) for moment in moments]
        change, moment = changes[-1], moments[-1]
        ratio = ratio_map(old, change, cast)
        radiance = image.rgb * ratio
        solid = LatLong(image.size).solid_angles()
        before, after = (
            np.einsum("hwc,hw->c", light, solid, dtype=np.float64)
            for light in (image.rgb, radiance)
        )
        things, unexplained = strange(moment, change)
        warnings = _warnings(moment, unexplained, change, cast is not None, place)
        stage.figures |= {
            "model": change.chosen.model.kind,
            "why": change.why,
            "factors": _factors(change),
            "condition": change.chosen.fit.condition,
            "global_factor": change.whole.s[0],
            "global_sigma": change.whole.sigma[0],
            "blocks": len(change.whole.weight),
            "left_out": float((change.chosen.fit.weight == 0).mean()),
            "energy_before": before,
            "energy": after,
            "cross_validation": [
                {"model": c.model.kind, "prior": c.model.spread, "loss": c.score}
                for c in change.tried
            ],
            "unexplained_share": unexplained,
            "unexplained": [
                {
                    "frame": frames[len(frames) - len(moment) + one.frame].name,
                    "pixel": one.pixel,
                    "direction": one.direction,
                    "seen_over_expected": one.ratio,
                    "solid_angle": one.solid_angle,
                    "energy_more": one.energy,
                }
                for one in things
            ],
            "warnings": warnings,
        }
        if series:
            table = _drift(changes, frames)
            stage.figures["drift"] = table
            csv = output.with_name(f"{output.stem}.drift.csv")
            with stage.output(csv) as temporary:
                temporary.write_text(_csv(table))
            stage.figures["drift_preview"] = _plot(table, output)
        stage.figures["preview"] = write_preview(output, "preview", tone_mapped(radiance))
        stage.figures["frame_preview"] = write_preview(
            output, "frame", _beside(moment[0], change)
        )
        marks = read_marks(env)
        for channel in "RGB":  # the change has errors of its own that no pixel's sigma holds
            marks.pop(f"sigma.{channel}", None)
        with stage.output(output) as temporary:
            write_map(temporary, radiance, marks, latlong_attributes(dict(image.attributes)))
    print_figures(stage.figures, json, output)


def _place(
    origin: Any, env: Path, stand_in: Path | None
) -> tuple[NDArray[np.float64], Cast | None]:
    """The map's place, and rays against the stand-in where it is given."""
    import numpy as np

    from chromeball.cli.envmap.geometry import caster, read_probe
    from chromeball.stand_in.ply import read_stand_in

    if stand_in is not None:
        return read_probe(env).origin, caster(read_stand_in(stand_in))
    return np.full(3, np.nan) if origin is None else np.ravel(np.asarray(origin, float)), None


def _frame(path: Path, camera: Path) -> Frame:
    import numpy as np

    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.predict import Frame

    picture = read_radiance(path)
    usable = np.ones(picture.rgb.shape[:2], bool)
    if picture.valid is not None:
        usable &= picture.valid
    if picture.clipped is not None:
        usable &= ~picture.clipped
    return Frame(picture.rgb, read_camera(camera, picture.size, path), usable)


def _factors(change: Change) -> list[dict[str, object]]:
    """Each factor with its standard error, and whether the frames show it."""
    found, model = change.chosen.fit, change.chosen.model
    rows: list[dict[str, object]] = []
    for k, name in enumerate(model.names):
        observed = bool(found.resolution[k] > 0.5)
        row: dict[str, object] = {
            "of": name,
            "factor": found.s[k],
            "sigma": found.sigma[k],
            "observed": observed,
            "decided_by_frames": float(found.resolution[k]),
        }
        if change.sources and model.kind == "lamps" and k < len(change.sources.lamps):
            row["direction"] = change.sources.lamps[k].direction
        rows.append(row)
    return rows


def _warnings(
    moment: Sequence[Comparison],
    unexplained: float,
    change: Change,
    geometry: bool,
    place: NDArray[np.float64],
) -> list[str]:
    import numpy as np

    from chromeball.envmap.predict import misplaced
    from chromeball.envmap.update import typical_error

    warnings: list[str] = []
    for k, c in enumerate(moment):
        shift = misplaced(c)
        if shift > 0.01 * max(c.frame.camera.size):
            warnings.append(
                f"frame {k + 1} lies {shift:.0f} pixels beside its prediction: was the camera "
                "moved?"
            )
        eye = c.frame.camera.world_from_camera.translation
        away = float(np.linalg.norm(eye - place))
        if not geometry and away > 0.05:
            warnings.append(
                f"camera {k + 1} stands {away:.2f} m from the map's place and there is no "
                "stand-in: near things are predicted in the wrong place"
            )
    error = typical_error(moment, change)
    if error > 0.1:
        warnings.append(
            f"the updated map is {100 * error:.0f} % off in the middle: it does not explain "
            "the frames any more, take a new one"
        )
    if unexplained > 0.1:
        warnings.append(
            f"{100 * unexplained:.0f} % of the frames show something else than the map: "
            "something moved, or there is a new lamp"
        )
    return warnings


def _drift(changes: Sequence[Change], frames: Sequence[Path]) -> list[dict[str, object]]:
    return [
        {
            "frame": path.name,
            "global_factor": change.whole.s[0],
            "global_sigma": change.whole.sigma[0],
            "model": change.chosen.model.kind,
            "left_out": float((change.chosen.fit.weight == 0).mean()),
        }
        for path, change in zip(frames, changes, strict=True)
    ]


def _csv(table: Sequence[dict[str, object]]) -> str:
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", *(f"{n}_{c}" for n in ("factor", "sigma") for c in "rgb"),
                     "model", "left_out"])  # fmt: skip
    for row in table:
        values: Any = [*row["global_factor"], *row["global_sigma"]]  # type: ignore[misc]
        writer.writerow([row["frame"], *(f"{v:.6g}" for v in values), row["model"],
                         f"{row['left_out']:.4f}"])  # fmt: skip
    return text.getvalue()


def _plot(table: Sequence[dict[str, object]], output: Path) -> str:
    import numpy as np
    from matplotlib.figure import Figure

    from chromeball.scene.record import atomic_output

    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    values = np.array([row["global_factor"] for row in table])
    sigma = np.array([row["global_sigma"] for row in table])
    for c, colour in enumerate(("#c33", "#393", "#36c")):
        axes.errorbar(np.arange(len(table)), values[:, c], sigma[:, c], color=colour, capsize=2)
    axes.set_xlabel("frame")
    axes.set_ylabel("light over the map's")
    path = output.with_name(f"{output.stem}.drift.png")
    with atomic_output(path) as temporary:
        figure.savefig(temporary, dpi=110)
    return path.name


def _beside(c: Comparison, change: Change) -> NDArray[np.uint8]:
    """Predicted, seen and their ratio: blue darker, white as before, red brighter."""
    import numpy as np

    from chromeball.scene.color import luminance
    from chromeball.scene.image import to_display

    both = [np.nan_to_num(c.predicted), np.nan_to_num(c.frame.radiance)]
    lit = luminance(both[0])[c.valid]
    exposure = 0.25 / max(float(np.median(lit)), 1e-12)
    pictures = [to_display(rgb, exposure) for rgb in both]
    with np.errstate(divide="ignore", invalid="ignore"):
        stops = np.log2(luminance(both[1]) / luminance(both[0]))
    stops = np.clip(np.where(c.valid, np.nan_to_num(stops), 0), -2, 2) / 2
    ratio = np.stack(
        [1 + np.minimum(stops, 0), 1 - np.abs(stops), 1 - np.maximum(stops, 0)], -1
    )
    ratio[~c.valid] *= 0.3
    pictures.append(np.asarray(255 * ratio, np.uint8))
    for x, y in c.pixels[change.chosen.fit.weight[: len(c.pixels)] == 0]:
        half = c.side / 2
        part = np.s_[int(y - half) + 1 : int(y + half), int(x - half) + 1 : int(x + half)]
        pictures[2][part] //= 3
    return np.concatenate(pictures, axis=1)
