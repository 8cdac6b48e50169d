"""An interactive session: a scene that is changed while one thread renders it for all who look.

Who looks is an :class:`Eye`: a camera, a size, a function that is given pictures. While
something moves the picture is small and coarse, sized so that a frame takes the time that was
asked for; at rest it is whole and gets sharper until its error is below the bound, and then
nothing runs. One compositor serves all eyes in turn.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.converge import Convergence
from chromeball.renderer.lights import area_lights, delta_lights
from chromeball.renderer.mesh import Instance, Mesh, affine
from chromeball.renderer.path import corner_rays
from chromeball.renderer.render import (
    automatic_exposure,
    backdrop,
    captured_set,
    gloss_of,
)
from chromeball.renderer.scene import (
    baked,
    instances_of,
    object_instances,
    pose_of,
    to_material,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import to_display
from chromeball.scene.manifest import Object, Scene, read_scene
from chromeball.scene.pose import Pose
from chromeball.scene.sequence import at, frames_of, moves

type Light = Literal["path", "direct"]
_LIGHT: tuple[Light, ...] = get_args(Light.__value__)
#: An object's keys where it is neither scaled, nor turned, nor moved.
_HOME: dict[str, Any] = {"position": (0.0,) * 3, "rotation": (0.0,) * 3, "scale": 1.0}

#: Seconds without a change until the whole picture is begun.
REST = 0.2
#: Samples a pixel after which an error that is out of reach is given up.
MOST_SAMPLES = 4096
#: Sub-samples of a background pixel without a photograph, while moving and at rest.
_BACKGROUND = 1, 8


@dataclass(frozen=True)
class Settings:
    """``stops`` of exposure, relative ``error`` to end at; ``fps``, ``samples`` in motion.

    ``integrator``: of the picture at rest; in motion it is always ``direct``, the fast one.
    """

    integrator: Light = "path"
    stops: float = 0.0
    error: float = 0.01
    fps: float = 15.0
    samples: int = 4


@dataclass(frozen=True)
class Picture:
    """What an eye is shown: (H, W, 3) uint8 sRGB, and how good it is.

    ``seconds`` from the change, or the last picture, to this one; ``error`` of the changed
    pixels relative to their mean, None where it is not known; ``done``: there is no next one.
    """

    codes: NDArray[np.uint8]
    samples: int
    seconds: float
    error: float | None
    moving: bool
    done: bool


class Pace:
    """Steers the size of moving pictures by the time that the last ones took."""

    def __init__(self, least: float = 1 / 8) -> None:
        self._least = least
        #: side of the moving picture over that of the whole one
        self.scale = 0.5

    def measured(self, seconds: float, wanted: float) -> None:
        """Take note of a frame: time goes with the number of pixels, changes are gentle."""
        step = math.sqrt(wanted / max(seconds, 1e-6))
        self.scale = min(1.0, max(self._least, self.scale * min(1.25, max(0.6, step))))


@dataclass(eq=False)
class Eye:
    """One who looks. Only :class:`Session` changes it."""

    show: Callable[[Picture], None]
    size: tuple[int, int]
    camera: CameraModel
    plate: NDArray[np.float32] | None = None
    view: str | None = None
    pace: Pace = field(default_factory=Pace)
    version: int = 0
    changed: float = -math.inf
    #: what the last picture showed: version of eye and world, and whether it was the whole one
    shown: tuple[int, int, bool] | None = None
    done: bool = False


class Session:
    """The scene as it is being changed, and the thread that renders it.

    Parameters
    ----------
    scene_file
        The scene.toml; what its views and objects need must have been made.
    travel
        Let cameras go anywhere; else they stay within :attr:`radius` of where light or plates
        were captured.
    radius
        Metres; by default half the distance from the probe to the nearest stand-in geometry.
        Without such geometry the set is infinitely far and looks the same from anywhere.
    frame
        Of a sequence, the frame that is shown; by default its first.
    clock
        Seconds, for tests.

    Raises
    ------
    UserError
        When an input is missing or broken.

    """

    def __init__(
        self,
        scene_file: str | os.PathLike[str],
        *,
        travel: bool = False,
        radius: float | None = None,
        frame: int | None = None,
        settings: Settings | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.file = Path(scene_file)
        self.folder = self.file.parent
        self._loaded = read_scene(self.file)
        #: objects whose keys move them: what is seen is one frame of them
        self.keyed = frozenset(o.name for o in self._loaded.object if o.key)
        #: the frame of a sequence that is shown, None for a still
        self.frame = _first_frame(self._loaded) if frame is None else frame
        self._scene = self._loaded if self.frame is None else at(self._loaded, self.frame)
        self._saved = self._scene
        if not self._scene.view:
            raise UserError("the scene has no [[view]] to begin with", file=self.file)
        if self._scene.render.integrator == "ao":
            raise UserError("the viewer needs a light probe: ao scenes are rendered alone")
        self.captured, _ = captured_set(self._scene, self.folder)
        self.views = {
            view.name: backdrop(self._scene, self.folder, view, self.captured.origin)
            for view in self._scene.view
        }
        self._places = [self.captured.origin] + [
            b.camera.world_from_camera.translation for b in self.views.values()
        ]
        self.radius = math.inf if travel else _radius(self.captured, radius)
        self.exposure = self._steady_exposure()
        home = [msgspec.structs.replace(o, **_HOME) for o in self._scene.object]
        at_home = msgspec.structs.replace(self._scene, object=home)
        #: of each object its parts before it is scaled, turned and moved
        self._parts = object_instances(at_home, self.folder)
        self._materials = [o.material for o in self._scene.object]
        self._lamps = area_lights(self._scene, self.folder)
        #: a compositor for each integrator that was asked for, with the objects it has
        self._compositors: dict[str, tuple[Compositor, list[Object]]] = {}
        #: the integrators that can be had, the fastest last
        self.integrators: tuple[Light, ...] = _LIGHT
        self._settings = settings or Settings(integrator=self._scene.render.integrator)
        self._eyes: list[Eye] = []
        self._version = 0
        self._wake = threading.Condition()
        self._stopping = self._showing = False
        self._clock = clock
        #: the eye that the compositor's samples belong to, and the error of its picture
        self._current: Eye | None = None
        self._error: float | None = None
        self._converging: Convergence
        #: what ended the thread, if anything did
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        self._thread.start()

    # ---- what others ask and tell, from any thread

    @property
    def scene(self) -> Scene:
        """The scene as it is now; of a sequence, at its frame."""
        return self._scene

    @property
    def settings(self) -> Settings:
        """As they are now."""
        return self._settings

    def eyes(self) -> tuple[Eye, ...]:
        """Who looks."""
        with self._wake:
            return tuple(self._eyes)

    def open(
        self, show: Callable[[Picture], None], size: tuple[int, int], view: str | None = None
    ) -> Eye:
        """A new eye with a window of `size` pixels, at a view or at the scene's first."""
        with self._wake:
            eye = Eye(show, size, next(iter(self.views.values())).camera)
            self._eyes.append(eye)
        self.choose(eye, view or next(iter(self.views)))
        return eye

    def close(self, eye: Eye) -> None:
        """Stop work for an eye."""
        with self._wake:
            self._eyes.remove(eye)
            self._wake.notify_all()

    def choose(self, eye: Eye, view: str) -> CameraModel:
        """Look through a view's own camera, its photograph behind; returns the camera."""
        if view not in self.views:
            raise UserError(f"there is no [[view]] named {view!r}")
        back = self.views[view]
        with self._wake:
            eye.camera, eye.plate, eye.view = back.camera, back.plate, view
            self._touch(eye)
        return back.camera

    def look(self, eye: Eye, camera: CameraModel) -> CameraModel:
        """Look from elsewhere, the captured set behind; returns the camera within bounds."""
        pose = camera.world_from_camera
        held = camera.posed(Pose(pose.rotation, self.within(pose.translation)))
        with self._wake:
            if eye.view is not None or held.text() != eye.camera.text():
                eye.camera, eye.plate, eye.view = held, None, None
                self._touch(eye)
        return held

    def resize(self, eye: Eye, size: tuple[int, int]) -> None:
        """Another window size."""
        with self._wake:
            if eye.size != size:
                eye.size = size
                self._touch(eye)

    def within(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """The nearest place (3,) to `place` that cameras may go to."""
        distances = [float(np.linalg.norm(place - p)) for p in self._places]
        k = int(np.argmin(distances))
        if distances[k] <= self.radius:
            return place
        return self._places[k] + (place - self._places[k]) * (self.radius / distances[k])

    def change(self, name: str, **fields: Any) -> Object:
        """Change an object's position, rotation, scale or material; the object as it is then.

        Raises
        ------
        UserError
            For no such object, a keyed one, or a value that the scene file would not take.

        """
        with self._wake:
            k = self._index(name)
            if name in self.keyed:
                raise UserError(f"{name!r} is moved by its keys: change them in the scene file")
            old = self._scene.object[k]
            value = {**msgspec.to_builtins(old), **msgspec.to_builtins(fields)}
            try:
                new = msgspec.convert(value, Object, strict=False)
            except msgspec.ValidationError as error:
                raise UserError(f"{name}: {error}") from error
            if new.material is not None and new.material != old.material:
                to_material(new.material, self.folder)  # its images are there and whole
            if new != old:
                objects = [*self._scene.object]
                objects[k] = new
                self._scene = msgspec.structs.replace(self._scene, object=objects)
                self._version += 1
                self._touch(*self._eyes)
            return new

    def set(self, **fields: Any) -> None:
        """Change :class:`Settings`; only another integrator begins the picture again."""
        with self._wake:
            before = self._settings
            after = replace(before, **fields)
            self._settings = after
            for eye in self._eyes:
                eye.done = False
            if before.integrator != self._settings.integrator:
                self._current = None
            self._wake.notify_all()

    def changed(self) -> list[Object]:
        """The objects that are not as the scene file has them."""
        pairs = zip(self._scene.object, self._saved.object, strict=True)
        return [now for now, then in pairs if now != then]

    def save(self, target: Path, *, overwrite: bool = False) -> int:
        """Write the scene file with the objects as they are now; how many were changed.

        Comments are kept. `target` lies in the scene's folder, as its paths are relative.

        Raises
        ------
        UserError
            When `target` is there and `overwrite` is not said, lies elsewhere or cannot be
            written.

        """
        from chromeball.renderer.save import save

        target = self.folder / target
        if target.resolve().parent != self.folder.resolve() or target.suffix != ".toml":
            raise UserError("save to a .toml file in the scene's own folder", file=target)
        with self._wake:
            objects, scene = self.changed(), self._scene
        save(self.file, target, objects, overwrite=overwrite)
        if target.exists() and target.samefile(self.file):
            self._saved = scene
        return len(objects)

    def size_of(self, name: str) -> float:
        """Half the diagonal of an object's bounding box, in metres, as it is now."""
        k = self._index(name)
        corners = np.concatenate([baked(part).vertices for part in self._parts[k]])
        sides = np.ptp(corners, axis=0) * np.asarray(self._scene.object[k].scale)
        return float(np.linalg.norm(sides)) / 2

    def stop(self) -> None:
        """End the thread."""
        with self._wake:
            self._stopping = True
            self._wake.notify_all()
        self._thread.join()

    def wait(self) -> None:
        """Wait until the thread ends; raise what ended it."""
        self._thread.join()
        if self.failure is not None:
            raise self.failure

    def is_idle(self) -> bool:
        """Whether nothing is left to do for any eye."""
        with self._wake:
            shown = all(eye.done and self._is_shown(eye) for eye in self._eyes)
            return shown and not self._showing

    # ---- the worker

    def _run(self) -> None:
        try:
            while self._step():
                pass
        except Exception as error:
            self.failure = error  # raised by `wait`

    def _step(self) -> bool:
        """One frame or one wait; False at the end."""
        with self._wake:
            eye, wait = self._next()
            if self._stopping:
                return False
            if eye is None:
                self._wake.wait(wait)
                return True
            moving = self._clock() - eye.changed < REST
            state = (eye.version, self._version, not moving)
            fresh = eye.shown != state or self._current is not eye
            camera, plate, size = eye.camera, eye.plate, eye.size
            objects, settings = self._scene.object, self._settings
        picture = self._frame(eye, fresh, moving, camera, plate, size, objects, settings)
        with self._wake:
            eye.shown, eye.done = state, picture.done
            open_still = eye in self._eyes
            self._showing = True
        if open_still:
            eye.show(picture)
        with self._wake:
            self._showing = False
        return True

    def _next(self) -> tuple[Eye | None, float | None]:
        """Whose picture is next, or how long nothing needs to be done."""
        now = self._clock()
        stale = [eye for eye in self._eyes if not self._is_shown(eye)]
        if stale:
            return min(stale, key=lambda eye: eye.changed), None
        rested = [e for e in self._eyes if not e.done and now - e.changed >= REST]
        if rested:  # one after the other: the samples of one would be lost in turns
            return (self._current if self._current in rested else rested[0]), None
        waits = [REST - (now - e.changed) for e in self._eyes if not e.done]
        return None, min(waits, default=None)

    def _is_shown(self, eye: Eye) -> bool:
        return eye.shown is not None and eye.shown[:2] == (eye.version, self._version)

    def _frame(
        self,
        eye: Eye,
        fresh: bool,
        moving: bool,
        camera: CameraModel,
        plate: NDArray[np.float32] | None,
        size: tuple[int, int],
        objects: list[Object],
        settings: Settings,
    ) -> Picture:
        start = self._clock()
        integrator = self.integrators[-1] if moving else settings.integrator
        compositor = self._ready(integrator, objects)
        if fresh:
            fit = min(1.0, size[0] / camera.size[0], size[1] / camera.size[1])
            small = _scaled(camera, fit * (eye.pace.scale if moving else 1.0))
            rays, place = corner_rays(small), small.world_from_camera.translation
            back = (
                compositor.background(rays, place, _BACKGROUND[not moving])
                if plate is None
                else _shrunk(plate, small.size)
            )
            compositor.look(rays, place, back)
            self._current, self._error = eye, None
            self._converging = Convergence(compositor.counts_all_noise())
        if moving:
            compositor.add(settings.samples)
            rgb, done = compositor.picture(), False
        else:
            if compositor.samples == 0:
                compositor.add(1 if settings.integrator == "path" else settings.samples)
            elif not self._is_enough(compositor, settings):  # as many again, up to a limit
                compositor.refine(min(16, compositor.samples))
            result = compositor.result()
            self._error = self._converging.error(result, compositor.samples)
            rgb, done = result.rgb, self._is_enough(compositor, settings)
        codes = to_display(rgb, self.exposure * 2.0**settings.stops)
        seconds = self._clock() - start
        if moving:
            eye.pace.measured(seconds, 1 / settings.fps)
        return Picture(
            letterbox(codes, size[0] / size[1]),
            compositor.samples,
            seconds,
            self._error,
            moving,
            done,
        )

    def _is_enough(self, compositor: Compositor, settings: Settings) -> bool:
        low = self._error is not None and self._error <= settings.error
        least = self._converging.least()
        return (compositor.samples >= least and low) or compositor.samples >= MOST_SAMPLES

    def _ready(self, integrator: Light, objects: list[Object]) -> Compositor:
        """The integrator's compositor, its world brought to `objects` by the cheapest way."""
        for k, entry in enumerate(objects):
            if entry.material != self._materials[k]:
                self._parts[k] = self._made_of(entry, self._parts[k])
                self._materials[k] = entry.material
        if integrator not in self._compositors:
            self._compositors[integrator] = self._build(integrator, objects), objects
        compositor, built = self._compositors[integrator]
        pairs = list(zip(objects, built, strict=True))
        if all(_can_be_moved(now, then) for now, then in pairs):
            first = 0
            for (now, then), parts in zip(pairs, self._parts, strict=True):
                if now != then:
                    for k in range(first, first + len(parts)):
                        compositor.move(k, pose_of(now), now.scale)
                first += len(parts)
        else:
            compositor.place(self._instances(objects))
        self._compositors[integrator] = compositor, objects
        return compositor

    def _build(self, integrator: Light, objects: list[Object]) -> Compositor:
        render = self._scene.render
        return Compositor(
            self._instances(objects),
            self.captured,
            corner_rays(CameraModel.pinhole((1, 1), 1.0)),
            self.captured.origin,
            np.zeros((1, 1, 3), np.float32),
            bounces=render.bounces,
            mode=render.composite,
            reflect=render.reflect,
            gloss=gloss_of(self._scene) if integrator == "path" else None,
            seed=render.seed,
            samples=256,
            integrator=integrator,
            lights=delta_lights(self._scene),
        )

    def _instances(self, objects: list[Object]) -> list[Instance]:
        found: list[Instance] = []
        for entry, parts in zip(objects, self._parts, strict=True):
            if entry.instances:  # each copy has a pose of its own, after the object's
                own = np.vstack([affine(pose_of(entry), entry.scale), [0, 0, 0, 1]])
                inner = [np.eye(4) if part.inner is None else part.inner for part in parts]
                found += [
                    replace(part, inner=own @ i) for part, i in zip(parts, inner, strict=True)
                ]
            else:
                found += [replace(p, pose=pose_of(entry), scale=entry.scale) for p in parts]
        return [*found, *self._lamps]

    def _made_of(self, entry: Object, parts: list[Instance]) -> list[Instance]:
        """The parts of an object in its new material; shared triangles stay shared."""
        if entry.material is None:  # the file's own
            return instances_of(msgspec.structs.replace(entry, **_HOME), self.folder)
        material = to_material(entry.material, self.folder)
        known: dict[int, Mesh] = {}
        for part in parts:
            mesh = part.mesh
            index = np.zeros(len(mesh.faces), np.uint16)
            known.setdefault(id(mesh), replace(mesh, material=index, materials=(material,)))
        return [replace(part, mesh=known[id(part.mesh)]) for part in parts]

    # ---- small things

    def _touch(self, *eyes: Eye) -> None:
        now = self._clock()
        for eye in eyes:
            eye.version += 1
            eye.changed, eye.done = now, False
        self._wake.notify_all()

    def _index(self, name: str) -> int:
        for k, entry in enumerate(self._scene.object):
            if entry.name == name:
                return k
        raise UserError(f"there is no [[object]] named {name!r}")

    def _steady_exposure(self) -> float:
        """One exposure for all views, so that they can be compared."""
        for view in self._scene.view:
            if view.exposure is not None:
                return view.exposure
        plates = [b.plate for b in self.views.values() if b.plate is not None]
        return automatic_exposure(plates[0] if plates else self.captured.environment)


def letterbox(codes: NDArray[np.uint8], aspect: float) -> NDArray[np.uint8]:
    """The picture between black bars, so that its width over height is `aspect`."""
    height, width = codes.shape[:2]
    wide, high = max(width, round(height * aspect)), max(height, round(width / aspect))
    if (wide, high) == (width, height):
        return codes
    framed = np.zeros((high, wide, 3), np.uint8)
    y, x = (high - height) // 2, (wide - width) // 2
    framed[y : y + height, x : x + width] = codes
    return framed


def _first_frame(scene: Scene) -> int | None:
    """The frame that a sequence begins with, None for a scene of stills."""
    if not any(moves(scene, view) for view in scene.view):
        return None
    numbers = [n for view in scene.view for n in frames_of(view)[:1]]
    keys = [key.frame for entry in scene.object for key in entry.key]
    keys += [key.frame for view in scene.view for key in view.key]
    return numbers[0] if numbers else round(min(keys, default=1))


def _radius(captured: CapturedSet, given: float | None) -> float:
    if given is not None:
        if not given >= 0:
            raise UserError(f"--radius is {given}; it is 0 or more metres")
        return given
    if captured.stand_in is None:
        return math.inf
    vertices = captured.stand_in.original.astype(float)
    nearest = nearest_distance(captured.origin, vertices[captured.stand_in.faces])
    return nearest / 2


def nearest_distance(point: NDArray[np.float64], triangles: NDArray[np.float64]) -> float:
    """Distance of a point (3,) to the nearest of triangles (F, 3, 3).

    Of each triangle, the plane's foot where it lies inside, else the nearest of the edges.
    """
    a, b, c = (triangles[:, i] for i in range(3))
    n = np.cross(b - a, c - a)
    area = np.linalg.norm(n, axis=1)
    n = n / np.where(area > 0, area, 1)[:, None]
    height = np.einsum("fi,fi->f", point - a, n)
    foot = point - height[:, None] * n
    inside = area > 0
    distances = np.full(len(triangles), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge = q - p
        inside &= np.einsum("fi,fi->f", np.cross(edge, foot - p), n) >= 0
        length2 = np.einsum("fi,fi->f", edge, edge)
        t = np.einsum("fi,fi->f", point - p, edge) / np.where(length2 > 0, length2, 1)
        near = p + np.clip(t, 0, 1)[:, None] * edge
        distances = np.minimum(distances, np.linalg.norm(near - point, axis=1))
    return float(np.where(inside, np.minimum(distances, np.abs(height)), distances).min())


def _can_be_moved(now: Object, then: Object) -> bool:
    """Whether objects are alike but for a pose that no copies hang on."""
    pose = {"position": then.position, "rotation": then.rotation, "scale": then.scale}
    return now == then or (not now.instances and msgspec.structs.replace(now, **pose) == then)


def _scaled(camera: CameraModel, factor: float) -> CameraModel:
    """The camera with fewer pixels, at least one a side."""
    least = 1 / min(camera.size)
    return camera if factor == 1 else camera.scaled(max(factor, least))


def _shrunk(plate: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """The plate on fewer pixels, each the mean of what it covers."""
    if size == (plate.shape[1], plate.shape[0]):
        return plate
    import cv2

    return np.asarray(cv2.resize(plate, size, interpolation=cv2.INTER_AREA), np.float32)
