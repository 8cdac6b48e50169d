"""Sequences: a scene whose objects and cameras have keys, as it stands at one frame.

What is keyed is interpolated property by property, each between the keys that name it, and
held before the first and after the last. Positions, points and field of view run linearly, or
along a cubic Hermite curve with Catmull-Rom tangents (Catmull and Rom 1974; for uneven frames
the slope from the key before to the key after); scales do so in their logarithm; rotations
turn at constant speed about one axis from key to key the shorter way (slerp, Shoemake 1985).
"""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import (
    Object,
    ObjectKey,
    Scene,
    Vector,
    View,
    ViewKey,
    parse_frames,
)

type Interpolation = Literal["linear", "cubic"]

#: Tables of the scene file that the renderer does not read: it reads what they made.
_CAPTURE = frozenset(
    {"name", "bracket", "hdr", "calibrate", "probe", "align", "env", "stand_in", "truth"}
)
_NUMBER = re.compile(r"%0?\d*d")


def moves(scene: Scene, view: View) -> bool:
    """Whether a view is a sequence: keys, frames, or numbers in its files' names."""
    numbered = any(_NUMBER.search(name) for name in (view.plate, view.camera) if name)
    keyed = bool(view.key) or any(entry.key for entry in scene.object)
    return view.frames is not None or numbered or keyed


def frames_of(view: View) -> list[int]:
    """The frames that the scene file gives the view; none where it gives none."""
    return [] if view.frames is None else parse_frames(view.frames)


def at(scene: Scene, frame: int) -> Scene:
    """The scene at a frame: a still of its own, whose keys are those of an open shutter.

    Numbered files are named; the seed is the scene's plus the frame's number, so that the
    noise of frames is independent.
    """
    still = posed(scene, frame)
    shutters = sorted({view.shutter for view in scene.view} - {0.0})
    if shutters:  # what moves while a shutter is open keeps keys, counted from the frame
        still = msgspec.structs.replace(
            still,
            object=[_held(entry, frame, shutters) for entry in scene.object],
            view=[_held_view(view, frame) for view in scene.view],
        )
    views = [
        msgspec.structs.replace(
            view,
            plate=numbered(view.plate, frame),
            camera=numbered(view.camera, frame),
            closing_camera=numbered(view.closing_camera, frame),
            frames=None,
        )
        for view in still.view
    ]
    render = msgspec.structs.replace(scene.render, seed=scene.render.seed + frame)
    return msgspec.structs.replace(still, view=views, render=render)


def posed(scene: Scene, time: int | float) -> Scene:
    """The scene with its objects and cameras as they are at a time, in frames."""
    return msgspec.structs.replace(
        scene,
        object=[object_at(entry, time) for entry in scene.object],
        view=[view_at(view, time) for view in scene.view],
    )


def object_at(entry: Object, time: int | float) -> Object:
    """The object as it is at a time, in frames, without keys."""
    if not entry.key:
        return entry
    position = [(k.frame, k.position) for k in entry.key if k.position is not None]
    rotation = [(k.frame, k.rotation) for k in entry.key if k.rotation is not None]
    scale = [(k.frame, _logarithms(k.scale)) for k in entry.key if k.scale is not None]
    sides = _interpolate(scale, time, entry.interpolation)
    return msgspec.structs.replace(
        entry,
        position=_vector(_interpolate(position, time, entry.interpolation), entry.position),
        rotation=_turn(rotation, time) or entry.rotation,
        scale=entry.scale if sides is None else _exponentials(sides),
        key=[],
    )


def view_at(view: View, time: int | float) -> View:
    """The view as it is at a time, in frames, without keys."""
    if not view.key:
        return view
    position = [(k.frame, k.position) for k in view.key if k.position is not None]
    look_at = [(k.frame, k.look_at) for k in view.key if k.look_at is not None]
    rotation = [(k.frame, k.rotation) for k in view.key if k.rotation is not None]
    fov = [(k.frame, (k.fov,)) for k in view.key if k.fov is not None]
    angle = _interpolate(fov, time, view.interpolation)
    place = _interpolate(position, time, view.interpolation)
    return msgspec.structs.replace(
        view,
        position=view.position if place is None else _vector(place, (0.0, 0.0, 0.0)),
        look_at=_vector(_interpolate(look_at, time, view.interpolation), view.look_at),
        rotation=_turn(rotation, time) or view.rotation,
        # a cubic curve may swing a little beyond its keys
        fov=view.fov if angle is None else min(max(angle[0], 1e-3), 360.0),
        key=[],
    )


