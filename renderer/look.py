"""The composite as the plate's camera would have shown it (row A4).

What the camera did to the plate is in the plate, so only the synthetic part is changed. With
B the plate, a composite is C = k B + S: k what is left of the plate (1 - alpha, or
1 - alpha + Q - 1 on support), S what is synthetic. Softness blurs k - 1 and S, never B;
vignetting falls on S, for k B has it (on all of C where it was divided out of B); and noise is
given to the amount that is missing,

    var = v(C) - k^2 v(B),

v(L) being the plate's variance at radiance L, with the plate's own grain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.response_file import Response, read_response
from chromeball.renderer.composite import Composite
from chromeball.renderer.exposed import best_frame
from chromeball.renderer.grain import Noise, grain, measure_noise
from chromeball.renderer.lens import Filter, edge
from chromeball.renderer.sharpness import Softness, measure_softness, soften, softening
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_header, read_image
from chromeball.scene.manifest import Look, Scene
from chromeball.scene.record import Json, to_json
from chromeball.scene.vignette import REMOVED, Vignette, read_vignette

type Float = NDArray[np.float64]


@dataclass(frozen=True)
class Exposed:
    """How the camera writes pictures: its response, and radiance to exposure.

    ``exposure``: of one of the plate's frames, times what makes the plate's units the merge's.
    ``frame``: its number. ``quality``: of a JPEG beside the PNG, or None.
    """

    response: Response
    exposure: float
    frame: int
    quality: int | None = None


@dataclass(frozen=True)
class CameraLook:
    """What the camera does to a picture; None or ones where it is left out.

    ``falloff`` (H, W) float32: vignetting, 1 at the centre; ``flattened``: the plate's own was
    divided out, so that all gets it. ``seed``: of the noise, 0 or more.
    ``filter``: that the synthetic part was sampled with, so far its only softness.
    """

    noise: Noise | None = None
    softness: Softness | None = None
    falloff: NDArray[np.float32] | None = None
    exposed: Exposed | None = None
    seed: int = 0
    filter: Filter = "box"
    flattened: bool = False

    def figures(self) -> dict[str, Json]:
        """What was measured on the plate, for the record."""
        found: dict[str, Json] = {}
        if self.noise is not None:
            found["noise"] = to_json(self.noise.figures())
        if self.softness is not None:
            found["softness"] = to_json(self.softness.figures())
        if self.falloff is not None:
            found["vignetting_least"] = float(self.falloff.min())
            found["vignetting_of_plate"] = self.flattened
        if self.exposed is not None:
            found["frame"] = self.exposed.frame
        return found


def read_look(
    look: Look,
    scene: Scene,
    folder: Path,
    plate_file: Path | None,
    plate: NDArray[np.float32],
    camera: CameraModel,
) -> tuple[CameraLook, tuple[Path, ...]]:
    """Measure and read what `look` asks for; and the files that were read for it.

    `plate` (H, W, 3), of `plate_file` unless it is a rendered background; paths in the scene
    are relative to `folder`.

    Raises
    ------
    UserError
        The plate cannot tell its noise or softness, holds no exposures, or no response exists.

    """
    noise = softness = falloff = exposed = None
    inputs: list[Path] = []
    if look.noise:
        sigma = usable = None
        if plate_file is not None:
            image = read_image(plate_file)
            names = list(image.channels)
            if "clipped" in names:
                usable = image.pixels[..., names.index("clipped")] == 0
            if "sigma.R" in names:
                sigma = image.pixels[..., [names.index(f"sigma.{c}") for c in "RGB"]]
            elif "sigma.Y" in names:
                sigma = np.repeat(image.pixels[..., [names.index("sigma.Y")]], 3, axis=2)
        noise = measure_noise(plate, sigma=sigma, usable=usable)
    if look.softness:
        softness = measure_softness(plate)
    flattened = False
    if look.vignetting:
        given: Vignette | Sequence[float]
        if isinstance(look.vignetting, str):
            file = folder / look.vignetting
            given = read_vignette(file)
            inputs.append(file)
        else:
            given = look.vignetting
        falloff = fall_off(given, camera)
        flattened = plate_file is not None and REMOVED in read_header(plate_file).attributes
    if look.response is not None:
        if plate_file is None:
            raise UserError("look.response needs a plate: this view has none, leave it out")
        if look.response != "plate":
            inputs.append(folder / look.response)
        elif scene.hdr.response is not None:
            inputs.append(folder / scene.hdr.response)
        else:
            inputs.append(folder / scene.folder / "response.json")
        exposed = _exposed(look, read_response(inputs[-1]), plate_file, plate)
    seed = scene.render.seed % 2**64  # as the core takes it
    kind = scene.render.filter
    found = CameraLook(noise, softness, falloff, exposed, seed, kind, flattened)
    return found, tuple(inputs)


def _exposed(
    look: Look, response: Response, plate_file: Path, plate: NDArray[np.float32]
) -> Exposed:
    attributes = read_image(plate_file).attributes
    exposures = np.array(attributes.get("exposures", ()), float).reshape(-1)
    if exposures.size == 0:
        raise UserError(
            "has no attribute `exposures`, which tells what the camera's codes were made from; "
            "merge it with `hdr merge`, or leave look.response out",
            file=plate_file,
        )
    if look.jpeg is not None and response.codes != 256:
        raise UserError(f"look.jpeg: a camera of {response.codes} codes writes no JPEG")
    scale = 1 / float(attributes.get("luminanceScale", 1.0))
    frame = look.frame
    if frame is None:
        frame = best_frame(plate, response, tuple(scale * exposures))
    elif frame >= len(exposures):
        raise UserError(
            f"look.frame is {frame}, the plate was merged from {len(exposures)} frames, "
            "counted from 0"
        )
    return Exposed(response, float(scale * exposures[frame]), frame, look.jpeg)


def fall_off(falloff: Vignette | Sequence[float], camera: CameraModel) -> NDArray[np.float32]:
    """V = 1 + c1 r^2 + c2 r^4 + ..., (H, W); r = 1 at half the picture's diagonal.

    r is counted from the optical axis. A measured `falloff` has its own centre and radius.

    Raises
    ------
    UserError
        A panorama has no optical axis; a fall-off that is not positive.

    """
    if camera.model == "latlong":
        raise UserError("look.vignetting: a lat-long panorama has no lens")
    if isinstance(falloff, Vignette):
        return falloff.picture(camera.size)
    centre = camera.project(np.array([0.0, 0.0, 1.0]))
    r2 = ((camera.pixel_grid() - centre) ** 2).sum(axis=2) / (np.hypot(*camera.size) / 2) ** 2
    V = np.polynomial.polynomial.polyval(r2, [1.0, *falloff])
    if V.min() <= 0:
        raise UserError("look.vignetting falls to zero or below inside the picture")
    return V.astype(np.float32)


def apply_look(
    composite: Composite,
    plate: NDArray[np.float32],
    look: CameraLook,
) -> tuple[Composite, dict[str, Json]]:
    """The composite with softness, vignetting and noise, and figures of what was done.

    ``rgb`` and ``changed`` are new, the layers stay as rendered. Where nothing is synthetic the
    plate's bits stay, unless its fall-off was divided out and comes back.
    """
    k, synthetic = composite.kept, composite.added
    figures: dict[str, Json] = {}
    if look.softness is not None:
        seen = partial(edge, look.filter)
        kernels = [softening(float(width), seen) for width in look.softness.width]
        k, synthetic = 1 + _soften(k - 1, kernels), _soften(synthetic, kernels)
    if look.falloff is not None and not look.flattened:
        synthetic = synthetic * look.falloff[..., None]
    changed = (k != 1).any(axis=2) | (synthetic != 0).any(axis=2)
    blend = plate * k + synthetic
    clipped = changed & (blend < 0).any(axis=2)
    rgb = np.maximum(blend, 0)
    if look.noise is not None and changed.any():
        box = _box(changed)
        there, wanted = look.noise.at(plate[box]) * k[box] ** 2, look.noise.at(rgb[box])
        missing = wanted - there
        rng = np.random.default_rng(look.seed)
        n = grain(changed.shape, look.noise.correlation, rng)[box]
        rgb[box] = np.maximum(rgb[box] + np.sqrt(np.maximum(missing, 0)) * n, 0)
        within = changed[box]
        share = np.maximum(missing, 0)[within].sum() / max(wanted[within].sum(), 1e-300)
        figures["noise_missing"] = float(np.sqrt(share))
        # brightened plate is noisier than the camera would have been
        noisier = (missing < -0.1 * wanted).any(axis=2)
        figures["noisier_pixels"] = int(noisier[within].sum())
    rgb = np.where(changed[..., None], rgb, plate)
    if look.falloff is not None and look.flattened:
        rgb = rgb * look.falloff[..., None]
    return replace(composite, rgb=rgb, changed=changed, clipped=int(clipped.sum())), figures


def _soften(layer: NDArray[np.float32], kernels: Sequence[Float]) -> NDArray[np.float32]:
    return np.stack([soften(layer[..., c], k) for c, k in enumerate(kernels)], axis=2)


def _box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The smallest rectangle that holds all of a mask."""
    rows, columns = (np.flatnonzero(mask.any(axis=a)) for a in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
