"""A view of a scene file, rendered: the composite, its layers and how good they are."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats import read_camera
from chromeball.renderer.composite import (
    CapturedSet,
    Composite,
    Compositor,
    Gloss,
    even_light,
)
from chromeball.renderer.converge import Convergence
from chromeball.renderer.denoise import denoise
from chromeball.renderer.exposed import expose
from chromeball.renderer.inputs import scene_inputs
from chromeball.renderer.lens import view_lens
from chromeball.renderer.lights import area_lights, delta_lights
from chromeball.renderer.look import CameraLook, apply_look, read_look
from chromeball.renderer.path import corner_rays
from chromeball.renderer.scene import moving_instances, turn
from chromeball.renderer.travel import unseen
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, read_rgb, to_display, write_exr, write_picture
from chromeball.scene.manifest import Look, Scene, View
from chromeball.scene.pose import Pose
from chromeball.scene.record import Stage, check_output
from chromeball.scene.sequence import view_at
from chromeball.stand_in.ply import StandInMesh, read_stand_in

#: Told after each pass: samples a pixel and, where it is known, the relative error so far.
type Progress = Callable[[int, float | None], None]

#: Samples of one progressive pass.
PASS = 8


@dataclass(frozen=True)
class Budget:
    """When to stop: after `spp` samples a pixel, `seconds`, or below a relative `error`."""

    spp: int | None = None
    seconds: float | None = None
    error: float | None = None

    def __post_init__(self) -> None:
        for name in ("spp", "seconds", "error"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise UserError(f"--{name} is {value}; it must be positive")
        if self.error is not None and self.spp is None and self.seconds is None:
            object.__setattr__(self, "spp", 65536)  # an end for an error out of reach

    def reached(self, samples: int, seconds: float, error: float | None) -> bool:
        """Whether to stop now; `error` is None where it is not known yet."""
        return (
            (self.spp is not None and samples >= self.spp)
            or (self.seconds is not None and seconds >= self.seconds)
            or (self.error is not None and error is not None and error <= self.error)
        )


@dataclass(frozen=True)
class Job:
    """What a view is made of, read and checked. ``inputs``: the files it came from."""

    name: str
    compositor: Compositor
    captured: CapturedSet
    size: tuple[int, int]
    exposure: float | None
    inputs: tuple[Path, ...]
    look: CameraLook
    denoise: bool = False
    travel: dict[str, float] = field(default_factory=dict[str, float])


def prepare(scene: Scene, folder: Path, view: View, spp: int) -> Job:
    """Read everything a view needs and build the compositor.

    Paths are relative to `folder`, the scene file's; `spp` is the number of samples expected.

    Raises
    ------
    UserError
        When an input is missing or broken, or plate and camera differ in size.

    """
    if scene.render.integrator == "ao":
        if scene.light:
            raise UserError("ambient occlusion knows no lights: --integrator path does")
        if not (view.bracket or view.plate):
            raise UserError(
                f"view {view.name!r}: ambient occlusion has no light to show: give it a plate"
            )
        back = backdrop(scene, folder, view, np.zeros(3))
        stand_in, inputs = _stand_in(scene, folder)
        assert back.plate is not None
        captured = even_light(stand_in, back.camera.world_from_camera.translation, back.plate)
    else:
        captured, inputs = captured_set(scene, folder)
        back = backdrop(scene, folder, view, captured.origin)
    inputs += back.inputs
    inputs += [path for path in scene_inputs(scene, folder) if path.is_file()]
    compositor = Compositor(
        [
            *moving_instances(scene, folder, view.shutter),
            *area_lights(scene, folder),
        ],
        captured,
        corner_rays(back.camera),
        back.camera.world_from_camera.translation,
        back.plate,
        integrator=scene.render.integrator,
        bounces=scene.render.bounces,
        mode=scene.render.composite,
        reflect=scene.render.reflect,
        gloss=gloss_of(scene),
        seed=scene.render.seed,
        samples=spp,
        lights=delta_lights(scene),
        lens=view_lens(view, scene.render.filter, back.camera, back.closing),
    )
    camera, plate_file = back.camera, back.inputs[0] if back.inputs else None
    look, read = read_look(view.look, scene, folder, plate_file, compositor.plate, camera)
    inputs += read
    return Job(
        view.name,
        compositor,
        captured,
        camera.size,
        view.exposure,
        tuple(inputs),
        look,
        scene.render.denoise,
        {} if back.plate is not None else _travel(captured, camera),
    )


def _travel(captured: CapturedSet, camera: CameraModel) -> dict[str, float]:
    """How far a camera without a plate is from the probe, and what the probe did not see."""
    way = camera.world_from_camera.translation - captured.origin
    return {
        "metres_from_probe": float(np.linalg.norm(way)),
        "unseen_by_probe": float(unseen(captured, camera).mean()),
    }


def captured_set(scene: Scene, folder: Path) -> tuple[CapturedSet, list[Path]]:
    """Light and geometry that the scene's stages have made, and the files they are in."""
    env_file = folder / scene.folder / "env.exr"
    environment = read_rgb(env_file)
    if environment.shape[1] != 2 * environment.shape[0]:
        raise UserError("a lat-long map is twice as wide as high", file=env_file)
    stand_in, inputs = _stand_in(scene, folder)
    origin = _origin(env_file)
    others = _others(scene, folder, origin)
    if others and stand_in is None:
        raise UserError("env.others: light from other places needs [[stand_in]] to lie on")
    captured = CapturedSet(environment, origin, stand_in, others)
    return captured, [env_file, *(folder / name for name in scene.env.others), *inputs]


