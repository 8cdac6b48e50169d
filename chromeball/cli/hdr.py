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
        Path | None, Parameter(help="response.json of the camera; needed unless linear.")
    ] = None,
    sigma: Annotated[
        bool, Parameter(negative="", help="Add channels with standard errors.")
    ] = False,
    white: Annotated[
        float | None, Parameter(help="Value of a saturated pixel in linear pictures.")
    ] = None,
    noise: Annotated[
        tuple[float, float] | None,
        Parameter(
            help="Sensor noise a b, var x = a x + b with x a share of white (linear); measured "
            "from the bracket unless given."
        ),
    ] = None,
    snr: Annotated[
        float | None,
        Parameter(help="Leave out exposures not needed for this signal-to-noise ratio."),
    ] = None,
    memory: Annotated[
        float, Parameter(help="Gigabytes of frames to keep in memory; others are read twice.")
    ] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Merge a bracket into a scene-linear EXR; clipped pixels are marked and counted."""
    from chromeball.hdr.bracket import Picture, read_bracket
    from chromeball.hdr.merge_files import prepare_codes, prepare_linear, write_merged
    from chromeball.hdr.response_file import exposures_for, read_response
    from chromeball.hdr.stream import Frames
    from chromeball.scene.image import write_picture

    if output.suffix.lower() != ".exr":
        raise UserError("a radiance map is written as .exr", file=output)
    if not (memory >= 0):
        raise UserError(f"--memory {memory:g}: give gigabytes, 0 or more")
    bracket = read_bracket(inputs, parse_times(times))
    curve = None if response is None else read_response(response)
    exposures, refined = bracket.exposures, 0
    if curve is not None:
        exposures, refined = exposures_for(curve, bracket.exposures)
        if curve.refined:
            _tell(f"refined exposures from {response} for {refined} of {len(exposures)}")
    check_output(output)

    def check(picture: Picture) -> None:
        if picture.linear and curve is not None:
            raise UserError(
                "linear pictures need no response: leave --response out", file=response
            )
        if not picture.linear and curve is None:
            raise UserError(
                f"{8 * picture.pixels.itemsize}-bit pictures need their camera's response: "
                "make it with `hdr response` and give it with --response",
                file=picture.path,
            )
        if not picture.linear and (white is not None or noise is not None):
            raise UserError("--white and --noise are for linear pictures: leave them out")

    with (
        Stage(
            "hdr merge",
            inputs=[*bracket.inputs, *([] if response is None else [response])],
            times=times,
            sigma=sigma,
            white=white,
            noise=noise,
            snr=snr,
        ) as stage,
        Frames(
            bracket, _tell, check, memory=int(memory * 2**30), spool=output.parent
        ) as frames,
    ):
        if curve is None:
            prepared = prepare_linear(
                frames, exposures, white=white, noise=noise, sigma=sigma, snr=snr
            )
        else:
            prepared = prepare_codes(frames, exposures, curve, sigma=sigma, snr=snr)
        names = [path.name for path in bracket.paths]
        for number, reason in prepared.idle.items():
            _tell(f"{names[number]} measures nothing: {reason}")
        used = [names[j] for j in prepared.chosen]
        for row in prepared.figures.get("left_out", []):
            _tell(
                f"{row['file']} left out: it would help "
                f"{100 * row['share_it_would_help']:.2g} % of the values to a "
                f"signal-to-noise ratio of {snr:g}"
            )
        cameras = {frame.camera for frame in bracket.frames if frame.camera}
        attributes: dict[str, Any] = {
            "exposureScale": bracket.scale,
            "exposures": exposures[list(prepared.chosen)],
            "sources": ", ".join(used),
            "clippedMeaning": "1 saturated in all frames, a lower bound; -1 black in all",
        }
        if len(cameras) == 1:
            attributes["cameraModel"] = cameras.pop()
        picture_path = output.with_name(output.stem + ".preview.png")
        with stage.output(output) as temporary:
            figures, preview = write_merged(
                temporary, frames, exposures, prepared, sigma=sigma, attributes=attributes
            )
        with stage.output(picture_path) as temporary:
            write_picture(temporary, preview)
        stage.figures |= {
            "channels": frames.channels,
            "pictures": len(used),
            "size": [frames.shape[1], frames.shape[0]],
            "exposure_scale": bracket.scale,
            "refined_exposures": refined,
            "measure_nothing": {names[j]: why for j, why in prepared.idle.items()},
            **prepared.figures,
            **figures,
            "preview": picture_path.name,
        }
    _report(
        output,
        as_json,
        [
            f"{figures['dynamic_range_stops']:.1f} stops",
            f"clipped high {_each(figures['clipped_high'])}, "
            f"low {_each(figures['clipped_low'])}",
            f"noise from {prepared.figures['noise_from']}, "
            f"chi-square {_each(prepared.figures['chi_square'], '.2f')}",
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
