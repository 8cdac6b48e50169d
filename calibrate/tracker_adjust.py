"""The least squares behind :mod:`chromeball.calibrate.tracker`: residuals, derivatives, steps.

Turns are perturbed from the left, exp(w) R. A view's own six unknowns, the turn and shift of
its camera_from_board, meet only in the thirteen shared ones: X, Z, delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.resection import cross_matrix
from chromeball.calibrate.tracker_log import Sampled, TrackerLog, right_jacobian, sample
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

SHARED = 13
AT_REST = (
    "the camera hardly moved while the pictures were taken, which leaves the delay open: give "
    "--delay (0 for pictures taken at rest), or move while they are taken"
)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a pixel coordinate, of a position and a turn an axis (m, rad)."""

    pixel: float
    position: float
    rotation: float

    def floored(self) -> Noise:
        """None of them zero, for data without noise."""
        return Noise(max(self.pixel, 1e-5), max(self.position, 1e-8), max(self.rotation, 1e-8))

    def like(self, other: Noise) -> bool:
        """Whether both are the same to a part in a thousand."""
        pairs = (
            (self.pixel, other.pixel),
            (self.position, other.position),
            (self.rotation, other.rotation),
        )
        return all(abs(a - b) <= 1e-3 * b for a, b in pairs)


@dataclass(frozen=True)
class State:
    """All unknowns; ``rotations`` (V, 3, 3), ``translations`` (V, 3) are camera_from_board."""

    sensor_from_camera: Pose
    tracker_from_board: Pose
    delay: float
    rotations: Array
    translations: Array


@dataclass(frozen=True)
class _Normal:
    """Normal equations: ``own`` (V, 6, 6), ``between`` (V, 6, 13), ``shared`` (13, 13)."""

    own: Array
    between: Array
    shared: Array
    own_gradient: Array
    shared_gradient: Array
    cost: float


