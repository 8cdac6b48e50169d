"""Bundle adjustment of cameras of any models that saw moving lights at the same instants.

Local are the lights of one instant, shared are poses, lenses and delays (Triggs et al. 2000,
section 6.1). The frame is that of the `reference` camera; its scale is that of the wand, or the
distance from there to the `baseline` camera is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import gradients
from chromeball.calibrate.arrow import Arrowhead, cauchy, descend
from chromeball.scene.camera import CameraModel


@dataclass(frozen=True)
class Bundle:
    """C cameras before F instants of a wand with K lights: p_camera = R p + t.

    ``rotations`` (C, 3, 3), ``translations`` (C, 3), ``points`` (F, K, 3); ``delays`` (C,): a
    camera's picture f was taken at the instant f + delay, in frames.
    """

    cameras: tuple[CameraModel, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    points: NDArray[np.float64]
    delays: NDArray[np.float64]

    def seen_by(self, camera: int) -> NDArray[np.float64]:
        """The points in a camera's axes, (F, K, 3)."""
        return self.points @ self.rotations[camera].T + self.translations[camera]

    def centres(self) -> NDArray[np.float64]:
        """Where the cameras stand, (C, 3)."""
        return -np.einsum("cji,cj->ci", self.rotations, self.translations)

    def scaled(self, factor: float) -> Bundle:
        """The same rig, `factor` times as large."""
        return replace(
            self, translations=self.translations * factor, points=self.points * factor
        )

    def turned_to(self, reference: int) -> Bundle:
        """In the axes of camera `reference`."""
        r, t = self.rotations[reference], self.translations[reference]
        rotations = self.rotations @ r.T
        translations = self.translations - rotations @ t
        rotations[reference], translations[reference] = np.eye(3), 0.0
        return replace(
            self,
            rotations=rotations,
            translations=translations,
            points=self.points @ r.T + t,
        )


@dataclass(frozen=True)
class Sightings:
    """Where the lights were seen, at the instants that `delays` mean.

    ``pixels`` (C, F, K, 2) NaN where not seen; ``weights`` (C, F, K), of squares;
    ``speeds`` (C, F, K, 2) pixels a frame, ``delays`` (C,) frames, as in :class:`Bundle`.
    """

    pixels: NDArray[np.float64]
    weights: NDArray[np.float64]
    speeds: NDArray[np.float64]
    delays: NDArray[np.float64]

    def frames(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Sightings:
        """Some of the frames."""
        return replace(
            self,
            pixels=self.pixels[:, chosen],
            weights=self.weights[:, chosen],
            speeds=self.speeds[:, chosen],
        )


@dataclass(frozen=True)
class Freedom:
    """What is unknown.

    ``lens`` for each camera the directions in which its intrinsics may change, (k, m);
    ``usual`` their usual values (k,) and ``precision`` (k,) how well these are known, inverse
    variances times a pixel's. ``delays`` (C,) which are unknown. ``baseline`` is the camera
    whose distance to ``reference`` stays, None where `lengths` of the wand set the scale:
    (first light, second light, metres), each kept to `tolerance` times a pixel's deviation.
    """

    lens: tuple[NDArray[np.float64], ...]
    usual: tuple[NDArray[np.float64], ...]
    precision: tuple[NDArray[np.float64], ...]
    delays: NDArray[np.bool_]
    reference: int = 0
    baseline: int | None = None
    lengths: tuple[tuple[int, int, float], ...] = ()
    tolerance: float = math.inf

    def pose(self, bundle: Bundle, camera: int) -> NDArray[np.float64]:
        """Directions in which a camera's turn and translation may change, (6, m)."""
        if camera == self.reference:
            return np.zeros((6, 0))
        if camera != self.baseline:
            return np.eye(6)
        along = bundle.translations[camera]
        across = np.linalg.svd(along[None] / np.linalg.norm(along))[2][1:]
        basis = np.zeros((6, 5))
        basis[:3, :3], basis[3:, 3:] = np.eye(3), across.T
        return basis

    def columns(self, bundle: Bundle) -> list[tuple[slice, slice, slice]]:
        """Where each camera's pose, lens and delay stand among the shared unknowns."""
        found: list[tuple[slice, slice, slice]] = []
        at = 0
        for camera, lens in enumerate(self.lens):
            widths = (
                self.pose(bundle, camera).shape[1],
                lens.shape[1],
                int(self.delays[camera]),
            )
            ends = at + np.cumsum(widths)
            starts = ends - widths
            pose, own, delay = (
                slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)
            )
            found.append((pose, own, delay))
            at = int(ends[-1])
        return found


