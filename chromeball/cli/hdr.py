"""``chromeball hdr``: response curves and radiance maps."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, check_output, read_json, record_path

app = App(name="hdr", help="Response curves and radiance maps from bracketed exposures.")

type Inputs = Annotated[
    list[Path], Parameter(help="Pictures, take folders or take.json files.")
]
type Times = Annotated[
    str | None,
    Parameter(help="Exposure times in seconds, 1/30,1/60,...; else from takes or metadata."),
]
type Output = Annotated[Path, Parameter(name=["--output", "-o"], help="Output file.")]
type AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Figures as JSON.")]


def parse_times(text: str | None) -> list[float] | None:
    """``1/30,0.5,13`` -> seconds."""
    if text is None:
        return None
    from chromeball.scene.manifest import parse_time

    return [parse_time(part.strip()) for part in text.split(",")]


@app.command
def response(
    inputs: Inputs,
    /,
    *,
    output: Output,
    times: Times = None,
    smoothness: Annotated[
        float | None, Parameter(help="lambda, for one observation a code. Default 30.")
    ] = None,
    patch: Annotated[
        int | None,
        Parameter(help="Average codes over patches of this many pixels a side; 1: none."),
    ] = None,
    refine_times: Annotated[
        bool,
        Parameter(negative="", help="Solve for the exposures too; their span is kept."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Recover the response of a camera from a bracket of 8-bit pictures (Debevec-Malik)."""
    from chromeball.hdr.bracket import pictures, read_bracket
    from chromeball.hdr.response import SMOOTHNESS, Sample, sample, solve
    from chromeball.hdr.response_file import encode_response, from_solution, plot_response

    bracket = read_bracket(inputs, parse_times(times))
    smoothness = SMOOTHNESS if smoothness is None else smoothness
    check_output(output)
    with Stage(
        "hdr response",
        inputs=bracket.inputs,
        times=times,
        smoothness=smoothness,
        patch=patch,
        refine_times=refine_times,
    ) as stage:
        samples: list[Sample] = []
        channels: tuple[str, ...] = ()
        for picture in pictures(bracket, _tell):
            if picture.linear:
                raise UserError(
                    "a linear picture needs no response; `hdr merge` takes it as it is",
                    file=picture.path,
                )
            if str(picture.pixels.dtype) != "uint8":
                raise UserError(
                    f"{picture.pixels.dtype} codes: a response is solved from 8-bit pictures",
                    file=picture.path,
                )
            samples.append(sample(picture.pixels, patch))
            channels = picture.channels
        found = solve(
            samples, bracket.exposures, smoothness=smoothness, refine_times=refine_times
        )
        observed = found.observed > 0
        plot = output.with_name(output.stem + ".plot.png")
        stage.figures |= {
            "method": "Debevec-Malik, density-balanced patch means",
            "channels": channels,
            "pictures": len(samples),
            "exposure_scale": bracket.scale,
            "residual_rms": found.rms,
            "residual_rms_given_times": found.rms_nominal,
            "standard_error_median": [_median(s) for s in found.sigma],
            "standard_error_max": found.sigma.max(axis=1),
            "condition": found.condition,
            "code_noise": found.code_noise,
            "monotonicity_repairs": found.repaired,
            "codes_observed": observed.sum(axis=1),
            "patches_used": found.used,
            "patch": found.patch,
            "smoothness": smoothness,
            "times_refined": refine_times,
            "largest_time_change_ev": _largest_change(found.log_exposures, bracket.exposures),
            "plot": plot.name,
        }
        curve = from_solution(
            found,
            channels,
            bracket.paths,
            bracket.exposures,
            {**stage.figures, "inputs": [path.name for path in bracket.paths]},
        )
        with stage.output(plot) as temporary:
            plot_response(curve, temporary)
        with stage.output(output) as temporary:
            temporary.write_bytes(encode_response(curve))
    _report(
        output,
        as_json,
        [
            f"residual {_each(found.rms, '.4f')} ln",
            f"standard error {max(_median(s) for s in found.sigma):.4f} median, "
            f"{found.sigma.max():.3f} max",
            f"condition {found.condition.max():.1e}",
            f"{int(found.used.min())} patches of {found.patch} x {found.patch}",
            f"{int(found.repaired.sum())} codes repaired to rise",
        ],
    )


