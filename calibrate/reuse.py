"""Whether a camera calibrated earlier still is the one that took new pictures of the target.

Two tests, each with half of the stated risk. The residuals of the new views, their poses
fitted, against those of the views that the camera was solved from: a ratio of mean squares,
which follows Fisher's law if nothing has changed. And the change of the focal length that
explains the new residuals best, in its standard errors. Real residuals scatter more from view
to view than independent noise would; the degrees of freedom are those that the old views'
scatter shows (Satterthwaite 1946).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.choose import view_errors
from chromeball.calibrate.target import Target
from chromeball.calibrate.view_poses import pose_residuals
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import positive, read_header

#: Risk of solving again although nothing has changed.
RISK = 0.01
#: A change of the focal length that the new views must be able to show, relative, nine times in
#: ten: a lens that was taken off, zoomed or refocused from near to far changes by more.
VISIBLE, POWER = 0.01, 0.9
#: For its derivative.
STEP = 1e-3
#: Corners farther off than this many times the median do not count, up to this share of them.
GROSS, GROSS_SHARE = 6.0, 0.1
#: What metadata may say of the pictures: name -> words and relative tolerance.
FACTS: Mapping[str, tuple[str, float]] = {
    "Make": ("the body's maker", 0.0),
    "Model": ("the body", 0.0),
    "BodySerialNumber": ("the body's serial number", 0.0),
    "LensModel": ("the lens", 0.0),
    "LensSerialNumber": ("the lens's serial number", 0.0),
    "FocalLength": ("the focal length", 0.002),
    "SubjectDistance": ("the focus distance", 0.05),
}


@dataclass(frozen=True)
class Check:
    """Whether a camera is `kept`, and why; ``figures`` for the record."""

    kept: bool
    reason: str
    figures: dict[str, Any]


def taken_with(files: Sequence[str]) -> dict[str, str | float]:
    """What the metadata of all `files` agree on, of :data:`FACTS`."""
    agreed: dict[str, str | float] = {}
    for number, file in enumerate(files):
        told = _facts(read_header(file).attributes)
        agreed = told if number == 0 else {k: v for k, v in agreed.items() if told.get(k) == v}
    return agreed


def check_reuse(
    camera: CameraModel,
    figures: Mapping[str, Any],
    target: Target,
    corners: NDArray[np.float64],
    size: tuple[int, int],
    now: Mapping[str, str | float],
    same_board: bool,
) -> Check:
    """Check `camera`, whose record holds `figures`, on `corners` (V, rows, columns, 2).

    `size` of the new pictures and what their metadata say `now`; `same_board` when the record
    is of the same target, whose bow is then known, too.
    """
    if size != camera.size:
        return _no("the pictures are {}x{}, the camera's {}x{}".format(*size, *camera.size))
    from scipy.stats import f as fisher
    from scipy.stats import norm as normal

    before = figures.get("taken_with") or {}
    for name, (words, tolerance) in FACTS.items():
        old, new = before.get(name), now.get(name)
        if old is not None and new is not None and not _same(old, new, tolerance):
            return _no(f"{words} is {new}, not {old}")
    sigma = figures.get("sigma")
    old = np.array(
        [v for v in (figures.get("view_rms") or {}).values() if v is not None], float
    )
    if not sigma or len(old) < 3:
        return _no("its record does not tell how well it fitted")
    bow = np.array(figures["bow_metres"], float) if same_board else None
    pupil = np.array(figures.get("pupil_metres", [0, 0]), float)
    left = pose_residuals(camera, corners, target, bow, pupil)
    corners = _without_gross(corners, left)
    left = pose_residuals(camera, corners, target, bow, pupil)
    errors = view_errors(left, corners)
    if not np.isfinite(errors).all():
        return _no("it does not see some of the new pictures' boards", view_rms=errors)
    seen = np.isfinite(left[..., 0])
    dof = float(2 * seen.sum() - 6 * len(corners))
    square, expected = float((left[seen] ** 2).sum()), float(sigma) ** 2 * dof
    spread = float(np.var(old**2, ddof=1) / np.mean(old**2) ** 2)
    each = min(dof / len(corners), 2 / max(spread, 1e-9))
    ratio = square / expected
    limit = float(fisher.ppf(1 - RISK / 2, each * len(corners), each * len(old)))
    change, error = _focal_change(camera, corners, left, target, bow, pupil)
    error *= float(sigma) * math.sqrt(dof / len(corners) / each)
    error = math.hypot(error, _known_focal(figures))
    most = float(normal.ppf(1 - RISK / 4))
    shows = (most + float(normal.ppf(POWER))) * error
    told: dict[str, Any] = {
        "views": len(corners),
        "rms_ratio": math.sqrt(ratio),
        "rms_ratio_limit": math.sqrt(limit),
        "focal_change": change,
        "focal_change_error": error,
        "focal_change_visible": shows,
        "risk": RISK,
        "view_rms": errors,
    }
    if ratio > limit:
        return _no(
            f"the new views miss it by {math.sqrt(ratio):.2f} times the old residuals, more "
            f"than chance allows ({math.sqrt(limit):.2f})",
            **told,
        )
    if abs(change) > most * error:
        by = f"{100 * abs(change):.2f} % {'longer' if change > 0 else 'shorter'}"
        return _no(
            f"the new views fit a focal length {by}, {abs(change) / error:.1f} standard errors",
            **told,
        )
    if shows > VISIBLE:
        return _no(
            f"the new views would not show a focal length changed by {100 * shows:.1f} %: tilt "
            "the board and let it fill the picture",
            **told,
        )
    return Check(
        True,
        f"the new views fit it with {math.sqrt(ratio):.2f} times the old residuals (limit "
        f"{math.sqrt(limit):.2f}); a focal length changed by {100 * shows:.1g} % would have "
        "shown",
        told,
    )


def _without_gross(
    corners: NDArray[np.float64], left: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The `corners` without a few that lie far off; all of them where that is no few."""
    distance = np.hypot(left[..., 0], left[..., 1])
    gross = distance > GROSS * float(np.nanmedian(distance))
    if gross.sum() > GROSS_SHARE * np.isfinite(distance).sum():
        return corners
    return np.where(gross[..., None], np.nan, corners)