def residuals(bundle: Bundle, sightings: Sightings) -> NDArray[np.float64]:
    """Projected minus observed, (C, F, K, 2); NaN where not seen."""
    return np.array(
        [
            camera.project(bundle.seen_by(c)) - _observed(bundle, sightings, c)
            for c, camera in enumerate(bundle.cameras)
        ]
    )


def adjust(
    start: Bundle,
    sightings: Sightings,
    used: NDArray[np.bool_],
    freedom: Freedom,
    *,
    scale: float = math.inf,
    steps: int = 30,
    least_gain: float = 1e-10,
) -> Bundle:
    """The bundle of least cost over the lights `used` (C, F, K).

    Every light of a frame that is used must be seen by two cameras. `scale` is Cauchy's in
    pixels, infinite for least squares. The start is returned as it is where a camera does not
    see a light that it is said to have seen.
    """

    def move(
        bundle: Bundle, shared: NDArray[np.float64], local: NDArray[np.float64]
    ) -> Bundle | None:
        return _moved(bundle, freedom, shared, local)

    return descend(
        start,
        lambda bundle: linearise(bundle, sightings, used, freedom, scale),
        move,
        steps=steps,
        least_gain=least_gain,
    )


def linearise(
    bundle: Bundle,
    sightings: Sightings,
    used: NDArray[np.bool_],
    freedom: Freedom,
    scale: float = math.inf,
) -> tuple[float, Arrowhead]:
    """Cost and normal equations; a pose's change is exp(w) R, t + dt."""
    frames, lights = bundle.points.shape[:2]
    places = freedom.columns(bundle)
    system = Arrowhead.empty(places[-1][2].stop, frames, 3 * lights)
    cost = 0.0
    for c, camera in enumerate(bundle.cameras):
        blocks = np.flatnonzero(used[c].any(axis=1))
        if not len(blocks):
            continue
        here = used[c, blocks]
        turned = bundle.points[blocks] @ bundle.rotations[c].T
        q, by_point, by_intrinsics = gradients(camera, turned + bundle.translations[c])
        error = np.where(here[..., None], q - _observed(bundle, sightings, c)[blocks], 0.0)
        pose = np.concatenate(
            [np.cross(turned[..., None, :], by_point), by_point], axis=-1
        ) @ freedom.pose(bundle, c)
        parts = [pose, by_intrinsics @ freedom.lens[c]]
        if freedom.delays[c]:
            parts.append(sightings.speeds[c, blocks][..., None])
        shared = np.concatenate(parts, axis=-1)
        own = by_point @ bundle.rotations[c]
        shared[~here], own[~here] = 0.0, 0.0
        known = sightings.weights[c, blocks]
        square = np.where(here, known, 0.0) * (error**2).sum(axis=-1)
        if not (np.isfinite(square).all() and np.isfinite(shared).all()):
            return math.inf, system
        part, weight = cauchy(square, here, scale)
        cost += part
        weight = np.where(here, weight * known, 0.0)
        by_local = np.zeros((len(blocks), lights, 2, lights, 3))
        for k in range(lights):
            by_local[:, k, :, k] = own[:, k]
        rows = (len(blocks), 2 * lights)
        part_of = Arrowhead.of(
            shared.reshape(*rows, shared.shape[-1]),
            by_local.reshape(*rows, 3 * lights),
            error.reshape(rows),
            np.repeat(weight, 2, axis=1),
        )
        system.include(part_of, np.arange(places[c][0].start, places[c][2].stop), blocks)
    live = used.any(axis=(0, 2))
    system.local[~live] = np.eye(3 * lights)  # nothing is known of these, nothing changes
    cost += _add_lengths(system, bundle, freedom, live)
    cost += _add_usual(system, bundle, freedom, places)
    return cost if math.isfinite(cost) else math.inf, system


