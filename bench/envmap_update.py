"""Light that changes, and light between probes: a path-traced room as the truth."""

from __future__ import annotations

import time

import numpy as np

from bench import virtual_room as room
from bench.row import Row
from bench.virtual_room import Array, Picture
from chromeball.cli.envmap.geometry import caster
from chromeball.envmap.predict import Frame, compare
from chromeball.envmap.several import ProbeMap, light_at
from chromeball.envmap.update import Kind, find_change, ratio_map

#: On either side of the screen, in the passage, and a place behind the screen.
PLACES = np.array([[-1.5, 1.2, 0.8], [1.4, 1.2, 0.6], [0.2, 1.4, 1.4]])
HELD_OUT = np.array([1.6, 1.0, -1.0])
UNIT = "% of mean"


def rows(quick: bool) -> list[Row]:
    """Errors of a map after a change; errors at a held-out place by 1, 2 and 3 probes."""
    width = 64 if quick else 128
    return [*_changes(width), *_places(width)]


def _changes(width: int) -> list[Row]:
    cast = caster(room.stand_in())
    env = ProbeMap(room.panorama(PLACES[0], width=width), PLACES[0])
    size = (width, width * 3 // 4)
    cameras = [
        room.view([2.2, 1.5, 1.6], [-1.5, 0.3, -0.3], size),
        room.view([-2.2, 1.5, 1.6], [1.5, 0.3, 0.3], size),
    ]
    found: list[Row] = []
    for what, lamps in (
        ("all dimmed to 0.7", (0.7, 0.7)),
        ("a lamp switched off", (1.3, 0.0)),
    ):
        truth = room.panorama(PLACES[0], lamps, width)
        frames = [
            Frame(room.photograph(c, lamps), c, np.ones(c.size[::-1], bool)) for c in cameras
        ]
        title = f"update, {what}"
        found.append(
            Row("envmap", title, "the old map", 0.0, _error(env.radiance, truth), UNIT)
        )
        kinds: tuple[Kind | None, ...] = ("global", "lamps", "regions", None)
        for kind in kinds:
            start = time.process_time()
            change = find_change(env, [compare(env, f, cast) for f in frames], cast, kind)
            made = env.radiance * ratio_map(env, change, cast)
            seconds = time.process_time() - start
            tool = f"chromeball, {kind or f'chosen: {change.chosen.model.kind}'}"
            found.append(Row("envmap", title, tool, seconds, _error(made, truth), UNIT))
    return found


def _places(width: int) -> list[Row]:
    cast = caster(room.stand_in())
    probes = [ProbeMap(room.panorama(p, width=width), p) for p in PLACES]
    truth = room.panorama(HELD_OUT, width=width)
    title = "light behind a screen"
    found: list[Row] = []
    for count in (1, 2, 3):
        start = time.process_time()
        made = light_at(probes[:count], HELD_OUT, cast, width)
        seconds = time.process_time() - start
        tool = f"chromeball, {count} probe{'s' if count > 1 else ''}"
        found.append(Row("envmap", title, tool, seconds, _error(made.radiance, truth), UNIT))
    near = np.linalg.norm(PLACES - HELD_OUT, axis=1)
    share = (1 / near) / (1 / near).sum()
    faded = sum(w * p.radiance.astype(float) for w, p in zip(share, probes, strict=True))
    nearest = probes[int(near.argmin())].radiance
    plain = {"nearest probe": nearest, "cross-fade of 3": np.asarray(faded)}
    for tool, picture in plain.items():
        found.append(Row("envmap", title, tool, 0.0, _error(picture, truth), UNIT))
    return found


def _error(made: Picture | Array, truth: Picture) -> float:
    """Mean absolute difference over the mean, percent."""
    return 100 * float(np.abs(made - truth).mean() / truth.mean())