def _others(
    scene: Scene, folder: Path, origin: NDArray[np.float64]
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float64]], ...]:
    """The maps of other places; UserError where one is at the first one's or another's."""
    found: list[tuple[NDArray[np.float32], NDArray[np.float64]]] = []
    places = [origin]
    for name in scene.env.others:
        file = folder / name
        environment, place = read_rgb(file), _origin(file)
        if environment.shape[1] != 2 * environment.shape[0]:
            raise UserError("a lat-long map is twice as wide as high", file=file)
        if min(float(np.linalg.norm(place - p)) for p in places) < 1e-3:
            raise UserError("two maps are of one place: leave one out", file=file)
        places.append(place)
        found.append((environment, place))
    return tuple(found)


def gloss_of(scene: Scene) -> Gloss | None:
    """The support surfaces' gloss; none where the scene names none."""
    gloss = scene.render.gloss
    return None if gloss is None else Gloss(gloss.reflectance, gloss.roughness)


def _stand_in(scene: Scene, folder: Path) -> tuple[StandInMesh | None, list[Path]]:
    file = folder / scene.folder / "stand_in.ply"
    if not scene.stand_in:
        if file.is_file():
            print(f"{file} is not used: the scene has no [[stand_in]]", file=sys.stderr)
        return None, []
    return read_stand_in(file), [file]


@dataclass(frozen=True)
class Backdrop:
    """A view's camera, its photograph (H, W, 3) if it has one, the files they came from.

    ``closing``: the camera's pose when the shutter closes, if it moves while that is open.
    """

    camera: CameraModel
    plate: NDArray[np.float32] | None = None
    inputs: tuple[Path, ...] = ()
    closing: Pose | None = None


def backdrop(scene: Scene, folder: Path, view: View, origin: NDArray[np.float64]) -> Backdrop:
    """What a view sees before anything is put into it; `origin` (3,) is the probe's place."""
    if not (view.bracket or view.plate):
        closing = None
        if view.key and view.shutter:
            later = virtual_camera(view_at(view, view.shutter), origin)
            closing = later.world_from_camera
        return Backdrop(virtual_camera(view, origin), closing=closing)
    plate_file, camera_file = (folder / name for name in scene.photograph_of(view))
    plate = read_rgb(plate_file)
    camera = read_camera(camera_file)
    if camera.size != (plate.shape[1], plate.shape[0]):
        raise UserError(
            f"the camera is for {camera.size[0]} x {camera.size[1]} pixels, the plate has "
            f"{plate.shape[1]} x {plate.shape[0]}",
            file=camera_file,
        )
    if view.closing_camera is None:
        return Backdrop(camera, plate, (plate_file, camera_file))
    closing_file = folder / view.closing_camera
    closing = read_camera(closing_file).world_from_camera
    return Backdrop(camera, plate, (plate_file, camera_file, closing_file), closing)


