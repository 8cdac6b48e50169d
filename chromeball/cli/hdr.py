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
type Filters = Annotated[
    str | None,
    Parameter(help="Neutral-density filters in stops: one for all pictures, or 0,0,3,..."),
]
type Exact = Annotated[
    bool,
    Parameter(
        negative="", help="Times are names of the shutter's series: 1/30 stands for 1/32 s."
    ),
]
type Motions = Annotated[
    list[Path] | None,
    Parameter(
        help="motion.json of `hdr align` for hand-held frames; one a take.",
        consume_multiple=True,
    ),
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
def align(
    inputs: Inputs,
    /,
    *,
    output: Output,
    times: Times = None,
    nd: Filters = None,
    response: Annotated[
        Path | None, Parameter(help="response.json, if known; it is not needed.")
    ] = None,
    model: Annotated[
        Literal["auto", "shift", "rotation", "homography"],
        Parameter(help="What may move; auto: what the pictures tell."),
    ] = "auto",
    as_json: AsJson = False,
) -> None:
    """Find how the frames of a hand-held bracket lie to each other; pixels stay as they are."""
    import numpy as np

    from chromeball.hdr.align import align as find_motion
    from chromeball.hdr.align import is_needed
    from chromeball.hdr.bracket import pictures, read_bracket
    from chromeball.hdr.match import MODELS
    from chromeball.hdr.motion import encode_motion
    from chromeball.hdr.response_file import exposures_for, read_response

    bracket = read_bracket(inputs, parse_times(times), parse_stops(nd))
    _notes(bracket.notes)
    curve = None if response is None else read_response(response)
    exposures = bracket.exposures
    if curve is not None:
        names = [path.name for path in bracket.paths]
        exposures, _ = exposures_for(curve, exposures, names)
    check_output(output, bracket.inputs)
    with Stage(
        "hdr align",
        inputs=[*bracket.inputs, *([] if response is None else [response])],
        times=times,
        nd=nd,
        model=model,
    ) as stage:
        frames = [picture.pixels for picture in pictures(bracket, _tell)]
        known = curve.log_exposure if curve is not None and curve.codes == 256 else None
        found = find_motion(
            frames, exposures, known, models=tuple(MODELS) if model == "auto" else (model,)
        )
        size = frames[0].shape[1], frames[0].shape[0]
        with stage.output(output) as temporary:
            temporary.write_bytes(encode_motion(found, bracket.paths, size, output.parent))
        needed = is_needed(found)
        flagged = {
            path.name: flag
            for path, flag in zip(bracket.paths, found.flags, strict=True)
            if flag
        }
        stage.figures |= {
            "model": found.model,
            "reference": bracket.paths[found.reference].name,
            "needed": needed,
            "largest_displacement_px": float(found.displacement.max()),
            "flagged": flagged,
            "frames": [
                {
                    "file": path.name,
                    "displacement_px": float(found.displacement[k]),
                    "standard_error_px": float(found.sigma[k]),
                    "halves_differ_px": float(found.split[k]),
                    "tiles": int(found.tiles[k]),
                    "flag": found.flags[k],
                }
                for k, path in enumerate(bracket.paths)
            ],
        }
        for name, flag in flagged.items():
            _tell(f"{name}: {flag}")
    sure = found.sigma[np.isfinite(found.sigma)]
    _report(
        output,
        as_json,
        [
            f"model {found.model}, reference {bracket.paths[found.reference].name}",
            f"moved by up to {found.displacement.max():.2f} px, standard error "
            f"{sure.max() if sure.size else np.inf:.2f} px",
            "alignment is needed" if needed else "no frame moved: nothing will be resampled",
            *(f"{name}: not to be trusted, {flag}" for name, flag in flagged.items()),
        ],
    )


@app.command
def response(
    inputs: Inputs,
    /,
    *,
    output: Output,
    times: Times = None,
    exact_times: Exact = False,
    nd: Filters = None,
    motion: Motions = None,
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
    bracket = read_bracket(inputs, parse_times(times), parse_stops(nd), exact=exact_times)
    _notes(bracket.notes)
    if motion:
        bracket = bracket.moved_by(motion)
    stored = read_response(reuse) if reuse is not None and reuse.is_file() else None
    if reuse is not None and stored is None:
        _tell(f"{reuse}: no stored response; solving one")
    check_output(output, bracket.inputs)
    with Stage(
        "hdr response",
        inputs=[*bracket.inputs, *([reuse] if reuse is not None and stored else [])],
        times=times,
        exact_times=exact_times,
        nd=nd,
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
    exact_times: Exact = False,
    nd: Filters = None,
    motion: Motions = None,
    deghost: Annotated[
        bool,
        Parameter(
            negative="", help="Take what moved from one exposure; frames are kept in memory."
        ),
    ] = False,
    response: Annotated[
        Path | None,
        Parameter(help="response.json of the camera, or .rsp; needed unless linear."),
    ] = None,
    sigma: Annotated[
        bool, Parameter(negative="", help="Add channels with standard errors.")
    ] = False,
    white: Annotated[
        float | None,
        Parameter(help="Value of a saturated pixel in linear pictures other than RAW."),
    ] = None,
    noise: Annotated[
        tuple[float, float] | None,
        Parameter(
            help="Sensor noise a b, var x = a x + b with x a share of white (linear); measured "
            "from the bracket unless given."
        ),
    ] = None,
    white_balance: Annotated[
        str | None,
        Parameter(help="RAW: camera (default), daylight, none, or three multipliers r,g,b."),
    ] = None,
    snr: Annotated[
        float | None,
        Parameter(help="Leave out exposures not needed for this signal-to-noise ratio."),
    ] = None,
    luminance: Annotated[
        float | None, Parameter(help="Light-meter reading in cd/m^2 of the place --at.")
    ] = None,
    grey_card: Annotated[
        tuple[float, float] | None,
        Parameter(help="Reflectance of a grey card --at the place, and illuminance in lux."),
    ] = None,
    at: Annotated[
        str | None, Parameter(help="The metered place in pixels: x,y or x,y,width,height.")
    ] = None,
    scale_from: Annotated[
        Path | None,
        Parameter(help="A map of the same session in cd/m^2: its scale serves this one too."),
    ] = None,
    vignetting: Annotated[
        str | None,
        Parameter(
            help="Fall-off of the lens, divided out: a vignette.json of `calibrate vignette`, "
            "or c1,c2,... of 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the picture's corner."
        ),
    ] = None,
    memory: Annotated[
        float, Parameter(help="Gigabytes of frames to keep in memory; others are read twice.")
    ] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Merge a bracket into a scene-linear EXR; clipped pixels are marked and counted.

    RAW brackets are merged as sensor values and developed once.
    """
    from chromeball.hdr.bracket import Picture, pictures, read_bracket
    from chromeball.hdr.merge_files import (
        Sensor,
        deghosted,
        developed,
        merge_bands,
        prepare_codes,
        prepare_linear,
        prepare_sensor,
        read_luminance,
        scaled,
        suspicious,
        vignetting_strays,
        without_vignetting,
        write_merged,
    )
    from chromeball.hdr.plots import plot_radiance
    from chromeball.hdr.response_file import exposures_for, read_response
    from chromeball.hdr.stream import Frames
    from chromeball.scene.image import NEGATIVE_MEANING, write_picture
    from chromeball.scene.raw import no_bayer
    from chromeball.scene.vignette import REMOVED, resolved
    from chromeball.scene.vignette_option import file_of, read_known

    if output.suffix.lower() != ".exr":
        raise UserError("a radiance map is written as .exr", file=output)
    if not 0 <= memory < 1e6:
        raise UserError(f"--memory {memory:g}: give gigabytes, 0 or more")
    falloff = None if vignetting is None else read_known(vignetting)
    reading = _reading(luminance, grey_card, at, scale_from)
    bracket = read_bracket(inputs, parse_times(times), parse_stops(nd), exact=exact_times)
    _notes(bracket.notes)
    if motion:
        bracket = bracket.moved_by(motion)
    balance = _balance(white_balance)
    odd = no_bayer(bracket.paths[0]) if bracket.raw else None
    if bracket.raw and deghost:
        raise UserError("--deghost is for pictures with their colours, not for RAW mosaics")
    if bracket.raw and bracket.aligned:
        raise UserError("RAW mosaics cannot be resampled: leave --motion out")
    if odd:
        _tell(f"{bracket.paths[0].name} is no Bayer mosaic ({odd}): merging LibRaw's pictures")
    sensor = Sensor() if bracket.raw and not odd else None
    if balance is not None and sensor is None:
        raise UserError("--white-balance is for RAW pictures of a Bayer sensor: leave it out")
    if bracket.raw and white is not None:
        raise UserError("RAW pictures say what is white: leave --white out")
    curve = None if response is None else read_response(response)
    exposures, refined = bracket.exposures, 0
    if curve is not None:
        names = [path.name for path in bracket.paths]
        exposures, refined = exposures_for(curve, bracket.exposures, names)
        if curve.refined:
            _tell(f"refined exposures from {response} for {refined} of {len(exposures)}")
    check_output(output, bracket.inputs)
    if curve is not None:
        _same_camera(curve, bracket)

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
            inputs=[
                *bracket.inputs,
                *(path for path in (response, scale_from) if path is not None),
                *file_of(vignetting),
            ],
            times=times,
            exact_times=exact_times,
            nd=nd,
            deghost=deghost,
            sigma=sigma,
            white=white,
            noise=noise,
            white_balance=white_balance,
            snr=snr,
            luminance=luminance,
            grey_card=grey_card,
            at=at,
            vignetting=vignetting,
        ) as stage,
        Frames(
            bracket,
            _tell,
            sensor.pictures if sensor else pictures,
            check,
            memory=int(memory * 2**30),
            spool=output.parent,
        ) as frames,
    ):
        whole = None
        channels = frames.channels
        if sensor is not None:
            info = sensor.info
            channels = ("R", "G", "B")
            prepared = prepare_sensor(
                frames, exposures, info, noise=noise, sigma=sigma, snr=snr
            )
            whole, found = developed(frames, exposures, prepared, info, balance or "camera")
            stage.figures |= found
        elif curve is None:
            prepared = prepare_linear(
                frames, exposures, white=white, noise=noise, sigma=sigma, snr=snr
            )
        else:
            prepared = prepare_codes(frames, exposures, curve, sigma=sigma, snr=snr)
        if deghost:
            whole, found = deghosted(frames, exposures, prepared, curve, white)
            stage.figures |= found
        names = [path.name for path in bracket.paths]
        scatter = prepared.figures.get("noise_over_response")
        if scatter is not None and scatter > 3:
            _tell(
                f"the pictures scatter {scatter:.1f} times more about this response than those "
                "it was solved from: is it of this camera, and did nothing move?"
            )
        suspicions = suspicious(
            frames, exposures, curve, sensor.info if sensor else None, white
        )
        for suspicion in suspicions:
            _tell(suspicion.message(names[suspicion.frame]))
        stage.figures["suspicious_exposures"] = {names[s.frame]: s.ratio for s in suspicions}
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
        if curve is None:
            attributes[NEGATIVE_MEANING] = "noise about black, and colours outside Rec.709"
        if "white_balance" in stage.figures:
            attributes["whiteBalance"] = stage.figures["white_balance"]
        unit = _unit(curve, bracket)
        attributes["radianceUnit"] = unit
        known_scale = None if scale_from is None else _scale_of(scale_from, bracket.scale, unit)
        factor = known_scale or 1.0
        size = frames.shape[1], frames.shape[0]
        fall = None
        if falloff is not None:
            fall = resolved(falloff, size)
            attributes[REMOVED] = str(vignetting)
            strays = vignetting_strays(fall, bracket, size)
            stage.figures |= {"vignetting_strays": strays, "vignetting_beyond": fall.beyond()}
            _vignetting_notes(fall, strays, bracket)
        if reading is not None:
            place, cd = reading
            meter = read_luminance(frames, exposures, prepared, place, cd, whole, fall)
            factor = meter.scale
            stage.figures |= {"luminance_error": meter.error, "metered_pixels": meter.pixels}
        if reading is not None or known_scale is not None:
            attributes |= {"whiteLuminance": 1.0, "luminanceScale": factor}
            stage.figures["luminance_scale"] = factor
        parts = (
            merge_bands(frames, exposures, prepared) if whole is None else iter([(0, whole)])
        )
        if fall is not None:
            parts = without_vignetting(parts, fall, size)
        with stage.output(output) as temporary:
            figures, glance = write_merged(
                temporary,
                size,
                channels,
                ((top, scaled(part, factor)) for top, part in parts),
                sigma=sigma,
                attributes=attributes,
            )
        with stage.output(_beside(output, "preview")) as temporary:
            write_picture(temporary, glance.picture)
        with stage.output(_beside(output, "histogram")) as temporary:
            plot_radiance(glance, channels, temporary)
        stage.figures |= {
            "channels": channels,
            "pictures": len(used),
            "size": size,
            "exposure_scale": bracket.scale,
            "refined_exposures": refined,
            "measure_nothing": {names[j]: why for j, why in prepared.idle.items()},
            "notes": bracket.notes,
            **prepared.figures,
            **figures,
            "preview": _beside(output, "preview").name,
            "histogram": _beside(output, "histogram").name,
        }
    absolute = ", values in cd/m^2" if "luminance_scale" in stage.figures else ""
    _report(
        output,
        as_json,
        [
            f"{figures['dynamic_range_stops']:.1f} stops",
            f"clipped high {_each(figures['clipped_high'])}, "
            f"low {_each(figures['clipped_low'])}",
            f"noise from {prepared.figures['noise_from']}"
            + (
                f", chi-square {_each(prepared.figures['chi_square'], '.2f')}"
                if len(used) > 1
                else ""
            ),
            f"exposure scale {bracket.scale}{absolute}",
            *(
                [f"{stage.figures['ghost_regions']} ghosts, {stage.figures['ghost_share']:.2%}"]
                if deghost
                else []
            ),
        ],
    )


def parse_stops(text: str | None) -> list[float]:
    """``3`` or ``0,0,3`` -> stops of neutral-density filters."""
    if text is None:
        return []
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise UserError(f"--nd {text}: give stops, 3 or 0,0,3") from error


def _balance(text: str | None) -> Any:
    if text is None or text in ("camera", "daylight", "none"):
        return text
    try:
        r, g, b = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(
            f"--white-balance {text}: camera, daylight, none or three multipliers r,g,b"
        ) from error
    if not all(0 < value < 1e3 for value in (r, g, b)):
        raise UserError(f"--white-balance {text}: three positive multipliers")
    return r, g, b


def _reading(
    luminance: float | None,
    card: tuple[float, float] | None,
    at: str | None,
    scale_from: Path | None,
) -> tuple[tuple[int, ...], float] | None:
    """The metered place and its luminance in cd/m^2, or None."""
    from chromeball.hdr.exposure import grey_card

    given = sum(option is not None for option in (luminance, card, scale_from))
    if given > 1:
        raise UserError("--luminance, --grey-card and --scale-from say one thing: give one")
    if (luminance is not None or card is not None) != (at is not None):
        raise UserError("a reading needs --luminance or --grey-card, and its place --at")
    if at is None:
        return None
    try:
        place = tuple(int(part) for part in at.split(","))
    except ValueError as error:
        raise UserError(f"--at {at}: whole pixels x,y or x,y,width,height") from error
    if len(place) not in (2, 4):
        raise UserError(f"--at {at}: give x,y or x,y,width,height")
    if luminance is not None:
        return place, luminance
    assert card is not None
    return place, grey_card(*card)


def _vignetting_notes(fall: Any, strays: float, bracket: Any) -> None:
    """Say where a fall-off does not fit the pictures."""
    apertures = {frame.aperture for frame in bracket.frames if frame.aperture}
    if fall.aperture is not None and any(abs(a / fall.aperture - 1) > 0.05 for a in apertures):
        listed = ", ".join(f"f/{a:g}" for a in sorted(apertures))
        _tell(f"the fall-off was measured at f/{fall.aperture:g}, the pictures have {listed}")
    if strays > 0.005:
        _tell(f"the frames moved: the fall-off fits them to {strays:.1%} only")
    if fall.beyond() > 0.05:
        _tell(
            f"{fall.beyond():.0%} of the picture lies farther out than where the fall-off was "
            "measured"
        )


def _same_camera(curve: Any, bracket: Any) -> None:
    """Say that the response is of another camera than the pictures, where both are known."""
    known = curve.record.get("cameras") or []
    cameras = sorted({frame.camera for frame in bracket.frames if frame.camera})
    if known and cameras and known != cameras:
        _tell(
            f"the response is of {', '.join(map(str, known))}, the pictures are of "
            f"{', '.join(cameras)}: their curves differ"
        )


def _unit(curve: Any, bracket: Any) -> str:
    """What value 1 stands for before a light meter says: maps of one unit share a scale."""
    import hashlib

    camera = ", ".join(sorted({frame.camera for frame in bracket.frames if frame.camera}))
    if curve is None:
        kind = "share of the sensor's white" if bracket.raw else "linear value"
    else:
        digest = hashlib.blake2b(curve.log_exposure.tobytes(), digest_size=8).hexdigest()
        kind = f"middle code of response {digest}"
    return f"{kind}, {camera}" if camera else kind


def _scale_of(path: Path, scale: str, unit: str) -> float:
    """The factor to cd/m^2 of a map of the same session."""
    from chromeball.scene.image import read_header

    attributes = read_header(path).attributes
    factor = attributes.get("luminanceScale")
    if not isinstance(factor, float):
        raise UserError("this map is not in cd/m^2: merge it with --luminance", file=path)
    if attributes.get("exposureScale") != scale:
        raise UserError(
            f"its exposures are {attributes.get('exposureScale')}, those of the pictures "
            f"{scale}: one scale cannot serve both",
            file=path,
        )
    if attributes.get("radianceUnit") != unit:
        raise UserError(
            f"its values were in units of {attributes.get('radianceUnit')}, those of the "
            f"pictures are of {unit}: one scale serves one camera and one response",
            file=path,
        )
    return factor


def _notes(notes: tuple[str, ...]) -> None:
    for note in notes:
        _tell(note)


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
