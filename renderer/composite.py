"""Synthetic objects in a captured set: the plate, changed where the objects change it.

For a place x on a support surface the plate is multiplied by Q = 1 + dE / E_without per
channel, dE being what the objects add to and take from its irradiance: differential rendering
(Debevec 1998) as a quotient, inside one pass. The light comes from places: the map's texels
are laid on the stand-in geometry (Felinto et al. 2012, section 7). Where no sample sees an
object Q is 1 without noise, and the plate's bits are left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.lens import Lens
from chromeball.renderer.mesh import Instance, Mesh, Values, affine
from chromeball.renderer.world import check_reach, extent, moved_back, triple, world
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import StandInMesh

#: Channels of the film, as in the C++ core's `Film`.
_OBJECT, _CHANGE, _DIFFERENCE = slice(0, 3), slice(4, 7), slice(7, 10)
_COVERAGE, _SUPPORT, _DEPTH, _SURFACES, _SQUARE, _BRIGHTNESS, _SAMPLES, _COUNT = (
    3,
    10,
    11,
    12,
    13,
    14,
    15,
    16,
)
#: Most samples of one pass.
_PASS = 16
#: Samples of a pixel before its noise is known well enough to steer by.
_PILOT = 8


@dataclass(frozen=True)
class CapturedSet:
    """What was captured: light and the geometry it lies on.

    ``environment`` (h, w, 3) float32 lat-long radiance, OpenEXR's axes in the world;
    ``origin`` (3,) the map's place in metres; ``stand_in`` triangles of the set. Without
    stand-in geometry all light is directional and there is nothing to cast shadows on.
    ``others``: maps taken elsewhere, as (environment, origin) each; a place that the first map
    does not see has the light of the one that shows it most finely.

    Raises
    ------
    UserError
        For an environment with pixels that are NaN, infinite or negative, and says how many.

    """

    environment: NDArray[np.float32]
    origin: NDArray[np.float64]
    stand_in: StandInMesh | None = None
    others: tuple[tuple[NDArray[np.float32], NDArray[np.float64]], ...] = ()

    def __post_init__(self) -> None:
        check_environment(self.environment)
        for environment, _ in self.others:
            check_environment(environment)


@dataclass(frozen=True)
class Composite:
    """A composite and what it is made of, all of the plate's height and width.

    ``rgb`` (H, W, 3) scene-linear; ``alpha`` (H, W) share of the pixel that objects cover;
    ``quotient`` (H, W, 3) mean Q of the pixel's support part, 1 elsewhere; ``objects``
    (H, W, 3) radiance of the objects times alpha, and what glossy support mirrors of them;
    ``standard_error`` (H, W) of the pixel's
    mean brightness; ``depth`` (H, W) mean distance of the first surface in metres, 0 where
    there is none; ``changed`` (H, W) bool, the other pixels are the plate's bits.
    ``clipped``: pixels whose noise would have made them negative, set to 0. ``kept``,
    ``added`` (H, W, 3): what is left of the plate and what comes to it,
    rgb = kept plate + added.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    quotient: NDArray[np.float32]
    objects: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    depth: NDArray[np.float32]
    changed: NDArray[np.bool_]
    clipped: int
    kept: NDArray[np.float32]
    added: NDArray[np.float32]

    def relative_error(self) -> float:
        """Typical standard error of a changed pixel over the mean of them all; 0 if none."""
        if not self.changed.any():
            return 0.0
        mean = float(self.rgb[self.changed].mean())
        rms = float(np.sqrt(np.mean(self.standard_error[self.changed].astype(float) ** 2)))
        return rms / mean if mean > 0 else 0.0


@dataclass(frozen=True)
class Gloss:
    """What all support surfaces have beside their diffuse part: a dielectric's reflection.

    ``reflectance`` at normal incidence, 0 to 0.9 (a varnished floor: 0.04), and ``roughness``,
    0 to 1, of GGX (Walter et al. 2007) as in glTF 2.0.

    Raises
    ------
    UserError
        For numbers out of these ranges.

    """

    reflectance: float = 0.04
    roughness: float = 0.1

    def __post_init__(self) -> None:
        if not 0 <= self.reflectance <= 0.9:
            raise UserError(f"a gloss of reflectance {self.reflectance}: give 0 to 0.9")
        if not 0 <= self.roughness <= 1:
            raise UserError(f"a gloss of roughness {self.roughness}: give 0 to 1")