def _held(entry: Object, frame: int, shutters: Sequence[float]) -> Object:
    """The object at a frame, with keys at 0 and where shutters close."""
    now = object_at(entry, frame)
    if not entry.key:
        return now
    later = [(t, object_at(entry, frame + t)) for t in (0.0, *shutters)]
    keys = [
        ObjectKey(frame=t, position=o.position, rotation=o.rotation, scale=o.scale)
        for t, o in later
    ]
    return msgspec.structs.replace(now, key=keys, interpolation="linear")


def _held_view(view: View, frame: int) -> View:
    """The view at a frame, with keys at 0 and where its shutter closes."""
    now = view_at(view, frame)
    if not view.key or not view.shutter:
        return now
    later = [(t, view_at(view, frame + t)) for t in (0.0, view.shutter)]
    keys = [
        ViewKey(
            frame=t,
            position=v.position,
            look_at=None if v.rotation else v.look_at,
            rotation=v.rotation,
            fov=v.fov,
        )
        for t, v in later
    ]
    return msgspec.structs.replace(now, key=keys, interpolation="linear")


def numbered(name: str | None, frame: int) -> str | None:
    """The file's name with the frame's number in it: ``plates/%04d.exr``."""
    return name and _NUMBER.sub(lambda found: found[0] % frame, name)


def rendered_part(scene: Scene, view: View) -> dict[str, Any]:
    """What of a still's scene file decides the picture of one view; the rest may change."""
    part: dict[str, Any] = msgspec.to_builtins(scene)
    kept = {key: value for key, value in part.items() if key not in _CAPTURE}
    return {**kept, "view": msgspec.to_builtins(view)}


def missing_plates(view: View, frames: Sequence[int], folder: Path) -> None:
    """Refuse a sequence of which numbered files are missing, before any work.

    Raises
    ------
    UserError
        That names the first frame whose plate or camera is not there.

    """
    for what, name in (
        ("plate", view.plate),
        ("camera", view.camera),
        ("camera at the shutter's close", view.closing_camera),
    ):
        if not name or not _NUMBER.search(name):
            continue
        gone = [n for n in frames if not (folder / str(numbered(name, n))).is_file()]
        if gone:
            more = f" (and of {len(gone) - 1} more)" if len(gone) > 1 else ""
            raise UserError(
                f"the {what} of frame {gone[0]}{more} is missing; put it there, or leave the "
                "frame out with --frames",
                file=folder / str(numbered(name, gone[0])),
            )


def _interpolate(
    keys: Sequence[tuple[float, Sequence[float]]],
    time: int | float,
    interpolation: Interpolation,
) -> tuple[float, ...] | None:
    """Values at a time among keys (frame, values), held outside; None without keys."""
    if not keys:
        return None
    t = [frame for frame, _ in keys]
    now = min(max(float(time), t[0]), t[-1])
    k = max(1, bisect.bisect_left(t, now))
    if k == len(t):  # one key alone
        return tuple(keys[0][1])
    span = t[k] - t[k - 1]
    u = (now - t[k - 1]) / span
    a, b = keys[k - 1][1], keys[k][1]
    if interpolation == "linear":
        return tuple((1 - u) * p + u * q for p, q in zip(a, b, strict=True))

    def slopes(i: int) -> list[float]:
        low, high = max(i - 1, 0), min(i + 1, len(keys) - 1)
        ends = zip(keys[low][1], keys[high][1], strict=True)
        return [(q - p) / (t[high] - t[low]) for p, q in ends]

    rise = u * u * (3 - 2 * u)
    leave, arrive = span * u * (1 - u) ** 2, span * u * u * (u - 1)
    return tuple(
        (1 - rise) * p + rise * q + leave * m + arrive * n
        for p, q, m, n in zip(a, b, slopes(k - 1), slopes(k), strict=True)
    )


def _turn(keys: Sequence[tuple[float, Vector]], time: int | float) -> Vector | None:
    """Degrees about x, y, z in turn at a time among keys; None without keys."""
    if not keys:
        return None
    t = [frame for frame, _ in keys]
    now = min(max(float(time), t[0]), t[-1])
    if now in t:  # a key's own angles, not others that mean the same
        return keys[t.index(now)][1]
    from scipy.spatial.transform import Rotation, Slerp

    turns = Rotation.from_euler("xyz", [angles for _, angles in keys], degrees=True)
    angles = Slerp(t, turns)(now).as_euler("xyz", degrees=True, suppress_warnings=True)
    return _vector(angles.tolist(), (0.0, 0.0, 0.0))


def _logarithms(scale: float | Vector) -> Vector:
    x, y, z = scale if isinstance(scale, tuple) else (scale, scale, scale)
    return math.log(x), math.log(y), math.log(z)


def _exponentials(values: Sequence[float]) -> Vector:
    x, y, z = values
    return math.exp(x), math.exp(y), math.exp(z)


def _vector(values: Sequence[float] | None, otherwise: Vector) -> Vector:
    if values is None:
        return otherwise
    x, y, z = values
    return x, y, z