@dataclass(frozen=True)
class Rows:
    """What was measured: V pictures of N corners, and the log at their ``clock``."""

    camera: CameraModel
    points: Array
    pixels: Array
    log: TrackerLog
    clock: Array
    window: float
    views: NDArray[np.intp]
    seen: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "seen", np.isfinite(self.pixels).all(axis=-1))

    def sensor(self, delay: float) -> Sampled:
        """The tracker's word on each picture."""
        if self.log.times is not None:
            return sample(self.log, self.clock + delay, self.window)
        one = np.ones(len(self.views))
        still = np.zeros((len(self.views), 3))
        return Sampled(
            self.log.positions[self.views],
            self.log.rotations[self.views],
            still, still, one, 0 * one, 0 * one, one,
        )  # fmt: skip

    def raw(self, state: State) -> tuple[Array, Array, Array]:
        """Residuals: pixels (V, N, 2), and positions and turns (V, 3), these over the share
        of a sample's noise that they hold.
        """  # noqa: D205
        pixel = self._pixels(state)[0]
        sensor = self.sensor(state.delay)
        place, turn = self._tracker(state, sensor)[:2]
        share = np.sqrt(sensor.variance)[:, None]
        return pixel, place / share, turn / share

    def distances(self, state: State, noise: Noise) -> Array:
        """Squared distance of tracker and picture in standard deviations, (V,)."""
        _, place, turn = self.raw(state)
        return ((place / noise.position) ** 2).sum(axis=1) + ((turn / noise.rotation) ** 2).sum(
            axis=1
        )

    def normal(self, state: State, noise: Noise, weights: Array, free_delay: bool) -> _Normal:
        """Normal equations at `state`, tracker rows times `weights` (V,)."""
        error, j = self._pixels(state)
        error, j = np.nan_to_num(error) / noise.pixel, j / noise.pixel
        residual, own, shared = self.tracker_rows(state, noise, free_delay)
        w = weights[:, None, None]
        flat, slope = error.reshape(len(error), -1), j.reshape(len(j), -1, 6)
        own_t = np.swapaxes(own, 1, 2) * w
        shared_t = np.swapaxes(shared, 1, 2) * w
        cost = float((flat**2).sum() + (weights * (residual**2).sum(axis=1)).sum())
        return _Normal(
            own=np.swapaxes(slope, 1, 2) @ slope + own_t @ own,
            between=own_t @ shared,
            shared=(shared_t @ shared).sum(axis=0),
            own_gradient=np.einsum("vni,vn->vi", slope, flat)
            + (own_t @ residual[..., None])[..., 0],
            shared_gradient=(shared_t @ residual[..., None])[..., 0].sum(axis=0),
            cost=cost,
        )

    def tracker_rows(
        self, state: State, noise: Noise, free_delay: bool
    ) -> tuple[Array, Array, Array]:
        """Residuals (V, 6) in standard deviations, derivatives (V, 6, 6) and (V, 6, 13).

        A pose between samples holds only a share of their noise, sqrt(sum w^2), which changes
        with the delay. Dividing by it, and counting that in the derivative, keeps the delay
        from being drawn to the middle between samples, where the noise is least.
        """
        sensor = self.sensor(state.delay)
        place, turn, own, shared = self._tracker(state, sensor)
        residual = np.concatenate([place, turn], axis=1)
        shrink = (sensor.mixed / sensor.variance)[:, None]
        shared[:, :, 12] = (shared[:, :, 12] - residual * shrink) if free_delay else 0.0
        sigma = np.repeat([noise.position, noise.rotation], 3)
        scale = 1 / (np.sqrt(sensor.variance * sensor.shared)[:, None] * sigma)
        return residual * scale, own * scale[..., None], shared * scale[..., None]

    def slope_noise(self, delay: float) -> Array:
        """Variance of a derivative by the delay from the log's noise alone, (V,), 1/s^2."""
        s = self.sensor(delay)
        return (s.slope_variance - s.mixed**2 / s.variance) / (s.variance * s.shared)

    def components(
        self, state: State, noise: Noise, used: NDArray[np.bool_], free_delay: bool
    ) -> Noise:
        """The noises anew: sums of squares over their redundancies (Foerstner 1979)."""
        weights = used.astype(float)
        normal = self.normal(state, noise, weights, free_delay)
        spread, inverse, coupling = _reduced(normal, free_delay)
        # Covariance of a view's own unknowns, and of them with the shared ones.
        own = inverse + coupling @ spread @ np.swapaxes(coupling, 1, 2)
        cross = -coupling @ spread
        error, j = self._pixels(state)
        error, j = np.nan_to_num(error) / noise.pixel, j / noise.pixel
        slope = j.reshape(len(j), -1, 6)
        taken = np.einsum("vni,vij,vnj->", slope, own, slope)
        pixel = _component(noise.pixel, error, 2 * int(self.seen.sum()) - float(taken))
        residual, j_own, j_shared = self.tracker_rows(state, noise, free_delay)
        residual = residual * np.sqrt(self.sensor(state.delay).shared)[:, None]
        diagonal = (
            np.einsum("vni,vij,vnj->vn", j_own, own, j_own)
            + 2 * np.einsum("vni,vij,vnj->vn", j_own, cross, j_shared)
            + np.einsum("vni,ij,vnj->vn", j_shared, spread, j_shared)
        )[used]
        first, second = (
            _component(sigma, residual[used][:, k], 3 * used.sum() - diagonal[:, k].sum())
            for sigma, k in ((noise.position, slice(0, 3)), (noise.rotation, slice(3, 6)))
        )
        return Noise(pixel, first, second).floored()

    def _pixels(self, state: State) -> tuple[Array, Array]:
        """Projected minus seen (V, N, 2), NaN where not seen; derivatives (V, N, 2, 6)."""
        turned = np.einsum("vij,nj->vni", state.rotations, self.points)
        q, slope = self.camera.project_with_jacobian(turned + state.translations[:, None])
        error = np.where(self.seen[..., None], q - self.pixels, np.nan)
        j = np.concatenate([-slope @ cross_matrix(turned), slope], axis=-1)
        return error, np.where(self.seen[..., None, None], j, 0.0)

    def _tracker(self, state: State, sensor: Sampled) -> tuple[Array, Array, Array, Array]:
        """Measured minus expected position and turn (V, 3), in metres and radians.

        Expected is Z C^-1 X^-1; the turn is Log(expected' measured), in the sensor's axes.
        """
        from scipy.spatial.transform import Rotation

        x, z = state.sensor_from_camera, state.tracker_from_board
        back = np.swapaxes(state.rotations, 1, 2)
        centre = -(back @ state.translations[..., None])[..., 0]  # the camera on the board
        expected = z.rotation @ back @ x.rotation.T
        lever = expected @ x.translation
        there = centre @ z.rotation.T
        place = sensor.positions - (there + z.translation - lever)
        turn = Rotation.from_matrix(np.swapaxes(expected, 1, 2) @ sensor.rotations).as_rotvec()
        count = len(place)
        # expected -> expected exp(eps), eps = expected' zeta - R_X omega - xi
        eps_own = np.zeros((count, 3, 6))
        eps_own[:, :, :3] = -x.rotation
        eps = np.zeros((count, 3, SHARED))
        eps[:, :, :3] = -np.eye(3)
        eps[:, :, 6:9] = np.swapaxes(expected, 1, 2)
        arm = expected @ cross_matrix(x.translation)  # d (expected t_X) = -arm eps
        own, shared = np.zeros((count, 6, 6)), np.zeros((count, 6, SHARED))
        own[:, :3, :3] = z.rotation @ back @ cross_matrix(state.translations)
        own[:, :3, 3:] = z.rotation @ back
        own[:, :3] -= arm @ eps_own
        shared[:, :3] = -arm @ eps
        shared[:, :3, 3:6] = expected
        shared[:, :3, 6:9] += cross_matrix(there)
        shared[:, :3, 9:12] = -np.eye(3)
        shared[:, :3, 12] = sensor.velocities
        left = np.linalg.inv(right_jacobian(-turn))  # J_l(e) = J_r(-e)
        own[:, 3:] = -left @ eps_own
        shared[:, 3:] = -left @ eps
        right = np.linalg.inv(right_jacobian(turn))
        shared[:, 3:, 12] = (right @ sensor.spins[..., None])[..., 0]
        return place, np.asarray(turn, float), own, shared


