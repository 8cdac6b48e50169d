"""What :mod:`chromeball.calibrate.match` refuses or tells: mirrored, wrong, as good."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.resection import K1, UNKNOWNS, Evidence, Fit, focals, refine
from chromeball.calibrate.wrong_click import SOUND, WrongClick, wrong_clicks
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Solve = Callable[[Evidence], list[Fit]]

#: Among more points one wrong one does not keep the start from the others' solution.
FEW = 20


def refuse_mirrored(evidence: Evidence, width: int, solve: Solve) -> None:
    """Refuse clicks, which no camera fits, if one fits their mirror image.

    Raises
    ------
    UserError
        They are mirrored.

    """
    flip, shift = np.array([-1.0, 1]), np.array([width - 1.0, 0])
    mirrored = replace(
        evidence,
        pixels=shift + flip * evidence.pixels,
        ends=shift + flip * evidence.ends,
        centre=shift + flip * evidence.centre,
    )
    fits = solve(mirrored)
    if not fits:
        return
    spare = len(fits[0].rows) - fits[0].jacobian.shape[1]
    if spare > 0 and fits[0].cost <= SOUND**2 * spare:
        raise UserError(
            "these points are seen mirrored: pixels count from the picture's upper left "
            "corner, u to the right and v down, and x, y, z are right-handed with y up; "
            "correct the sign of one of them"
        )


def wrong_points(
    evidence: Evidence, best: Fit, spare: int, free: NDArray[np.bool_], solve: Solve
) -> tuple[WrongClick, ...]:
    """Points that the others contradict, from `best` on, or from the start anew."""

    def anew(fewer: Evidence) -> Fit | None:
        fits = solve(fewer)
        return fits[0] if fits else None

    def onward(fewer: Evidence) -> Fit | None:
        return refine(best.camera, best.pose, fewer, free)

    found = wrong_clicks(evidence, best, spare, onward)
    misfits = spare > 0 and best.cost > SOUND**2 * spare
    if not found and misfits and len(evidence.points) <= FEW:
        return wrong_clicks(evidence, best, spare, anew)
    return found


def told_apart(a: Fit, b: Fit, free: NDArray[np.bool_], square: float) -> bool:
    """Whether two solutions lie apart beyond both's standard errors, `square` of them squared.

    Along a valley of the cost steps end at many places, which are one solution.
    """
    turn = a.pose.rotation @ b.pose.rotation.T
    step = np.zeros(UNKNOWNS)
    k, c = a.camera.intrinsics, b.camera.intrinsics
    n = focals(a.camera)
    step[0] = math.log(k[0] / c[0])
    step[1:3] = k[n : n + 2] - c[n : n + 2]
    step[3:6] = Pose(turn, np.zeros(3)).rotation_vector()
    step[6:9] = a.pose.translation - turn @ b.pose.translation
    if free[9]:
        step[9] = k[K1] - c[K1]
    return all(float(((fit.jacobian @ step[free]) ** 2).sum()) > square for fit in (a, b))