def virtual_camera(view: View, origin: NDArray[np.float64]) -> CameraModel:
    """The camera of a view without a plate: at its position or the map's origin, turned.

    A ``latlong`` or ``cube`` view that is not turned keeps the world's axes, as env.exr.
    """
    place = origin if view.position is None else np.array(view.position, float)
    panorama = {"latlong": CameraModel.latlong, "cube": CameraModel.cube}.get(view.model)
    if view.rotation is not None:
        turned = turn(view.rotation)
        if panorama is not None:
            return panorama(view.size, Pose(turned @ WORLD_FROM_LATLONG.rotation, place))
        # it looks along -z with +y up; camera axes are y down, z forward
        pose = Pose(turned @ np.diag([1.0, -1.0, -1.0]), place)
    elif panorama is not None:
        return panorama(view.size, Pose(WORLD_FROM_LATLONG.rotation, place))
    else:
        pose = _looking_at(view, place)
    fov = math.radians(view.fov)
    if view.model == "pinhole":
        if fov >= math.radians(179):
            raise UserError(f"view {view.name!r}: a pinhole has a fov below 179 degrees")
        return CameraModel.pinhole(view.size, fov, pose)
    return CameraModel.fisheye(view.model, view.size, fov, pose=pose)


def _looking_at(view: View, place: NDArray[np.float64]) -> Pose:
    target = np.array(view.look_at, float)
    up = np.array([0.0, 1.0, 0.0])
    if np.linalg.norm(np.cross(target - place, up)) < 1e-6:
        up = np.array([0.0, 0.0, -1.0])  # straight down or up
    try:
        pose = Pose.look_at(place, target, up)
    except ValueError as error:
        raise UserError(_same_place(view)) from error
    if np.linalg.norm(target - place) < 1e-4:
        raise UserError(_same_place(view))
    return pose


def _same_place(view: View) -> str:
    where = "the place of the light probe" if view.position is None else "its position"
    return f"view {view.name!r}: look_at is {where}; choose another point"


def accumulate(
    compositor: Compositor,
    budget: Budget,
    progress: Progress | None = None,
) -> tuple[Composite, float | None]:
    """Passes until the budget is reached; the composite and its relative error, if known.

    `progress` is told the error where the budget asks for one.
    """
    converging = Convergence(compositor.counts_all_noise())
    start = time.perf_counter()
    seconds = 0.0
    while True:
        left = PASS if budget.spp is None else min(PASS, budget.spp - compositor.samples)
        if budget.seconds is not None:  # as many as still fit, by the speed so far
            speed = compositor.samples / seconds if seconds > 0 else 0.0
            left = max(1, min(left, int(speed * (budget.seconds - seconds))))
        compositor.refine(left)
        seconds = time.perf_counter() - start
        error, samples = None, compositor.samples
        # path's error is known at any time, direct's follows from all doublings on the way
        asked = budget.error is not None and samples >= converging.least()
        if (asked or not compositor.counts_all_noise()) and converging.is_due(samples):
            error = converging.error(compositor.result(), samples)
            error = error if asked else None
        if progress is not None:
            progress(samples, error)
        if budget.reached(samples, seconds, error):
            composite = compositor.result()
            return composite, converging.error(composite, samples)


def check_target(output: str | os.PathLike[str], look: Look | None = None) -> Path:
    """The EXR that a composite is written to, refused early where it or its PNG cannot be.

    `look` says what else is written beside them.
    """
    target = Path(output)
    if target.suffix.lower() != ".exr":
        raise UserError("the composite is an EXR file; name it so", file=target)
    outputs = [target, target.with_suffix(".png")]
    if look is not None and look.response is not None:
        outputs.append(target.with_suffix(".camera.png"))
    if look is not None and look.jpeg is not None:
        outputs.append(target.with_suffix(".camera.jpg"))
    for file in outputs:
        check_output(file)
    return target


