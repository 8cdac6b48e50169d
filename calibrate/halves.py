"""The same lens from two halves of the views: what noise does not explain shows here."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.choose import view_errors
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.solve import Fit
from chromeball.calibrate.target import Target
from chromeball.calibrate.uncertainty import projection_slopes
from chromeball.calibrate.view_poses import pose_residuals
from chromeball.scene.camera import CameraModel

#: Of calling noise an excess.
RISK = 0.01


@dataclass(frozen=True)
class Halves:
    """Two lenses, of the even and of the odd views, beside each other.

    ``pixels`` (h, w, 2) over the picture; ``difference`` (h, w, 2) of where the second lens
    sees what the first sees there, the turn between the two taken out, NaN where one does not
    reach; ``excess`` its size over the corners as a multiple of what corner noise lets expect,
    ``chance`` the multiple that noise exceeds once in a hundred times; ``held_out`` (V,) the
    RMS per point of each view in the lens of the other half, and ``misfit`` its multiple of
    corner noise.
    """

    pixels: NDArray[np.float64]
    difference: NDArray[np.float64]
    excess: float
    chance: float
    held_out: NDArray[np.float64]
    misfit: float


def compare_halves(
    lens: Lens, target: Target, model: str, start: Fit | None = None, columns: int = 30
) -> Halves:
    """Solve both halves of a lens's views, without its outliers, and compare.

    `model` is the name by which the lens was solved, `start` a fit of all views.

    Raises
    ------
    UserError
        When half of the views do not determine a lens.

    """
    from scipy.stats import chi2

    corners = np.where(lens.outliers[..., None], np.nan, lens.observed)
    posed = np.flatnonzero(np.isfinite(lens.camera_from_board).all(axis=-1))
    even, odd = posed[::2], posed[1::2]
    size = lens.camera.size
    first, second = (
        calibrate_lens(corners[half], target, size, model, start=start) for half in (even, odd)
    )
    held_out = np.full(len(corners), np.nan)
    square, expected = 0.0, 0.0
    for half, other in ((even, second), (odd, first)):
        left = pose_residuals(other.camera, corners[half], target, other.bow, other.pupil)
        held_out[half] = view_errors(left, corners[half])
        seen = np.isfinite(left[..., 0])
        square += float((left[seen] ** 2).sum())
        expected += lens.sigma**2 * float(2 * seen.sum() - 6 * len(half))
    pixels, _ = lens.uncertainty(columns)
    support = corners[posed][np.isfinite(corners[posed][..., 0])]
    support = support[np.linspace(0, len(support) - 1, min(len(support), 2000)).astype(int)]
    covariance = first.covariance + second.covariance
    _, excess, freedom = lens_excess(first.camera, second.camera, covariance, support)
    return Halves(
        pixels,
        difference=lens_difference(first.camera, second.camera, pixels, support),
        excess=excess,
        chance=math.sqrt(float(chi2.ppf(1 - RISK, freedom)) / freedom),
        held_out=held_out,
        misfit=math.sqrt(square / max(expected, 1e-30)),
    )


def lens_excess(
    first: CameraModel,
    second: CameraModel,
    covariance: NDArray[np.float64],
    support: NDArray[np.float64],
) -> tuple[float, float, float]:
    """How far two lenses of one model are apart over pixels `support` (N, 2).

    RMS distance in pixels; its multiple of what the `covariance` (k, k) of their difference
    lets expect; and the degrees of freedom of that multiple's square.
    """
    there = lens_difference(first, second, support, support)
    rays = first.unproject(support)
    slopes = projection_slopes(first, rays, rays)
    both = np.isfinite(there[..., 0]) & np.isfinite(slopes).all(axis=(1, 2))
    # d = J x with x of covariance C: |d|^2 has mean tr(CJ'J) and, about, the law of chi-square
    # with tr(A)^2 / tr(A^2) degrees of freedom, A = CJ'J (Satterthwaite 1946).
    j = slopes[both].reshape(-1, slopes.shape[-1])
    a = covariance @ (j.T @ j)
    likely, freedom = float(np.trace(a)), float(np.trace(a) ** 2 / np.trace(a @ a))
    square = float((there[both] ** 2).sum())
    return math.sqrt(square / max(1, int(both.sum()))), math.sqrt(square / likely), freedom


def lens_difference(
    first: CameraModel,
    second: CameraModel,
    pixels: NDArray[np.float64],
    support: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Where `second` sees what `first` sees at `pixels`, less those, (..., 2).

    The turn between the two is that of least squares over the `support`, in pixels.
    """
    a, b = first.unproject(support), second.unproject(support)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    u, _, vt = np.linalg.svd(b[known].T @ a[known])  # Wahba's problem: b = R a
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    rays = first.unproject(pixels)
    with np.errstate(invalid="ignore"):
        back = np.linalg.norm(first.project(rays) - pixels, axis=-1) < 0.1
        seen = second.project(rays @ turn.T)
    return np.where(back[..., None], seen - pixels, np.nan)