def adjust(
    rows: Rows,
    state: State,
    noise: Noise,
    weights: Array,
    free_delay: bool,
    steps: int = 60,
) -> State:
    """The most likely state near `state`: Levenberg-Marquardt, each view eliminated."""
    damping = 1e-4
    normal = rows.normal(state, noise, weights, free_delay)
    for _ in range(steps):
        candidate = _stepped(state, normal, damping, free_delay, rows.log.interval)
        new = rows.normal(candidate, noise, weights, free_delay)
        if math.isfinite(new.cost) and new.cost <= normal.cost:
            gain = normal.cost - new.cost
            state, normal = candidate, new
            damping = max(damping / 10, 1e-12)
            if gain <= 1e-10 * (1 + new.cost):
                break
        elif damping > 1e10:
            break
        else:
            damping *= 10
    return state


def covariance(
    rows: Rows, state: State, noise: Noise, used: NDArray[np.bool_], free_delay: bool
) -> tuple[Array, float]:
    """Covariance (13, 13) of the shared unknowns, and the condition of their equations.

    The log's velocities are noisy, too: what they add to the delay's information is known and
    taken off. With H the sound part and S the whole, the covariance is H^-1 S H^-1.

    Raises
    ------
    UserError
        When the motion leaves an unknown open.

    """
    normal = rows.normal(state, noise, used.astype(float), free_delay)
    whole = _schur(normal)[0]
    kept = SHARED if free_delay else SHARED - 1
    whole = whole[:kept, :kept]
    size = np.sqrt(np.diag(whole))
    condition = float(np.linalg.cond(whole / np.outer(size, size))) if size.all() else math.inf
    if not condition < 1e14:
        raise UserError(
            AT_REST if free_delay else "the motion leaves the camera's place on the sensor open"
        )
    sound = whole.copy()
    if free_delay:
        extra = 6 * rows.slope_noise(state.delay)[used]
        alone = 1 / np.linalg.inv(whole)[12, 12]  # information, the other unknowns being free
        if alone - extra.sum() <= 4 * math.sqrt(float((extra**2).sum()) / 3):
            raise UserError(AT_REST)
        sound[12, 12] -= extra.sum()
    back = np.linalg.inv(sound)
    spread = np.zeros((SHARED, SHARED))
    spread[:kept, :kept] = back @ whole @ back
    return spread, condition


def _schur(normal: _Normal, damping: float = 0.0) -> tuple[Array, Array, Array]:
    """Schur complement (13, 13), inverses (V, 6, 6), those times the coupling (V, 6, 13)."""
    axis = np.arange(6)
    own = normal.own.copy()
    own[:, axis, axis] *= 1 + damping
    inverse = np.linalg.inv(own)
    coupling = inverse @ normal.between
    shared = normal.shared + damping * np.diag(np.diag(normal.shared))
    return (
        shared - (np.swapaxes(normal.between, 1, 2) @ coupling).sum(axis=0), inverse, coupling
    )  # fmt: skip


def _reduced(normal: _Normal, free_delay: bool) -> tuple[Array, Array, Array]:
    schur, inverse, coupling = _schur(normal)
    kept = SHARED if free_delay else SHARED - 1
    spread = np.zeros((SHARED, SHARED))
    spread[:kept, :kept] = np.linalg.pinv(schur[:kept, :kept], rcond=1e-14)
    return spread, inverse, coupling


def _stepped(
    state: State, normal: _Normal, damping: float, free_delay: bool, reach: float
) -> State:
    """One damped step, the delay's no longer than `reach`."""
    from scipy.spatial.transform import Rotation

    schur, inverse, coupling = _schur(normal, damping)
    own = (inverse @ normal.own_gradient[..., None])[..., 0]
    right = -normal.shared_gradient + np.einsum("vji,vj->i", normal.between, own)
    kept = SHARED if free_delay else SHARED - 1
    size = np.sqrt(np.abs(np.diag(schur))[:kept]) + 1e-300
    step = np.zeros(SHARED)
    scaled = schur[:kept, :kept] / np.outer(size, size)
    step[:kept] = np.linalg.lstsq(scaled, right[:kept] / size, rcond=1e-15)[0] / size
    if free_delay:
        step[12] = np.clip(step[12], -reach, reach)
    views = -own - coupling @ step
    x, z = state.sensor_from_camera, state.tracker_from_board
    turns = Rotation.from_rotvec(views[:, :3]) * Rotation.from_matrix(state.rotations)
    return State(
        moved(x, step[:6]),
        moved(z, step[6:12]),
        state.delay + float(step[12]),
        turns.as_matrix(),
        state.translations + views[:, 3:],
    )


def moved(pose: Pose, step: Array) -> Pose:
    """Turned from the left by the first three of `step`, shifted by the others."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec(step[:3]) * Rotation.from_matrix(pose.rotation)
    return Pose(turned.as_matrix(), pose.translation + step[3:])


def _component(sigma: float, error: Array, redundancy: float) -> float:
    return sigma * math.sqrt(float((error**2).sum()) / max(redundancy, 1.0))
