"""From a bracket's files to what the response solvers take, and their findings in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from chromeball.hdr.bracket import Bracket, pictures
from chromeball.hdr.knots import code_count
from chromeball.hdr.response import Sample, Solution, check, sample
from chromeball.hdr.response_file import Response, exposures_for
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image

#: a stored response fits while its residuals' chi-square and RMS (ln units) stay below these
FITTING_CHI_SQUARE, FITTING_RMS = 4.0, 0.05
#: code noise of 8 bits beyond which pictures are hardly of one view
MISALIGNED = 12.0


def read_samples(
    bracket: Bracket, patch: int | None, tell: Callable[[str], None]
) -> tuple[list[Sample], tuple[str, ...]]:
    """Reduce every picture of a bracket to what the solvers need; the channels' names.

    Raises
    ------
    UserError
        A linear picture, one of another depth, or one that cannot be read.

    """
    samples: list[Sample] = []
    channels: tuple[str, ...] = ()
    codes = 0
    for picture, frame in zip(pictures(bracket, tell), bracket.frames, strict=True):
        if picture.linear:
            raise UserError(
                "a linear picture needs no response; `hdr merge` takes it as it is",
                file=picture.path,
            )
        codes = codes or _codes(bracket, str(picture.pixels.dtype))
        try:
            samples.append(sample(picture.pixels, codes, patch, frame.scene))
        except UserError as error:
            raise UserError(str(error), file=picture.path) from error
        channels = picture.channels
    return samples, channels


def _codes(bracket: Bracket, kind: str) -> int:
    """Number of codes: of a 16-bit picture by what the longest exposure reaches."""
    if kind == "uint8":
        return 256
    longest = bracket.paths[int(np.argmax(bracket.exposures))]
    return code_count(int(read_image(longest).pixels.max()))


def fitting(
    stored: Response, samples: list[Sample], channels: tuple[str, ...], bracket: Bracket
) -> tuple[Response | None, str]:
    """The stored response where it fits the pictures, else None; and why, in a sentence."""
    if stored.codes != samples[0].codes or stored.channels != channels:
        return None, (
            f"stored response has {stored.codes} codes and channels "
            f"{', '.join(stored.channels)}; the pictures differ: solving anew"
        )
    cameras = {frame.camera for frame in bracket.frames if frame.camera}
    known = stored.record.get("cameras")
    if cameras and isinstance(known, list) and known and set(known) != cameras:  # pyright: ignore[reportUnknownArgumentType]
        return None, (
            f"stored response is of {', '.join(map(str, known))}, the pictures are of "  # pyright: ignore[reportUnknownArgumentType]
            f"{', '.join(sorted(cameras))}: solving anew"
        )
    exposures, _ = exposures_for(stored, bracket.exposures, [p.name for p in bracket.paths])
    chi_square, rms = check(samples, exposures, stored.log_exposure, stored.sigma)
    figures = (
        f"chi-square {' '.join(f'{v:.2f}' for v in chi_square)}, residual "
        f"{' '.join(f'{v:.4f}' for v in rms)} ln"
    )
    if chi_square.max() > FITTING_CHI_SQUARE or rms.max() > FITTING_RMS:
        return None, f"stored response no longer fits ({figures}): solving anew"
    record = {
        **stored.record,
        "reused_for": [path.name for path in bracket.paths],
        "reuse_chi_square": chi_square.tolist(),
    }
    return replace(stored, record=record), f"stored response fits ({figures}): kept"


def figures_of(found: Solution, bracket: Bracket, channels: tuple[str, ...]) -> dict[str, Any]:
    """What the record and the report say of a solution."""
    names = [path.name for path in bracket.paths]
    used = np.exp(found.log_exposures)
    return {
        "method": found.method,
        "channels": channels,
        "codes": found.g.shape[1],
        "cameras": sorted({f.camera for f in bracket.frames if f.camera}),
        "pictures": len(names),
        "exposure_scale": bracket.scale,
        "residual_rms": found.rms,
        "residual_rms_given_times": found.rms_nominal,
        "chi_square": found.chi_square,
        "standard_error_median": np.median(found.sigma, axis=1),
        "standard_error_max": found.sigma.max(axis=1),
        "condition": found.condition,
        "code_noise": found.code_noise,
        "monotonicity_repairs": found.repaired,
        "knots_observed": (found.observed > 0).sum(axis=1),
        "patches_used": found.used,
        "patch": found.patch,
        "unchanging_share": found.unchanging,
        "times_refined": found.refined,
        "wrong_exposures": {names[k]: factor for k, factor in found.wrong},
        "frames": [
            {
                "file": name,
                "given": given,
                "used": exposure,
                "change_ev": float(np.log2(exposure / given)),
                "residual": residual,
            }
            for name, given, exposure, residual in zip(
                names, bracket.exposures, used, found.frame_residual, strict=True
            )
        ],
        "largest_time_change_ev": float(
            np.abs(found.log_exposures - np.log(bracket.exposures)).max() / np.log(2)
        ),
        **found.extra,
    }


def told(found: Solution, bracket: Bracket) -> list[str]:
    """A solution in a few lines, what a person should look at first."""
    lines = [
        f"{bracket.paths[k].name}: its exposure contradicts the pictures, which show "
        f"{factor:.3g} times what was given; used so"
        for k, factor in found.wrong
    ]
    codes = found.g.shape[1]
    noise = found.code_noise * (255 / (codes - 1))
    if np.any(noise > MISALIGNED):
        lines.append(
            f"the codes scatter by {noise.max():.0f} (of 255): the pictures are hardly of one "
            "view; align them with `hdr align` first"
        )
    if found.unchanging > 0.001:
        lines.append(
            f"{100 * found.unchanging:.1f} % of the picture does not change with exposure "
            "(border, caption): left out"
        )
    times = ", exposures refined" if found.refined else ""
    return [
        *lines,
        f"{found.method}, {codes} codes{times}",
        f"residual {' '.join(f'{v:.4f}' for v in found.rms)} ln"
        + (
            f" ({' '.join(f'{v:.4f}' for v in found.rms_nominal)} with the times given)"
            if found.refined or found.wrong
            else ""
        ),
        f"standard error {np.median(found.sigma):.4f} median, {found.sigma.max():.3f} max",
        f"condition {found.condition.max():.1e}",
        f"{int(found.repaired.sum())} codes repaired to rise",
    ]
