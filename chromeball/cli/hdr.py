"""``chromeball hdr``: response curves and radiance maps."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

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
    method: Annotated[
        Literal["comparagram", "debevec"],
        Parameter(help="With a prior over real curves; or Debevec and Malik as published."),
    ] = "comparagram",
    smoothness: Annotated[
        float | None, Parameter(help="debevec: lambda at one observation a code. Default 30.")
    ] = None,
    patch: Annotated[
        int | None,
        Parameter(help="Average codes over patches of this many pixels a side; 1: none."),
    ] = None,
    refine_times: Annotated[
        bool | None,
        Parameter(
            help="Solve for the exposures too, their span kept. comparagram: where the "
            "pictures say so decisively, unless given."
        ),
    ] = None,
    reuse: Annotated[
        Path | None,
        Parameter(help="A stored response: kept if it fits these pictures, else solved anew."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recover the response of a camera from a bracket of 8-bit or 16-bit pictures."""
    from chromeball.hdr.bracket import read_bracket
    from chromeball.hdr.debevec import SMOOTHNESS
    from chromeball.hdr.plots import plot_comparagrams, plot_response
    from chromeball.hdr.response import from_solution, solve
    from chromeball.hdr.response_file import encode_response, read_response
    from chromeball.hdr.response_files import figures_of, fitting, read_samples, told

    if method != "debevec" and smoothness is not None:
        raise UserError("--smoothness is lambda of --method debevec: leave it out")
    bracket = read_bracket(inputs, parse_times(times))
    stored = read_response(reuse) if reuse is not None and reuse.is_file() else None
    if reuse is not None and stored is None:
        _tell(f"{reuse}: no stored response; solving one")
    check_output(output)
    with Stage(
        "hdr response",
        inputs=[*bracket.inputs, *([reuse] if reuse is not None and stored else [])],
        times=times,
        method=method,
        smoothness=smoothness,
        patch=patch,
        refine_times=refine_times,
        reuse=reuse,
    ) as stage:
        if method == "debevec" and patch is None:
            patch = 1  # all pixels, as published
        samples, channels = read_samples(bracket, patch, _tell)
        kept = None
        if stored is not None and reuse is not None:
            kept, why = fitting(stored, samples, channels, bracket)
            _tell(why)
            stage.figures["reuse"] = why
        if kept is None:
            found = solve(
                samples,
                bracket.exposures,
                method=method,
                smoothness=SMOOTHNESS if smoothness is None else smoothness,
                refine_times=refine_times,
            )
            stage.figures |= figures_of(found, bracket, channels)
            lines = told(found, bracket)
            with stage.output(_beside(output, "comparagrams")) as temporary:
                plot_comparagrams(samples, found, bracket.paths, temporary)
            stage.figures["comparagrams"] = _beside(output, "comparagrams").name
            kept = from_solution(
                found,
                channels,
                bracket.paths,
                bracket.exposures,
                {**stage.figures, "inputs": [path.name for path in bracket.paths]},
            )
        else:
            lines = [str(stage.figures["reuse"])]
        plot = _beside(output, "plot")
        stage.figures["plot"] = plot.name
        with stage.output(plot) as temporary:
            plot_response(kept, temporary)
        with stage.output(output) as temporary:
            temporary.write_bytes(encode_response(kept))
    _report(output, as_json, lines)


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
    from chromeball.hdr.plots import plot_radiance
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
        names = [path.name for path in bracket.paths]
        exposures, refined = exposures_for(curve, bracket.exposures, names)
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
            figures, glance = write_merged(
                temporary, frames, exposures, prepared, sigma=sigma, attributes=attributes
            )
        with stage.output(picture_path) as temporary:
            write_picture(temporary, glance.picture)
        with stage.output(_beside(output, "histogram")) as temporary:
            plot_radiance(glance, frames.channels, temporary)
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
            "histogram": _beside(output, "histogram").name,
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


def _beside(output: Path, what: str) -> Path:
    return output.with_name(f"{output.stem}.{what}.png")


def _tell(message: str) -> None:
    print(message, file=sys.stderr)


def _report(output: Path, as_json: bool, lines: list[str]) -> None:
    if as_json:
        record = read_json(record_path(output))
        print(json.dumps({"output": str(output), **record["figures"]}))
    else:
        print("\n".join([str(output), *(f"  {line}" for line in lines)]))


def _each(values: Any, form: str = "") -> str:
    return " ".join(format(value, form) for value in values)
