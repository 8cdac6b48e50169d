"""Which click is wrong: each is left out in turn, and judged by where the others put it.

A click that is off by more than its noise bends the whole solution, and its residual hides
among those of its neighbours; without it the others fit. Twice the fall of the squared rows is
tested against what is left of them (an F test; Cook and Weisberg 1982, section 2.2), their
noise being at least what it is said to be.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.resection import Evidence, Fit
from chromeball.scene.errors import UserError

#: A sound set of clicks is suspected this often.
ALARM = 1e-3
#: Squared rows, in their noise's, by which two suspects are told apart: 3 sigma.
APART = 9.0
#: So many standard deviations off, a click is no slip of the hand but another point.
GROSS = 10.0
#: Clicks so many times as far off as they are said to be do not fit, whatever one of them does.
SOUND = 2.0


@dataclass(frozen=True)
class WrongClick:
    """Click ``index`` (from 0) lies ``miss`` pixels from where the others put it.

    ``scatter`` is the others' own standard deviation a coordinate, pixels. ``rivals`` are
    clicks that may be the wrong one as well.
    """

    index: int
    miss: float
    scatter: float
    rivals: tuple[int, ...] = ()

    @property
    def gross(self) -> bool:
        """Whether it is another point, not a click a little off."""
        return self.miss > GROSS * self.scatter

    def words(self, kind: str) -> str:
        """In a sentence's words; `kind` is what the clicks are called."""
        which = " or ".join(str(k + 1) for k in (self.index, *self.rivals))
        return (
            f"{kind} {which} lies {self.miss:.1f} px from where the others put it, which agree "
            f"to {self.scatter:.2g} px"
        )


def wrong_clicks(
    evidence: Evidence, fit: Fit, spare: int, refit: Callable[[Evidence], Fit | None]
) -> tuple[WrongClick, ...]:
    """Clicks of points in `evidence` that the others contradict, the worst first.

    `fit` is the solution with all of them, by `spare` numbers more than unknowns, and `refit`
    gives that of fewer. One after the other is left out while that helps beyond chance. None
    is named where the others do not fit either, nor more than a quarter: those are no slips.
    """
    kept = np.arange(len(evidence.points))
    found: list[tuple[int, tuple[int, ...]]] = []
    while spare > 2 and len(found) <= len(evidence.points) // 4:
        if _chance(fit.cost, 0.0, spare - 2, len(kept)) > ALARM:
            break  # no click's removal could help enough
        without = [(refit(_only(evidence, np.delete(kept, k))), k) for k in range(len(kept))]
        fits = sorted(
            ((other, k) for other, k in without if other is not None), key=lambda f: f[0].cost
        )
        if not fits:
            break
        best, k = fits[0]
        if _chance(fit.cost, best.cost, spare - 2, len(kept)) > ALARM:
            break
        noise = max(best.cost / (spare - 2), 1.0)
        rivals = tuple(
            int(kept[j]) for other, j in fits[1:] if other.cost - best.cost < APART * noise
        )
        found.append((int(kept[k]), rivals))
        kept, fit, spare = np.delete(kept, k), best, spare - 2
        if rivals:
            break
    misfit = math.sqrt(fit.cost / spare) if found else 1.0
    if misfit > SOUND or len(found) > len(evidence.points) / 4:
        return ()
    scatter = evidence.sigma * max(misfit, 1.0)
    return tuple(
        WrongClick(k, miss, scatter, rivals)
        for k, rivals in found
        if (miss := _miss(fit, evidence, k)) > math.sqrt(APART) * scatter
    )


def refuse_gross(wrong: tuple[WrongClick, ...], kind: str) -> None:
    """Refuse clicks that are other points; `kind` is what they are called.

    Raises
    ------
    UserError
        With the number of each.

    """
    if any(click.gross for click in wrong):
        told = "; ".join(click.words(kind) for click in wrong)
        raise UserError(f"{told}: correct or remove it")


def _only(evidence: Evidence, kept: NDArray[np.intp]) -> Evidence:
    return replace(evidence, points=evidence.points[kept], pixels=evidence.pixels[kept])


def _miss(fit: Fit, evidence: Evidence, k: int) -> float:
    there = fit.camera.project(fit.pose.apply(evidence.points[k]))
    off = float(np.linalg.norm(there - evidence.pixels[k]))
    return off if math.isfinite(off) else math.inf


def _chance(cost: float, without: float, spare: int, count: int) -> float:
    """That one of `count` sound clicks, left out, lets the squared rows fall as far."""
    from scipy import stats

    noise = max(without / spare, 1.0)
    return min(1.0, count * float(stats.f.sf((cost - without) / 2 / noise, 2, spare)))
