"""What the lights leave open is refused with the reason; what they settle gets its errors."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_adjust import Bundle, Freedom, linearise, residuals
from chromeball.calibrate.wand_result import Tracks, WandRig
from chromeball.calibrate.wand_stages import Stages
from chromeball.calibrate.wand_start import FEWEST_COMMON, LEAST_PARALLAX
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: The thinnest cloud of lights, its least deviation over the largest, that is no plane.
FLATTEST = 0.02
#: Less than this share of the lights of a camera that fits is no calibration.
LEAST_FIT = 0.35
#: Relative standard error of the focal length beyond which a lens is open.
WORST_FOCAL = 0.05
WORST_CONDITION = 1e14
#: Two cameras apart do not see a light move within so many pixels (median) of each other.
SAME_PICTURE = 1.0


def check_tracks(tracks: Tracks, cameras: tuple[CameraModel, ...] | None) -> None:
    """Refuse tracks that cannot determine the cameras, whatever the lenses."""
    count = len(tracks.names)
    if count < 2:
        raise UserError("a moving light places cameras beside each other: bring two or more")
    if cameras is not None and len(cameras) != count:
        raise UserError(f"{count} recordings need as many lenses, not {len(cameras)}")
    for c, camera in enumerate(cameras or ()):
        if camera.size != tracks.sizes[c]:
            width, height = tracks.sizes[c]
            raise UserError(
                f"{tracks.names[c]} is {width} x {height} pixels, its lens "
                f"{camera.size[0]} x {camera.size[1]}: are the lenses in the same order?"
            )
    seen = tracks.seen()
    _refuse_copies(tracks, seen)
    lights = tracks.pixels.shape[2]
    for name, number in zip(tracks.names, seen.sum(axis=1), strict=True):
        if number * lights < FEWEST_COMMON:
            raise UserError(f"{name} saw the light in {number} frames alone: record more")
    common = seen.astype(int) @ seen.T.astype(int) * lights
    linked = common >= FEWEST_COMMON
    groups = connected(linked)
    if len(groups) > 1:
        named = "; ".join(", ".join(tracks.names[c] for c in group) for group in groups)
        raise UserError(
            f"the cameras fall into {len(groups)} groups that no light connects: {named}. "
            f"Move the light where a camera of each sees it together with one of another"
        )


def _refuse_copies(tracks: Tracks, seen: NDArray[np.bool_]) -> None:
    """Refuse one recording under two names: a camera that is not there would seem found."""
    for a, b in combinations(range(len(tracks.names)), 2):
        both = seen[a] & seen[b]
        if tracks.sizes[a] != tracks.sizes[b] or not both.any():
            continue
        # The ends of a wand may be told apart in one and not in the other.
        one, other = (tracks.pixels[c, both].mean(axis=1) for c in (a, b))
        if float(np.median(np.linalg.norm(one - other, axis=-1))) < SAME_PICTURE:
            raise UserError(
                f"{tracks.names[a]} and {tracks.names[b]} show the light at the same pixels: "
                "they are one camera's recording twice"
            )


def connected(linked: NDArray[np.bool_]) -> list[list[int]]:
    """Groups of a symmetric graph (C, C), each sorted."""
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(linked, directed=False)
    return [np.flatnonzero(label == g).tolist() for g in range(count)]


def judge(
    stages: Stages,
    bundle: Bundle,
    used: NDArray[np.bool_],
    delays: NDArray[np.bool_],
    tracks: Tracks,
) -> WandRig:
    """The rig with its covariance."""
    seen = np.isfinite(stages.sightings.pixels[..., 0])
    shares = used.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1)
    worst = int(shares.argmin())
    if shares[worst] < LEAST_FIT:
        raise UserError(
            f"{tracks.names[worst]}: only {shares[worst]:.0%} of its lights fit the other "
            "cameras': are the recordings of the same moment, and its lens its own?"
        )
    live = used.any(axis=(0, 2))
    _check_cloud(bundle, used, live)
    sigma = stages.sigma(bundle, used)
    freedom = stages.freedom(sigma, 3, delays)
    spread, condition = _spread(stages, bundle, used, freedom)
    covariance, lens_errors, delay_errors = _by_camera(bundle, freedom, sigma**2 * spread)
    for c, camera in enumerate(bundle.cameras):
        _check_lens(tracks.names[c], camera, lens_errors[c])
    error = residuals(bundle, stages.sightings)
    names, first, base = tracks.names, stages.reference, stages.baseline
    return WandRig(
        names=names,
        cameras=tuple(
            camera.posed(_pose(r, t).inverse())
            for camera, r, t in zip(
                bundle.cameras, bundle.rotations, bundle.translations, strict=True
            )
        ),
        unit="m" if base is None else f"distance of {names[first]} and {names[base]}",
        points=np.where(live[:, None, None], bundle.points, np.nan),
        observed=stages.sightings.pixels,
        residuals=np.where(used[..., None], error, np.nan),
        outliers=seen & ~used,
        rms=math.sqrt(float((error[used] ** 2).sum(axis=-1).mean())),
        sigma=sigma,
        covariance=covariance,
        lens_errors=lens_errors,
        delays=bundle.delays,
        delay_errors=delay_errors,
        condition=condition,
        reference=first,
        baseline=base,
    )


def lens_errors(
    stages: Stages, bundle: Bundle, used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], ...]:
    """Standard errors of each camera's intrinsics, (k,)."""
    sigma = stages.sigma(bundle, used)
    freedom = stages.freedom(sigma, 3)
    spread, _ = _spread(stages, bundle, used, freedom)
    return _by_camera(bundle, freedom, sigma**2 * spread)[1]


