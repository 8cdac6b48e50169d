"""The reference integrator: full light transport among triangles, by path tracing.

Unidirectional paths, light sampling combined with cosine sampling by the power heuristic
(Veach 1997), Owen-scrambled Sobol points. It shares no estimator with the compositor, which
is tested against it, and photographs the virtual sets of the examples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.lens import Lens
from chromeball.renderer.mesh import Instance, Mesh, Values
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel


def corner_rays(camera: CameraModel) -> NDArray[np.float32]:
    """World directions through the corners of all pixels, ``(H + 1, W + 1, 3)``.

    NaN outside the lens. The core interpolates inside a pixel, so any lens will do.
    """
    width, height = camera.size
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    return np.ascontiguousarray(camera.rays(np.stack([x, y], axis=-1)), np.float32)


def path_trace(
    mesh: Mesh | Instance,
    rays: NDArray[np.float32],
    origin: Values,
    *,
    spp: int = 64,
    seed: int = 0,
    max_bounces: int = 8,
    environment: NDArray[np.float32] | None = None,
    lights: Sequence[DeltaLight] = (),
    irradiance: NDArray[np.float32] | None = None,
    gather_from: float = 0.0,
    lens: Lens | None = None,
) -> NDArray[np.float32]:
    """Radiance (H, W, 3) float32 that a camera sees, the mean of `spp` paths a pixel.

    Parameters
    ----------
    mesh
        The set: diffuse, mirror and glass faces that may shine; an instance may move.
    rays
        (H + 1, W + 1, 3) directions at the pixels' corners (:func:`corner_rays`); a pixel
        with a NaN corner is outside the lens and 0.
    origin
        The camera's place in metres.
    spp
        Paths a pixel; powers of two are stratified best.
    seed
        The same seed gives the same picture, whatever the number of threads.
    max_bounces
        Most scatterings on a path: 0 shows the lamps alone, 1 is direct light.
    environment
        (h, w, 3) lat-long radiance around the set, OpenEXR's axes; none: black.
    lights
        Lights without size.
    irradiance, gather_from
        (V, 3) known at the vertices: a path ends where it meets a second diffuse surface more
        than `gather_from` metres away; NaN where unknown (:mod:`chromeball.renderer.gather`).
    lens
        Pixel filter, aperture and shutter; none: a pinhole that sees the pixels' area.

    """
    if spp < 1 or max_bounces < 0:
        raise ValueError("spp must be at least 1, max_bounces at least 0")
    vertices = (mesh.mesh if isinstance(mesh, Instance) else mesh).vertices
    if irradiance is not None and len(irradiance) != len(vertices):
        raise ValueError("irradiance and vertices differ in length")
    return core.path_trace(
        world([mesh], lights),
        (lens or Lens()).core(rays, origin),
        spp,
        seed,
        max_bounces,
        None if environment is None else np.ascontiguousarray(environment, np.float32),
        None if irradiance is None else np.ascontiguousarray(irradiance, np.float32),
        gather_from,
    )