type Reflect = Literal["plate", "map"]
type Integrator = Literal["path", "direct", "ao"]


def even_light(
    stand_in: StandInMesh | None, place: NDArray[np.float64], plate: NDArray[np.float32]
) -> CapturedSet:
    """A stand-in under an even white sky, as if its map had been taken at `place` (3,).

    The sky is as bright as white is in a plate (H, W, 3) whose log-average is grey of 18 %
    (Reinhard, Stark, Shirley, Ferwerda 2002).
    """
    brightness = plate.mean(axis=2, dtype=float)
    seen = brightness[brightness > 0]
    white = float(np.exp(np.log(seen).mean())) / 0.18 if seen.size else 1.0
    return CapturedSet(np.full((16, 32, 3), white, np.float32), place, stand_in)


class Compositor:
    """A progressive compositor: :meth:`add` samples, look at :meth:`result`, go on.

    :meth:`look` starts over with another camera, :meth:`place` with other objects,
    :meth:`move` with one object elsewhere.

    Parameters
    ----------
    objects
        The synthetic objects: instances of meshes, or meshes that stand where their vertices
        are; an empty list leaves the plate alone.
    captured
        The set's light and geometry.
    rays
        (H + 1, W + 1, 3) float32 directions at the pixels' corners
        (:func:`chromeball.renderer.path.corner_rays`); NaN outside the lens.
    camera
        The camera's place in metres.
    plate
        (H, W, 3) float32 radiance of the background; none: the captured set itself, seen by
        the camera (``plate_samples`` sub-samples a pixel).
    bounces
        Diffuse interreflections between objects and set beyond direct light. Paths through
        mirrors and glass are always followed.
    mode
        ``quotient``: B Q, ``difference``: B + L_cap dE / E_without.
    lights
        Synthetic lights without size; they light objects and support surfaces. Lights with a
        size are objects that shine.
    samples
        About how many samples a pixel are to come: the order of the points is made for it.
    integrator
        ``path``: all light that goes between objects and set (``bounces``), the reference.
        ``direct``: the light of the set on the objects and what they keep from the set, from a
        list of lamps that is drawn beforehand; mirrors, glass and gloss see the set as it was
        captured. Many times faster. ``ao``: ``direct`` under an even white sky, for a plate
        without a probe (Zhukov et al. 1998, with the cosine kept).
    filtered
        Whether ``direct`` smooths the light that it found over neighbours on one surface, by no
        more than its noise. The plate is never smoothed.
    lens
        Pixel filter, aperture and shutter; none: a pinhole that sees the pixels' area.
    photons
        How many photons ``path`` traces for each sample of a pixel: light that mirrors and
        glass throw onto the set from lamps and the brightest parts of the map (caustics;
        Jensen 1996, Knaus and Zwicker 2011). 0: it is found from the set alone, by chance.
    reflect
        What mirrors, glass and gloss show of support surfaces, by ``path``: ``plate``, where
        the camera sees them, with a soft edge to the map's picture where it does not; ``map``.
    gloss
        The support surfaces mirror the objects, by ``path``: what the objects change of the
        reflection that the plate holds is added to it.

    """

    def __init__(
        self,
        objects: Sequence[Mesh | Instance],
        captured: CapturedSet,
        rays: NDArray[np.float32],
        camera: Values,
        plate: NDArray[np.float32] | None = None,
        *,
        bounces: int = 4,
        mode: Literal["quotient", "difference"] = "quotient",
        seed: int = 0,
        samples: int = 64,
        lights: Sequence[DeltaLight] = (),
        plate_samples: int = 16,
        integrator: Integrator = "path",
        filtered: bool = True,
        lens: Lens | None = None,
        photons: float = 0.25,
        reflect: Reflect = "plate",
        gloss: Gloss | None = None,
    ) -> None:
        if gloss is not None and integrator != "path":
            raise UserError("gloss of support surfaces is for the path integrator: take path")
        if integrator == "ao":
            if plate is None:
                raise UserError("ambient occlusion has no light to show: it needs a plate")
            captured = even_light(captured.stand_in, np.asarray(camera, float), plate)
        self._difference = mode == "difference"
        self._environment = np.ascontiguousarray(captured.environment, np.float32)
        self._plate_samples = plate_samples
        self._inner, self._extents = _inner(objects), _extents(objects)
        self._lights = lights
        #: the core counts from the map's place
        self._about = np.asarray(captured.origin, float)
        self._core = core.Compositor(
            world(objects, lights, captured.origin),
            _core_stand_in(captured.stand_in, captured.origin),
            self._environment,
            (0.0, 0.0, 0.0),
            bounces,
            seed,
            samples,
        )
        if captured.others:
            self._others = [np.ascontiguousarray(e, np.float32) for e, _ in captured.others]
            places = np.array([o - self._about for _, o in captured.others], np.float32)
            self._core.set_others(self._others, places)
        if gloss is not None:
            self._core.set_gloss(gloss.reflectance, gloss.roughness)
        self._direct = None if integrator == "path" else core.Direct(self._core, seed)
        self._filtered = filtered
        self._photons = photons
        self._reflects_plate = reflect == "plate"
        self.look(rays, camera, plate, lens)

    def look(
        self,
        rays: NDArray[np.float32],
        camera: Values,
        plate: NDArray[np.float32] | None = None,
        lens: Lens | None = None,
    ) -> None:
        """Start over with another camera and plate; the world stays as it is built."""
        self._rays = np.ascontiguousarray(rays, np.float32)
        self._place = triple(np.subtract(camera, self._about))
        height, width = self._rays.shape[0] - 1, self._rays.shape[1] - 1
        if height < 1 or width < 1:
            raise UserError(f"a picture of {height} x {width} has no pixels")
        self._camera = (lens or Lens()).core(self._rays, self._place)
        if self._direct is not None and lens is not None and not lens.plain:
            raise UserError(
                "the direct integrator has no aperture, shutter or filter: take path for them"
            )
        if plate is None:
            plate = self._core.background(self._camera, self._plate_samples)
        self.plate = np.ascontiguousarray(plate, np.float32)
        if self.plate.shape != (height, width, 3):
            raise ValueError(f"plate is {self.plate.shape}, rays are for {height} x {width}")
        corners = np.isfinite(self._rays).all(axis=2)
        #: pixels inside the lens; the core leaves the others out
        self._seen = corners[1:, 1:] & corners[1:, :-1] & corners[:-1, 1:] & corners[:-1, :-1]
        self.restart()

    def background(
        self, rays: NDArray[np.float32], camera: Values, samples: int
    ) -> NDArray[np.float32]:
        """The captured set alone, (H, W, 3), seen by a camera with `samples` a pixel."""
        rays = np.ascontiguousarray(rays, np.float32)
        place = triple(np.subtract(camera, self._about))
        return self._core.background(Lens().core(rays, place), samples)

    def place(
        self,
        objects: Sequence[Mesh | Instance],
        lights: Sequence[DeltaLight] | None = None,
    ) -> None:
        """Start over with other objects, and other lights where they are given.

        Camera, plate and captured set stay as they are.
        """
        self._core.place(
            world(objects, self._lights if lights is None else lights, self._about)
        )
        self._lights = self._lights if lights is None else lights
        self._inner, self._extents = _inner(objects), _extents(objects)
        self._moved()

    def move(self, k: int, pose: Pose, scale: Values = 1.0) -> None:
        """Start over with object `k` elsewhere; no mesh is built again.

        `pose` and `scale` (one factor or three) apply to the mesh's vertices, as in
        :class:`Instance`, whose ``inner`` stays. Raises IndexError where there is no such
        object, UserError for a place 1e8 m away.
        """
        step = moved_back(affine(pose, scale, self._inner[k]), self._about)[None]
        check_reach(self._extents[k], step)
        self._core.move(k, step)
        self._moved()

    def _moved(self) -> None:
        if self._direct is not None:
            self._direct.objects_moved()
        self.restart()

    def restart(self) -> None:
        """Forget all samples."""
        if self._direct is None:
            self._film = np.zeros((*self.plate.shape[:2], _COUNT), np.float32)
        else:
            self._direct.begin(*self.plate.shape[:2])
        #: samples a pixel so far (the mean where they differ), rays traced so far
        self.samples, self.rays_traced = 0, 0

    def add(self, samples: int, rows: NDArray[np.bool_] | None = None) -> None:
        """Add `samples` sub-samples to each pixel, or to those of the `rows` (H,) alone."""
        if self._direct is not None:
            if rows is not None:
                raise UserError("tiles are for the path integrator: direct makes whole frames")
            for count in _passes(samples):
                self.rays_traced += self._direct.add(self._rays, self._place, count)
            self.samples += samples
            return
        for count in _passes(samples):
            counts = np.full(self._film.shape[:2], count, np.uint16)
            if rows is not None:
                counts[~rows] = 0
            self._add(counts, count)

    def counts_all_noise(self) -> bool:
        """Whether ``standard_error`` holds all noise; direct's knows its shadow rays alone."""
        return self._direct is None

    def film(self) -> NDArray[np.float32]:
        """What the passes have added up, (H, W, C), a row of sums a pixel; see `restore`."""
        return self._film.copy()

    def restore(self, film: NDArray[np.float32], samples: int) -> None:
        """Go on from a :meth:`film`, of which each pixel has `samples`."""
        if film.shape != self._film.shape:
            raise ValueError(f"film is {film.shape}, not {self._film.shape}")
        self._film = np.ascontiguousarray(film, np.float32)
        self.samples = samples

    def refine(self, samples: int) -> None:
        """Add `samples` sub-samples a pixel in the mean, where they lower the noise most.

        The total error is least when a pixel's samples are proportional to its standard
        deviation (Neyman 1934), here relative to its brightness, seen over its neighbourhood
        so that a pixel does not stop on a lucky start. A quarter is spread evenly: what few
        samples have not met yet may still be there. ``direct`` spreads its rays by itself.
        """
        if self._direct is not None:
            self.add(samples)
            return
        n = self._film[..., _SAMPLES]
        if not self._seen.any() or float(n[self._seen].min()) < _PILOT:
            self.add(samples)
            return
        sigma = _neighbourhood(self._relative_deviation())
        mean = float(sigma[self._seen].mean())
        share = 0.25 + 0.75 * sigma / mean if mean > 0 else np.ones_like(sigma)
        wanted = np.maximum(share * (self.samples + samples) - n, 0) * self._seen
        counts = wanted * (samples * float(self._seen.sum()) / max(float(wanted.sum()), 1.0))
        # rounded so that fractions add up along the rows
        rows = np.cumsum(counts, axis=1)
        whole = np.diff(np.floor(rows), axis=1, prepend=0.0)
        self._add(np.minimum(whole, 8192).astype(np.uint16), samples)

    def samples_per_pixel(self) -> NDArray[np.float32]:
        """How many samples each pixel (H, W) has; 0 outside the lens."""
        if self._direct is not None:
            return (self._seen * self.samples).astype(np.float32)
        return self._film[..., _SAMPLES].copy()

    def _add(self, counts: NDArray[np.uint16], samples: int) -> None:
        photons = round(self._photons * float(self._seen.sum()))
        caustics = (self.samples, min(samples, _PASS), photons)
        self.rays_traced += self._core.add(
            self._camera,
            self.plate,
            self._difference,
            self._reflects_plate,
            counts,
            caustics,
            self._film,
        )
        self.samples += samples

    def _relative_deviation(self) -> NDArray[np.float64]:
        """Standard deviation of one sample of each pixel (H, W), relative to its brightness."""
        n = np.maximum(self._film[..., _SAMPLES].astype(float), 1)
        mean = self._film[..., _BRIGHTNESS] / n
        variance = np.maximum(self._film[..., _SQUARE] / n - mean**2, 0)
        variance[variance < 1e-10 * mean**2] = 0  # what float32 sums leave of equal samples
        floor = 0.05 * float(mean.mean())
        return np.sqrt(variance) / np.maximum(mean, floor if floor > 0 else 1.0)

    def irradiance(self, point: Values, normal: Values) -> NDArray[np.float64]:
        """E_without (3,) of the captured set at a point lifted off a surface."""
        return np.array(
            self._core.irradiance(triple(np.subtract(point, self._about)), triple(normal))
        )

    def picture(self) -> NDArray[np.float32]:
        """The composite alone, (H, W, 3); as :meth:`result`, without its layers."""
        return self.result().rgb if self._direct is None else self._resolve(False)[0]

    def _resolve(self, layers: bool) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
        assert self._direct is not None
        return self._direct.resolve(
            self._rays, self._place, self.plate, self._difference, self._filtered, layers
        )

    def _direct_result(self) -> Composite:
        rgb, layers, clipped = self._resolve(True)
        objects, alpha, quotient = layers[..., 0:3], layers[..., 3], layers[..., 4:7]
        kept = _float32(np.repeat(1 - alpha[..., None], 3, axis=2))
        added = objects
        if self._difference:
            added = rgb - self.plate * kept
        else:
            kept += layers[..., 9:12]
        return Composite(
            rgb=rgb,
            alpha=alpha,
            quotient=quotient,
            objects=objects,
            standard_error=layers[..., 7],
            depth=layers[..., 8],
            changed=(alpha > 0) | (quotient != 1).any(axis=2),
            clipped=clipped,
            kept=kept,
            added=_float32(added),
        )

    def result(self) -> Composite:
        """The composite of the samples so far."""
        if self._direct is not None:
            return self._direct_result()
        film = self._film
        n = np.maximum(film[..., _SAMPLES], 1)
        alpha = film[..., _COVERAGE] / n
        objects = film[..., _OBJECT] / n[..., None]
        change = film[..., _CHANGE] / n[..., None]
        changed = (alpha > 0) | (change != 0).any(axis=2) | (objects != 0).any(axis=2)
        kept, added = np.repeat(1 - alpha[..., None], 3, axis=2), objects
        if self._difference:
            added = added + film[..., _DIFFERENCE] / n[..., None]
        else:
            kept += change
        blend = self.plate * kept + added
        clipped = changed & (blend < 0).any(axis=2)
        rgb = np.where(changed[..., None], np.maximum(blend, 0), self.plate)
        support = film[..., _SUPPORT, None]
        quotient = np.ones_like(rgb)
        np.divide(film[..., _CHANGE], support, out=quotient, where=support > 0)
        quotient += support[..., 0, None] > 0
        surfaces = film[..., _SURFACES]
        depth = np.zeros_like(alpha)
        np.divide(film[..., _DEPTH], surfaces, out=depth, where=surfaces > 0)
        mean = film[..., _BRIGHTNESS].astype(float) / n
        variance = np.maximum(film[..., _SQUARE].astype(float) / n - mean**2, 0)
        error = np.where(changed, np.sqrt(variance / np.maximum(n - 1, 1)), 0)
        return Composite(
            rgb=rgb,
            alpha=_float32(alpha),
            quotient=quotient,
            objects=_float32(objects),
            standard_error=_float32(error),
            depth=_float32(depth),
            changed=changed,
            clipped=int(clipped.sum()),
            kept=_float32(kept),
            added=_float32(added),
        )