def _spread(
    stages: Stages,
    bundle: Bundle,
    used: NDArray[np.bool_],
    freedom: Freedom,
) -> tuple[NDArray[np.float64], float]:
    """Covariance of the shared unknowns for weight one, and the condition."""
    _, system = linearise(bundle, stages.sightings, used, freedom)
    spread, condition = system.covariance()
    if not (np.isfinite(spread).all() and condition < WORST_CONDITION):
        raise UserError(
            "the lights leave the cameras open: move them through the whole volume that the "
            "cameras see, near and far"
        )
    return spread, condition


def _by_camera(
    bundle: Bundle, freedom: Freedom, spread: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Covariances (C, 6, 6) of turn and position, standard errors of lenses and of delays.

    With p_camera = R p + t the position is c = -R' t: dc = -R' [t] w - R' dt, where w turns
    R to exp(w) R.
    """
    count = len(bundle.cameras)
    covariance = np.zeros((count, 6, 6))
    delays = np.zeros(count)
    lenses: list[NDArray[np.float64]] = []
    for c, (pose, lens, delay) in enumerate(freedom.columns(bundle)):
        r, (x, y, z) = bundle.rotations[c], bundle.translations[c]
        change = np.zeros((6, 6))
        change[:3, :3] = -np.eye(3)
        change[3:, :3] = -r.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        change[3:, 3:] = -r.T
        change = change @ freedom.pose(bundle, c)
        covariance[c] = change @ spread[pose, pose] @ change.T
        basis = freedom.lens[c]
        lenses.append(np.sqrt(np.diag(basis @ spread[lens, lens] @ basis.T)))
        delays[c] = math.sqrt(float(spread[delay, delay].sum()))
    return covariance, tuple(lenses), delays


def _check_cloud(bundle: Bundle, used: NDArray[np.bool_], live: NDArray[np.bool_]) -> None:
    points = bundle.points[live].reshape(-1, 3)
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if sizes[1] < FLATTEST * sizes[0]:
        raise UserError("the lights lie in a line: move them through the whole volume")
    if sizes[2] < FLATTEST * sizes[0]:
        raise UserError(
            "the lights lie in a plane, which leaves cameras and lenses open: move them "
            "through the whole volume, near and far"
        )
    to = points - bundle.centres()[:, None]
    to /= np.linalg.norm(to, axis=-1, keepdims=True)
    here = used[:, live].reshape(len(used), -1)
    mean = np.where(here[..., None], to, 0).sum(axis=0)
    # Unit vectors that all point one way add up to their number.
    spread = 1 - np.linalg.norm(mean, axis=-1) / here.sum(axis=0)
    if float(np.median(spread)) < (LEAST_PARALLAX / 2) ** 2 / 2:
        raise UserError("the cameras stand at one place: lights tell nothing of distances")


def _check_lens(name: str, camera: CameraModel, errors: NDArray[np.float64]) -> None:
    focals = 2 if len(errors) > 3 else 1
    focal = float((errors[:focals] / camera.intrinsics[:focals]).max(initial=0.0))
    if not focal < WORST_FOCAL:
        raise UserError(
            f"{name}: the lights leave its focal length open (standard error {focal:.0%}): "
            "move them near and far, give its lens, or use a wand of known length"
        )


def _pose(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Pose:
    u, _, vt = np.linalg.svd(rotation)  # rounding alone
    return Pose(u @ vt, translation)