@app.command
def merge(
    inputs: Inputs,
    /,
    *,
    output: Output,
    times: Times = None,
    response: Annotated[
        Path | None, Parameter(help="response.json of the camera; needed for 8-bit pictures.")
    ] = None,
    sigma: Annotated[
        bool, Parameter(negative="", help="Add channels with standard errors.")
    ] = False,
    white: Annotated[
        float | None, Parameter(help="Value of a saturated pixel in linear pictures.")
    ] = None,
    noise: Annotated[
        tuple[float, float] | None,
        Parameter(help="Sensor noise a b, var x = a x + b with x a share of white (linear)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Merge a bracket into a scene-linear EXR; clipped pixels are marked and counted."""
    import numpy as np
    from numpy.typing import NDArray

    from chromeball.hdr.bracket import pictures, read_bracket
    from chromeball.hdr.merge import SENSOR_NOISE, merge_frames, merge_linear, preview, stops
    from chromeball.hdr.response_file import exposures_for, read_response
    from chromeball.scene.image import write_exr, write_picture

    if output.suffix.lower() != ".exr":
        raise UserError("a radiance map is written as .exr", file=output)
    bracket = read_bracket(inputs, parse_times(times))
    curve = None if response is None else read_response(response)
    exposures, refined = bracket.exposures, 0
    if curve is not None:
        exposures, refined = exposures_for(curve, bracket.exposures)
        if curve.refined:
            _tell(f"refined exposures from {response} for {refined} of {len(exposures)}")
    check_output(output)
    with Stage(
        "hdr merge",
        inputs=[*bracket.inputs, *([] if response is None else [response])],
        times=times,
        sigma=sigma,
        white=white,
        noise=noise,
    ) as stage:
        frames: list[NDArray[Any]] = []
        channels: tuple[str, ...] = ()
        linear = False
        for picture in pictures(bracket, _tell):
            frames.append(picture.pixels)
            channels, linear = picture.channels, picture.linear
            if not linear and str(picture.pixels.dtype) != "uint8":
                raise UserError(
                    "16-bit pictures that are not linear cannot be merged: give RAW, EXR or "
                    "8-bit ones",
                    file=picture.path,
                )
            if not linear and curve is None:
                raise UserError(
                    "8-bit pictures need their camera's response: make it with `hdr response` "
                    "and give it with --response",
                    file=picture.path,
                )
        if linear:
            if curve is not None:
                raise UserError(
                    "linear pictures need no response: leave --response out", file=response
                )
            merged = merge_linear(
                frames, exposures, white=white, noise=noise or SENSOR_NOISE, sigma=sigma
            )
        else:
            if white is not None or noise is not None:
                raise UserError("--white and --noise are for linear pictures: leave them out")
            assert curve is not None
            merged = merge_frames(frames, exposures, curve, sigma=sigma)
        del frames
        count = merged.radiance.shape[0] * merged.radiance.shape[1]
        for marked, word, wish in (
            (merged.high, "saturated", "shorter"),
            (merged.low, "black", "longer"),
        ):
            if np.all(marked == count):
                raise UserError(f"every pixel is {word} in all pictures: take {wish} exposures")
        picture_path = output.with_name(output.stem + ".preview.png")
        stage.figures |= {
            "channels": channels,
            "pictures": len(bracket.frames),
            "size": [merged.radiance.shape[1], merged.radiance.shape[0]],
            "exposure_scale": bracket.scale,
            "refined_exposures": refined,
            "clipped_high": merged.high,
            "clipped_low": merged.low,
            "clipped_share": float(np.mean(merged.clipped != 0)),
            "dynamic_range_stops": stops(merged),
            "preview": picture_path.name,
        }
        planes, names = [merged.radiance], list(channels)
        if merged.sigma is not None:
            planes.append(merged.sigma)
            names += [f"sigma.{name}" for name in channels]
            stage.figures["relative_sigma_median"] = float(
                np.median((merged.sigma / merged.radiance)[merged.clipped == 0])
            )
        planes.append(merged.clipped[..., None].astype(np.float32))
        names.append("clipped")
        cameras = {frame.camera for frame in bracket.frames if frame.camera}
        attributes: dict[str, Any] = {
            "exposureScale": bracket.scale,
            "exposures": exposures,
            "sources": ", ".join(path.name for path in bracket.paths),
            "clippedMeaning": "1 saturated in all frames, a lower bound; -1 black in all",
        }
        if len(cameras) == 1:
            attributes["cameraModel"] = cameras.pop()
        with stage.output(output) as temporary:
            write_exr(
                temporary,
                np.concatenate(planes, axis=2),
                channels=names,
                attributes=attributes,
            )
        with stage.output(picture_path) as temporary:
            write_picture(temporary, preview(merged))
    _report(
        output,
        as_json,
        [
            f"{stage.figures['dynamic_range_stops']:.1f} stops",
            f"clipped high {_each(merged.high)}, low {_each(merged.low)}",
            f"exposure scale {bracket.scale}",
        ],
    )


def _tell(message: str) -> None:
    print(message, file=sys.stderr)


def _report(output: Path, as_json: bool, lines: list[str]) -> None:
    if as_json:
        record = read_json(record_path(output))
        print(json.dumps({"output": str(output), **record["figures"]}))
    else:
        print("\n".join([str(output), *(f"  {line}" for line in lines)]))


def _median(values: Any) -> float:
    import numpy as np

    return float(np.median(values[values > 0])) if np.any(values > 0) else 0.0


def _largest_change(log_exposures: Any, exposures: Any) -> float:
    import numpy as np

    return float(np.abs(log_exposures - np.log(exposures)).max() / np.log(2))


def _each(values: Any, form: str = "") -> str:
    return " ".join(format(value, form) for value in values)
