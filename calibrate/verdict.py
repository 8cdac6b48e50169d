"""How good a calibrated lens is, in a sentence, and what to do about it.

The error at a place of the picture is made of what was measured: the uncertainty from corner
noise, times what two halves of the views differ more than that; what residuals have in common
at the same place; and 2 px more where no corner tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.halves import Halves
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.next_views import (
    GOOD,
    GOOD_SHARE,
    TILT,
    UNSEEN,
    View,
    knowledge,
    next_views,
)
from chromeball.calibrate.one_lens import Change, lens_change
from chromeball.calibrate.regions import named, thirds
from chromeball.calibrate.target import Target

#: Errors that a verdict names, pixels.
LADDER = (0.02, 0.05, 0.1, 0.2, GOOD, 0.5, 1.0, 2.0, 5.0, 10.0)
#: Fewer views leave errors of single ones, a board that moved or bent, in the lens: a half of
#: ten still has five to compare.
ENOUGH_VIEWS = 10
#: Boards that differ less in slant leave focal length and distance hard to tell apart.
ENOUGH_TILT = math.radians(20)
#: Errors of left-out views, of which there are many, over those of the solution's own: the lens
#: of half the views adds a tenth to theirs, chance some hundredths.
MISFIT = 1.25
#: A view of which more than this share of corners was rejected was misread, or moved.
REJECTED = 0.15
#: No verdict is good if more than this share of the views does not fit the lens.
MISREAD = 0.1
#: A board that bows by more than this share of its width is no parabola any more, either.
BENT = 0.004
#: Edges blurred by more than this, pixels, lose corners and some of their accuracy.
BLURRED = 2.5
#: So many views are named.
NAMED = 3
#: Cells of the picture across whose residuals are looked at together, and corners in one.
CELLS, IN_CELL = 10, 8


@dataclass(frozen=True)
class Verdict:
    """Whether a lens is `good`, a sentence, what to do; ``error`` (h, w) over ``pixels``.

    ``advice`` holds sentences, none when nothing is lacking; ``views`` the views to take, the
    most telling first; ``figures`` what all was derived from.
    """

    good: bool
    sentence: str
    advice: tuple[str, ...]
    views: tuple[View, ...]
    pixels: NDArray[np.float64]
    error: NDArray[np.float64]
    figures: dict[str, Any]


def judge_lens(
    lens: Lens,
    target: Target,
    *,
    halves: Halves | None = None,
    lit: NDArray[np.bool_] | None = None,
    files: Sequence[str] | None = None,
    blur: float = math.nan,
    searched: bool = False,
    columns: int = 18,
) -> Verdict:
    """Judge a `lens` by its views of `target`.

    `halves` of its views; `lit` (h, w), :meth:`Lens.uncertainty`'s pixels with so many
    `columns` that the lens throws light on; names of the views' `files`; the median `blur` of
    their edges, pixels; and whether the model was `searched` for.

    Raises
    ------
    UserError
        When a splined lens sees too few corners.

    """
    pixels, _ = lens.uncertainty(columns)
    flat = pixels.reshape(-1, 2)
    shown = np.ones(len(flat), bool) if lit is None else lit.ravel()
    known = knowledge(lens, target, flat)
    pattern, repeated = common_residual(lens)
    excess = math.nan if halves is None else halves.excess
    misfit = math.nan if halves is None else halves.misfit
    differ = halves is not None and halves.excess > halves.chance
    worse = excess if differ else 1.0
    systematic = pattern if repeated else 0.0
    error = np.hypot(worse * known.error(), systematic)
    misread = np.flatnonzero(~np.isfinite(lens.camera_from_board).all(axis=-1))
    views = len(lens.camera_from_board) - len(misread)
    precision, share = _precision(error[shown])
    wide_enough = lens.tilt() >= ENOUGH_TILT
    bad = (error >= GOOD) & shown
    enough = float(np.mean(error[shown] < GOOD)) >= GOOD_SHARE
    # More views do not help where the model itself is not that good.
    few = max(0, ENOUGH_VIEWS - views, 0 if wide_enough else 3)
    change = lens_change(lens, target)
    chosen, after = next_views(known, target, lit=shown, worse=worse, fewest=few)
    if change is not None or (enough and not few):
        chosen, after = [], known
    good = enough and views >= ENOUGH_VIEWS and wide_enough
    good &= not differ and not misfit > MISFIT and change is None
    good &= len(misread) <= MISREAD * len(lens.camera_from_board)
    picture = "picture" if shown.all() else "lens's circle"
    sentence = (
        f"{'good' if precision <= GOOD else 'known'} to {precision:g} px over "
        f"{math.floor(100 * share)} % of the {picture}"
    )
    where, plural = ("", False) if enough else _where(error, shown, flat, lens.camera.size)
    if where:
        middle = float(np.median(error[bad]))
        state = "unconstrained" if middle >= UNSEEN else f"known to {middle:.1g} px only"
        sentence += f"; {where} {'are' if plural else 'is'} {state}"
    if chosen:
        ask = _count(len(chosen), "view") if where else _count(len(chosen), "more view")
        sentence += f": take {ask}{' there' if where else ''}"
    advice = _view_advice(chosen, error, flat, lens.camera.size)
    if len(misread):
        verb = "does" if len(misread) == 1 else "do"
        sentence += f"; {len(misread)} of {len(lens.camera_from_board)} views {verb} not fit"
    if change is not None:
        sentence += f"; the lens changed before {_name(change.first, files)}"
        advice.insert(0, _changed(change, len(lens.camera_from_board), files))
    if views < ENOUGH_VIEWS:
        sentence += f"; {_count(views, 'view')} {'is' if views == 1 else 'are'} few"
    if not wide_enough:
        turned = f"{math.degrees(lens.tilt()):.0f} degrees"
        sentence += f"; the board was never tilted by more than {turned}"
        advice.insert(0, f"tilt the board by {TILT:.0f} degrees and more, each way: no two "
                      f"views differ by more than {turned}")  # fmt: skip
    if differ:
        sentence += f"; two halves of the views differ {excess:.1f} times more than their noise"
    elif misfit > MISFIT:
        sentence += f"; left-out views miss by {misfit:.1f} times what the noise explains"
    advice += _other_advice(lens, target, files, blur, changed=change is not None)
    if change is None and (differ or misfit > MISFIT or systematic > GOOD / 2):
        advice.append(
            _systematic(excess if differ else math.nan, misfit, pattern, repeated, searched)
        )
    figures: dict[str, Any] = {
        "good_px": precision,
        "good_share": share,
        "views": views,
        "views_that_do_not_fit": len(misread),
        "lens_change": None
        if change is None
        else {
            "before": _name(change.first, files),
            "magnification": change.magnification,
            "error": change.error,
        },
        "tilt_degrees": math.degrees(lens.tilt()),
        "seen_share": float(known.seen[shown].mean()),
        "common_residual_px": pattern,
        "common_residual_certain": repeated,
        "dark_share": float(1 - shown.mean()),
        "halves_excess": excess,
        "halves_chance": math.nan if halves is None else halves.chance,
        "held_out_misfit": misfit,
        "held_out_px": math.nan if halves is None else float(np.nanmedian(halves.held_out)),
        "predicted_share": float(
            np.mean(np.hypot(worse * after.error(), systematic)[shown] < GOOD)
        ),
    }
    shape = pixels.shape[:2]
    return Verdict(
        bool(good),
        sentence,
        tuple(advice),
        tuple(chosen),
        pixels,
        error.reshape(shape),
        figures,
    )


def common_residual(lens: Lens) -> tuple[float, bool]:
    """What residuals have in common at a place, RMS in pixels, and if that is certain.

    Over cells of the picture: the square of the mean residual less what noise leaves of it.
    """
    width, height = lens.camera.size
    rows = max(2, round(CELLS * height / width))
    used = np.isfinite(lens.residuals[..., 0])
    q, r = lens.observed[used], lens.residuals[used]
    cell = np.clip((q + 0.5) / [width, height] * [CELLS, rows], 0, [CELLS - 1, rows - 1])
    index = cell[:, 1].astype(int) * CELLS + cell[:, 0].astype(int)
    count = np.bincount(index, minlength=CELLS * rows).astype(float)
    full = count >= IN_CELL
    if full.sum() < 4:
        return 0.0, False
    mean = np.stack(
        [np.bincount(index, r[:, i], CELLS * rows)[full] / count[full] for i in range(2)],
        axis=-1,
    )
    noise = 2 * lens.sigma**2 / count[full]
    square = (mean**2).sum(axis=-1)
    # Twice the number of cells are the degrees of freedom; three of its deviations are certain.
    ratio = float((square / noise).mean())
    certain = ratio > 1 + 3 / math.sqrt(full.sum())
    return math.sqrt(max(0.0, float((square - noise).mean()))), bool(certain)


def _precision(error: NDArray[np.float64]) -> tuple[float, float]:
    """An error of the ladder and the share of the picture that keeps it.

    The least that nearly all keeps, if it is good; else what is good, if a tenth keeps it; else
    the least that half does.
    """
    shares = [float(np.mean(error < step)) for step in LADDER]
    for step, share in zip(LADDER, shares, strict=True):
        if step <= GOOD and share >= GOOD_SHARE:
            return step, share
    for step, share in zip(LADDER, shares, strict=True):
        if share >= (0.1 if step == GOOD else 0.5) and step >= GOOD:
            return step, share
    return LADDER[-1], shares[-1]


def _where(
    error: NDArray[np.float64],
    shown: NDArray[np.bool_],
    pixels: NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[str, bool]:
    """The parts of the picture that are not good, in words."""
    places = thirds(error[shown] >= GOOD, pixels[shown], size)
    return named(places) if places else ("", False)


def _view_advice(
    views: list[View],
    error: NDArray[np.float64],
    pixels: NDArray[np.float64],
    size: tuple[int, int],
) -> list[str]:
    """The views to take, those at one place together."""
    groups: dict[tuple[str, float], list[View]] = {}
    for view in views:
        groups.setdefault((view.place, view.size), []).append(view)
    lines: list[str] = []
    side = "of the picture's longer side"
    for (place, share), group in groups.items():
        corners = np.concatenate([v.corners.reshape(-1, 2) for v in group])
        low, high = corners.min(axis=0), corners.max(axis=0)
        inside = ((pixels >= low) & (pixels <= high)).all(axis=-1)
        now = float(np.percentile(error[inside], 90)) if inside.any() else math.inf
        state = f"known to {now:.2g} px" if now < UNSEEN else "not known yet, in part"
        tilts = list(dict.fromkeys(v.tilt for v in group))
        slanted = [t for t in tilts if t.startswith("its")]
        held = [t for t in tilts if t not in slanted]
        if slanted:
            held.append(f"tilted by {TILT:.0f} degrees, {' and '.join(slanted)}")
        lines.append(
            f"take {_count(len(group), 'view')} with the board {_at(place)}, as large as "
            f"{100 * share:.0f} % {side}, {' and '.join(held)}: there the "
            f"lens is {state}"
        )
    return lines


def _other_advice(
    lens: Lens, target: Target, files: Sequence[str] | None, blur: float, *, changed: bool
) -> list[str]:
    """On views that were misread, a bent board and blur; a lens that changed explains views."""
    lines = [] if changed else _misread_advice(lens, files)
    width = float(np.ptp(target.points()[..., :2].reshape(-1, 2), axis=0).max())
    bow = float(np.abs(lens.bow).max())
    if bow > BENT * width:
        lines.append(
            f"fix the board on something flat: its middle stands {1000 * bow:.1f} mm out of "
            f"{1000 * width:.0f} mm"
        )
    if blur > BLURRED:
        lines.append(
            f"sharper pictures: their edges are spread by {blur:.1f} px (focus, a shorter "
            "exposure, the board held still)"
        )
    return lines


def _misread_advice(lens: Lens, files: Sequence[str] | None) -> list[str]:
    """On views that do not fit, as a whole or in part."""
    lines: list[str] = []
    found = np.isfinite(lens.observed[..., 0]).sum(axis=(1, 2))
    rejected = lens.outliers.sum(axis=(1, 2))
    why = "was the board misread, moving or bent, or very near?"
    posed = np.isfinite(lens.camera_from_board).all(axis=-1)
    whole: list[int] = np.flatnonzero(~posed).tolist()
    if whole:
        names = ", ".join(_name(view, files) for view in whole[:NAMED])
        more = f" and {len(whole) - NAMED} more" if len(whole) > NAMED else ""
        they = "it does not fit and counts" if len(whole) == 1 else "they do not fit and count"
        lines.append(f"take {names}{more} again or leave out: {they} for nothing ({why})")
    share = np.where(posed, rejected / np.maximum(found, 1), 0.0)
    for view in np.argsort(-share)[: min(NAMED, int((share > REJECTED).sum()))].tolist():
        lines.append(
            f"take {_name(view, files)} again or leave it out: {rejected[view]} of its "
            f"{found[view]} corners do not fit ({why})"
        )
    return lines


def _changed(change: Change, views: int, files: Sequence[str] | None) -> str:
    """What a lens that changed midway asks for."""
    return (
        f"zoom or focus changed: from {_name(change.first, files)} on, the last "
        f"{views - change.first} of {views} views, everything is {change.magnification:.4g} +- "
        f"{change.error:.2g} times as large; calibrate the views before and after by themselves"
    )


def _name(view: int, files: Sequence[str] | None) -> str:
    return f"view {view}" if files is None else files[view]


def _systematic(
    excess: float, misfit: float, pattern: float, repeated: bool, searched: bool
) -> str:
    """What noise does not explain, and what may."""
    measured: list[str] = []
    if not math.isnan(excess):
        measured.append(
            f"halves of the views differ {excess:.1f} times more than noise explains"
        )
    if misfit > MISFIT:
        measured.append(f"left-out views miss by {misfit:.1f} times what it explains")
    if repeated and pattern > GOOD / 2:
        measured.append(f"residuals have {pattern:.2f} px in common at the same places")
    do = "" if searched else "try --model auto; "
    return (
        f"{do}keep board, focus and zoom fixed, without stabiliser or rolling shutter: "
        + " and ".join(measured)
    )


def _at(place: str) -> str:
    return "in the middle" if place == "middle" else f"at the {place}"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