def expected_samples(budget: Budget) -> int:
    """About how many samples a pixel will get: their order is made for so many."""
    return budget.spp if budget.spp is not None and budget.spp < 4096 else 256


def write_composite(
    stage: Stage, job: Job, composite: Composite, error: float | None, target: Path
) -> None:
    """Write the EXR with its layers and the PNG as outputs of `stage`, and its figures.

    `error`: relative, of the changed pixels, None where it is not known.
    Where the view's look asks for it, VIEW.camera.png and .jpg too: the plate camera's codes.

    The EXR holds R G B A, ``quotient.R G B``, ``objects.R G B`` (premultiplied),
    ``error.Y`` (standard error of the brightness) and ``depth.Z`` in metres.
    """
    if job.denoise:
        composite = denoise(composite, job.compositor.plate)
    seconds = stage.elapsed()
    composite, added = apply_look(composite, job.compositor.plate, job.look)
    exposure = job.exposure or automatic_exposure(composite.rgb)
    png = target.with_suffix(".png")
    changed = composite.changed
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = composite.standard_error / composite.rgb.mean(axis=2)
    relative = relative[changed & np.isfinite(relative)]
    clipped = (composite.rgb * exposure > 1).any(axis=2)
    stage.figures |= {
        "spp": job.compositor.samples,
        "seconds": seconds,
        "mrays_per_second": job.compositor.rays_traced / max(seconds, 1e-9) / 1e6,
        "relative_error": error,
        "median_standard_error": float(np.median(relative)) if relative.size else 0.0,
        "changed_pixels": int(changed.sum()),
        "denoised": job.denoise,
        "coverage": float(composite.alpha.mean()),
        "clipped_negative_pixels": composite.clipped,
        "clipped_png_pixels": int(clipped.sum()),
        "exposure": exposure,
        "png": png.name,
        "look": job.look.figures() | added,
        **job.travel,
    }
    with stage.output(target) as temporary:
        _write_layers(temporary, composite)
    with stage.output(png) as temporary:
        write_picture(temporary, to_display(composite.rgb, exposure))
    camera = job.look.exposed
    if camera is not None:
        codes = expose(composite.rgb, camera.response, camera.exposure)
        with stage.output(target.with_suffix(".camera.png")) as temporary:
            write_picture(temporary, codes)
        if camera.quality is not None:
            with stage.output(target.with_suffix(".camera.jpg")) as temporary:
                write_picture(temporary, codes, quality=camera.quality)


def automatic_exposure(rgb: NDArray[np.float32]) -> float:
    """Exposure that shows the middle of the picture's brightness as middle grey.

    The geometric mean between median and 90th percentile goes to 0.25, black left out.
    """
    brightness = luminance(rgb)
    brightness = brightness[brightness > 0]
    if brightness.size == 0:
        return 1.0
    middle, bright = np.percentile(brightness, [50, 90])
    return float(0.25 / math.sqrt(middle * bright))


def steady_exposure(job: Job) -> float:
    """One exposure for all frames of a sequence: :func:`automatic_exposure` of the map."""
    return automatic_exposure(job.captured.environment)


def _origin(env_file: Path) -> NDArray[np.float64]:
    value = read_image(env_file).attributes.get("origin")
    origin = np.zeros(0) if value is None else np.array(value, float).reshape(-1)
    if origin.shape == (3,) and not np.isfinite(origin).all():
        raise UserError("its attribute `origin` is NaN or infinite", file=env_file)
    if origin.shape != (3,):
        raise UserError(
            "has no attribute `origin` (x, y, z of the light probe in metres); "
            "make it with `envmap probe`",
            file=env_file,
        )
    return origin


def _write_layers(path: Path, composite: Composite) -> None:
    layers = {
        "RGB": composite.rgb,
        "A": composite.alpha,
        "quotient": composite.quotient,
        "objects": composite.objects,
        "error": composite.standard_error,
        "depth": composite.depth,
    }
    names = {"RGB": list("RGB"), "A": ["A"], "error": ["error.Y"], "depth": ["depth.Z"]}
    channels = [c for k in layers for c in names.get(k, [f"{k}.{c}" for c in "RGB"])]
    write_exr(path, np.dstack(list(layers.values())), channels=channels)