def _passes(samples: int) -> list[int]:
    """So many samples in passes."""
    return [_PASS] * (samples // _PASS) + [samples % _PASS] * (samples % _PASS > 0)


def _neighbourhood(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square over 7 x 7 pixels."""
    from scipy.ndimage import uniform_filter

    return np.sqrt(np.maximum(uniform_filter(values**2, size=7, mode="nearest"), 0))


def _float32(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return values.astype(np.float32, copy=False)


def _inner(objects: Sequence[Mesh | Instance]) -> list[NDArray[np.float64] | None]:
    return [thing.inner if isinstance(thing, Instance) else None for thing in objects]


def _extents(objects: Sequence[Mesh | Instance]) -> list[NDArray[np.float64]]:
    meshes = (thing.mesh if isinstance(thing, Instance) else thing for thing in objects)
    return [extent(mesh.vertices) for mesh in meshes]


def check_environment(environment: NDArray[np.float32]) -> None:
    """Raise UserError unless this is a picture (h, w, 3) of light: finite and not negative."""
    if environment.ndim != 3 or environment.shape[2] != 3 or not environment.size:
        raise UserError(f"an environment of shape {environment.shape}: (h, w, 3) is needed")
    bad = {
        "NaN": np.isnan(environment),
        "infinite": np.isinf(environment),
        "negative": environment < 0,
    }
    found = [f"{n} {what}" for what, m in bad.items() if (n := int(m.any(axis=2).sum()))]
    if found:
        raise UserError(
            f"the environment has {' and '.join(found)} pixels of {environment[..., 0].size}; "
            "mend them before it can be light"
        )


def _core_stand_in(mesh: StandInMesh | None, about: NDArray[np.float64]) -> core.StandIn:
    if mesh is None:
        none = np.zeros((0, 3), np.float32)
        return core.StandIn(none, none, np.zeros((0, 3), np.uint32), np.zeros(0, np.uint8))
    return core.StandIn(
        (mesh.vertices - about).astype(np.float32),
        (mesh.original - about).astype(np.float32),
        np.ascontiguousarray(mesh.faces, np.uint32),
        np.ascontiguousarray(mesh.surface, np.uint8),
    )
