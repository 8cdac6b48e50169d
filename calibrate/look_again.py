"""The second look: a solved camera says where all of a board's corners are, how tilted.

Corners that the first look missed, near a fisheye's rim or a picture's edge, are won, and all
of them are measured with the board drawn as the lens shows it there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, camera_points
from chromeball.calibrate.choose import pose_errors
from chromeball.calibrate.detect import grey
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.grow import Found, fit_all, fit_blur
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.patch import BLURS
from chromeball.calibrate.printed import Printed, board_of
from chromeball.calibrate.solve import Fit
from chromeball.calibrate.target import CircleGrid, Target
from chromeball.scene.image import read_image
from chromeball.scene.pose import Pose

#: A corner this many pixels from where the camera expects it is not the board's.
TOLERANCE = 2.0
#: Parts of the views that are left out in turn.
FOLDS = 2
#: Half a side of the square about a corner whose picture gives its homography, in squares.
NEAR = 0.45


@dataclass(frozen=True)
class SecondLook:
    """``lens`` and ``detections`` after it, ``won`` corners that the first look had missed.

    ``before`` and ``after`` are the RMS of the first look's corners on pictures left out of the
    solution, by lenses of the first and of the second look's corners; equal where nothing was
    won and nothing solved anew. The second lens is ``kept`` if it is not the worse one.
    """

    lens: Lens
    detections: list[Detection]
    won: int
    before: float
    after: float

    @property
    def kept(self) -> bool:
        """Whether lens and detections are the second look's."""
        return self.won > 0 and self.after <= self.before


def look_again(
    detections: Sequence[Detection],
    lens: Lens,
    target: Target,
    model: str,
    start: Fit | None = None,
) -> SecondLook:
    """What the `lens`, solved as `model` from `detections`, helps to see in the same pictures.

    `start` is a fit of these views, if there is one already.

    Views that the lens could not place stay as they are, and so do grids of circles.
    """
    better = look_with(detections, lens, target)
    won = sum(d.count for d in better) - sum(d.count for d in detections)
    if not won:
        return SecondLook(lens, list(detections), 0, math.nan, math.nan)
    first, second = (np.array([d.corners for d in ds]) for ds in (detections, better))
    before, after = (
        _held_out(corners, first, target, lens, model, start) for corners in (first, second)
    )
    if after > before:
        return SecondLook(lens, list(detections), won, before, after)
    paths = [str(d.file) for d in detections]
    again = calibrate_lens(second, target, lens.camera.size, model, paths, start)
    return SecondLook(again, better, won, before, after)


def look_with(detections: Sequence[Detection], lens: Lens, target: Target) -> list[Detection]:
    """The detections with corners measured where the lens says that they are."""
    if isinstance(target, CircleGrid):
        return list(detections)
    better: list[Detection] = []
    for detection, frame in zip(detections, lens.camera_from_board, strict=True):
        if not np.isfinite(frame).all():
            better.append(detection)
            continue
        pose = Pose.from_rotation_vector(frame[:3], frame[3:])
        view = Estimate(
            lens.camera, lens.bow, pose.rotation[None], pose.translation[None], lens.pupil
        )
        picture = grey(read_image(detection.file))
        better.append(
            _merged(detection, refine(picture, detection.printed, view, detection.blur))
        )
    return better


def _held_out(
    corners: NDArray[np.float64],
    judged: NDArray[np.float64],
    target: Target,
    lens: Lens,
    model: str,
    start: Fit | None,
) -> float:
    """Median of the views' RMS on `judged` corners by lenses of the other views' `corners`."""
    errors = np.full(len(corners), np.inf)
    for fold in range(FOLDS):
        out = np.arange(len(corners)) % FOLDS == fold
        if out.any():
            part = calibrate_lens(corners[~out], target, lens.camera.size, model, start=start)
            errors[out] = pose_errors(part, judged[out], target)
    return float(np.median(errors))


def refine(picture: NDArray[np.uint8], printed: Printed, view: Estimate, blur: float) -> Found:
    """Corners (rows * columns, 2) fitted where a known `view` of the board has them.

    `blur` is about the picture's.
    """
    target = printed.target
    places = target.points()[..., :2].reshape(-1, 2) / target.square
    expected, homographies = _predicted(picture.shape, target, view)
    if not homographies:
        nothing = np.full(len(places), np.nan)
        return Found(np.full_like(places, np.nan), nothing, np.nan)
    sides = [abs(np.linalg.det(_slope(h, places[i]))) for i, h in homographies.items()]
    board = board_of(printed, float(np.sqrt(np.median(sides))))
    about = min(BLURS, key=lambda b: abs(b - blur))
    fitted = fit_blur(picture, board, places, homographies, about)
    pixels, sigma = fit_all(picture, board, places, homographies, fitted)
    far = ~(np.linalg.norm(pixels - expected, axis=1) < TOLERANCE)
    pixels[far], sigma[far] = np.nan, np.nan
    return Found(pixels, sigma, fitted)


def _merged(detection: Detection, found: Found) -> Detection:
    """What the second look found, and what the first did where the second found nothing."""
    pixels = found.pixels.reshape(detection.corners.shape)
    sigma = found.sigma.reshape(detection.sigma.shape)
    again = np.isfinite(sigma)
    corners = np.where(again[..., None], pixels, detection.corners)
    won = int((again & np.isnan(detection.corners[..., 0])).sum())
    verdict = f"{detection.verdict}, {won} more" if won else detection.verdict
    return replace(
        detection,
        corners=corners,
        sigma=np.where(again, sigma, detection.sigma),
        verdict=verdict,
    )


def _predicted(
    shape: tuple[int, ...], target: Target, view: Estimate
) -> tuple[NDArray[np.float64], dict[int, NDArray[np.float64]]]:
    """Pixels (M, 2) of the corners, and homographies about those in the picture."""
    flat = target.points().reshape(-1, 3)
    square = target.square
    steps = np.stack(np.meshgrid([-NEAR, 0, NEAR], [-NEAR, 0, NEAR]), axis=-1).reshape(-1, 2)
    near = flat[:, None] + np.pad(steps * square, ((0, 0), (0, 1)))
    low, high = flat.min(axis=0)[:2], flat.max(axis=0)[:2]
    reach = (2 * near[..., :2] - low - high) / (high - low)
    near[..., 2] += (1 - reach**2) @ view.bow
    points = camera_points(replace(view, bow=np.zeros(2)), near)[0]
    pixels = view.camera.project(points)
    centre = pixels[:, 4]
    height, width = shape
    inside = (centre > 0).all(axis=1) & (centre < [width - 1, height - 1]).all(axis=1)
    homographies: dict[int, NDArray[np.float64]] = {}
    for i in np.flatnonzero(inside & np.isfinite(pixels).all(axis=(1, 2))).tolist():
        place = flat[i, :2] / square
        h = np.asarray(cv2.findHomography(place + steps, pixels[i])[0], float)
        # From behind nothing of the board is seen.
        if np.linalg.det(_slope(h, place)) > 0:
            homographies[i] = h
    return centre, homographies


def _slope(h: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (2, 2) of the homography's pixels by the place."""
    x, y, w = h @ np.append(place, 1.0)
    pixel = np.array([x, y]) / w
    return np.asarray((h[:2, :2] - pixel[:, None] * h[2, :2]) / w, float)