def _focal_change(
    camera: CameraModel,
    corners: NDArray[np.float64],
    left: NDArray[np.float64],
    target: Target,
    bow: NDArray[np.float64] | None,
    pupil: NDArray[np.float64],
) -> tuple[float, float]:
    """The relative change of the focal length that lowers the residuals `left` most.

    With it its standard error for corners of deviation 1 pixel. The poses follow the change:
    the derivative is that of refitted residuals.
    """
    values = camera.intrinsics.copy()
    values[: 2 if len(values) > 3 else 1] *= 1 + STEP
    changed = replace(camera, intrinsics=values)
    slope = (pose_residuals(changed, corners, target, bow, pupil) - left) / STEP
    both = np.isfinite(slope) & np.isfinite(left)
    square = max(float((slope[both] ** 2).sum()), 1e-30)
    return -float((slope[both] * left[both]).sum()) / square, 1 / math.sqrt(square)


def _known_focal(figures: Mapping[str, Any]) -> float:
    """Relative standard error of the focal length in a record."""
    for name in ("fx", "f"):
        if name in figures["intrinsics"]:
            return float(figures["standard_errors"][name] / figures["intrinsics"][name])
    return 0.0


def _facts(attributes: Mapping[str, Any]) -> dict[str, str | float]:
    """Metadata by the names of :data:`FACTS`; numbers as floats."""
    known = {str(k).rpartition(":")[2]: v for k, v in attributes.items()}
    told: dict[str, str | float] = {}
    for name, (_, tolerance) in FACTS.items():
        if tolerance > 0:
            number = positive(known.get(name))
            if number is not None:
                told[name] = number
        elif str(known.get(name) or "").strip():
            told[name] = str(known[name]).strip()
    return told


def _same(old: object, new: object, tolerance: float) -> bool:
    if isinstance(old, int | float) and isinstance(new, int | float):
        return abs(old - new) <= tolerance * max(abs(old), abs(new))
    return old == new


def _no(reason: str, **figures: Any) -> Check:
    return Check(False, reason, figures)