def _observed(bundle: Bundle, sightings: Sightings, camera: int) -> NDArray[np.float64]:
    """Where a camera saw the lights at the common instants, (F, K, 2)."""
    later = bundle.delays[camera] - sightings.delays[camera]
    if later == 0:
        return sightings.pixels[camera]
    return sightings.pixels[camera] - later * sightings.speeds[camera]


def _add_lengths(
    system: Arrowhead, bundle: Bundle, freedom: Freedom, live: NDArray[np.bool_]
) -> float:
    """The wand's lengths; returns their cost."""
    cost = 0.0
    blocks = np.flatnonzero(live)
    for first, second, length in freedom.lengths:
        apart = bundle.points[blocks, first] - bundle.points[blocks, second]
        distance = np.linalg.norm(apart, axis=-1)
        by_local = np.zeros((len(blocks), 1, bundle.points.shape[1], 3))
        by_local[:, 0, first] = apart / distance[:, None]
        by_local[:, 0, second] = -by_local[:, 0, first]
        weight = np.full((len(blocks), 1), freedom.tolerance**-2)
        error = (distance - length)[:, None]
        cost += float((weight * error**2).sum())
        none = np.zeros((len(blocks), 1, 0))
        part = Arrowhead.of(none, by_local.reshape(len(blocks), 1, -1), error, weight)
        system.include(part, np.zeros(0, int), blocks)
    return cost


def _add_usual(
    system: Arrowhead,
    bundle: Bundle,
    freedom: Freedom,
    places: list[tuple[slice, slice, slice]],
) -> float:
    """What is known of the lenses beforehand; returns its cost."""
    cost = 0.0
    precision = np.zeros(len(system.shared))
    value = np.zeros(len(system.shared))
    for c, (_, lens, _) in enumerate(places):
        known, basis = freedom.precision[c], freedom.lens[c]
        off = bundle.cameras[c].intrinsics - freedom.usual[c]
        precision[lens] = known @ basis**2
        pull = (known * off) @ basis
        value[lens] = np.divide(
            pull, precision[lens], out=np.zeros_like(pull), where=precision[lens] > 0
        )
        cost += float(known @ off**2)
    system.know(precision, value)
    return cost


def _moved(
    bundle: Bundle,
    freedom: Freedom,
    shared: NDArray[np.float64],
    local: NDArray[np.float64],
) -> Bundle | None:
    """The bundle after a step; None where a lens would be impossible."""
    from scipy.spatial.transform import Rotation

    cameras = list(bundle.cameras)
    rotations, translations = bundle.rotations.copy(), bundle.translations.copy()
    delays = bundle.delays.copy()
    for c, (pose, lens, delay) in enumerate(freedom.columns(bundle)):
        change = freedom.pose(bundle, c) @ shared[pose]
        rotations[c] = Rotation.from_rotvec(change[:3]).as_matrix() @ rotations[c]
        translations[c] += change[3:]
        if c == freedom.baseline:
            old = np.linalg.norm(bundle.translations[c])
            translations[c] *= old / np.linalg.norm(translations[c])
        if lens.stop > lens.start:
            intrinsics = cameras[c].intrinsics + freedom.lens[c] @ shared[lens]
            if intrinsics[: 2 if len(intrinsics) > 3 else 1].min() <= 0:
                return None
            cameras[c] = replace(cameras[c], intrinsics=intrinsics)
        delays[c] += shared[delay].sum()
    points = bundle.points + local.reshape(bundle.points.shape)
    return Bundle(tuple(cameras), rotations, translations, points, delays)
