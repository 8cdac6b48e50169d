"""Frames and tiles of a view as tasks that can be made alone, anywhere and in any order.

A task's outputs do not depend on which others are made with it: a frame has a seed of its own
(the scene's plus its number), and a tile has equally many samples in each pixel (steering
looks at the whole picture). Tiles keep the sums of their samples, so that the joined picture
is bit for bit that of one tile which is the whole. A finished task is one whose record says
that it came from the same part of the scene file and the same files.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.composite import Integrator
from chromeball.renderer.render import (
    PASS,
    Budget,
    Job,
    Progress,
    accumulate,
    check_target,
    expected_samples,
    prepare,
    steady_exposure,
    write_composite,
)
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.manifest import Scene, View, read_scene
from chromeball.scene.record import Stage, check_output, content_hash, read_json, record_path
from chromeball.scene.sequence import at, numbered, rendered_part

#: Tiles are bands of so many rows, dealt in turn: each gets its share of every part.
BAND = 8


@dataclass(frozen=True)
class Tile:
    """The `index`-th of `count` tiles, from 1."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> list[Tile]:
        """One tile from ``i/n``, all of them from ``n``."""
        found = re.fullmatch(r"\s*(?:(\d{1,6})/)?(\d{1,6})\s*", text)
        first = int(found[1] or 1) if found else 0
        count = int(found[2]) if found else 0
        if not found or not 1 <= first <= count:
            raise UserError(f"{text!r:.40} is no tile: write 1/4, or 4 for all four")
        return [cls(k, count) for k in ([first] if found[1] else range(1, count + 1))]

    def rows(self, height: int) -> NDArray[np.bool_]:
        """Which rows (height,) of a picture are the tile's."""
        return np.arange(height) // BAND % self.count == self.index - 1

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


@dataclass(frozen=True)
class Task:
    """One picture or one tile of it: all that another process needs to know.

    ``frame``: none for a still. ``output``: the EXR of the whole picture, ``%04d`` in it being
    the frame's number; none: ``VIEW.exr`` or ``VIEW.%04d.exr`` in the scene's folder.
    ``integrator``: another than the scene file's; ``denoise``: whatever it says.
    """

    scene_file: str
    view: str
    budget: Budget = field(default_factory=Budget)
    frame: int | None = None
    tile: Tile | None = None
    output: str | None = None
    integrator: Integrator | None = None
    denoise: bool = False

    def __str__(self) -> str:
        frame = "" if self.frame is None else f" frame {self.frame}"
        return self.view + frame + ("" if self.tile is None else f" tile {self.tile}")


@dataclass(frozen=True)
class Outcome:
    """What became of a task; ``kept``: it stood there finished. ``error``: why it failed."""

    task: Task
    state: Literal["rendered", "kept", "failed"]
    output: str = ""
    figures: dict[str, Any] = field(default_factory=dict[str, Any])
    error: str = ""


def make(task: Task, *, force: bool = False, progress: Progress | None = None) -> Outcome:
    """Make a task's outputs, unless they stand there finished; a last tile joins them all.

    Raises
    ------
    UserError
        When an input is missing or broken, or an output cannot be written.

    """
    picture = _Picture.of(task)
    if not force and (kept := picture.finished()) is not None:
        return Outcome(task, "kept", os.fspath(picture.target), kept)
    if task.tile is None:
        return picture.render(progress)
    file = picture.tile_file(task.tile)
    figures = None if force else picture.finished_tile(task.tile)
    outcome = Outcome(task, "kept", os.fspath(file), figures or {})
    if figures is None:
        outcome = picture.render_tile(task.tile, progress)
    if all(
        _figures(f, picture.digest(t), picture.folder) is not None for t, f in picture.tiles()
    ):
        try:
            return join(task)
        except UserError:
            # the maker of another tile may have joined them just now
            if picture.finished() is None:
                raise
    return outcome


def join(task: Task) -> Outcome:
    """The whole picture from its tiles, which are removed when it is written.

    Raises
    ------
    UserError
        When tiles are missing, or made for another scene, size, seed or number of samples.

    """
    picture = _Picture.of(replace(task, tile=task.tile or Tile(1, _tile_count(task))))
    return picture.join()


def outputs(tasks: Iterable[Task]) -> list[Path]:
    """The pictures that `tasks` lead to, each once."""
    return list(dict.fromkeys(_Picture.of(task).target for task in tasks))


@dataclass(frozen=True)
class _Picture:
    """A task's picture: the scene at its frame, and where it goes."""

    task: Task
    scene: Scene
    view: View
    folder: Path
    target: Path
    budget: Budget

    @classmethod
    def of(cls, task: Task) -> _Picture:
        file = Path(task.scene_file)
        scene = read_scene(file)
        if task.frame is not None:
            scene = at(scene, task.frame)
        view = next((v for v in scene.view if v.name == task.view), None)
        if view is None:
            raise UserError(f"there is no [[view]] named {task.view!r}", file=file)
        render = scene.render
        if task.integrator is not None:
            render = msgspec.structs.replace(render, integrator=task.integrator)
        if task.denoise:
            render = msgspec.structs.replace(render, denoise=True)
        scene = msgspec.structs.replace(scene, render=render)
        if task.tile is not None and scene.render.integrator != "path":
            raise UserError("tiles are for the path integrator: direct makes whole frames")
        number = "" if task.frame is None else f".{task.frame:04d}"
        default = file.parent / scene.folder / f"{view.name}{number}.exr"
        target = task.output or os.fspath(default)
        if task.frame is not None and task.output:
            target = str(numbered(task.output, task.frame))
        budget = task.budget
        if task.tile is not None and (budget.seconds or budget.error):
            raise UserError("tiles of one picture need equally many samples: say --spp alone")
        if budget == Budget():
            budget = Budget(spp=scene.render.spp)
        return cls(task, scene, view, file.parent, check_target(target, view.look), budget)

    # ---- what is finished

    def digest(self, tile: Tile | None = None) -> str:
        """A hash of what of the scene file and command decides the picture, or its tile."""
        part = rendered_part(self.scene, self.view)
        how = [self.budget, "even" if self.task.tile else "steered", tile and str(tile)]
        text = msgspec.json.encode([part, how], order="sorted")
        return hashlib.blake2b(text, digest_size=16).hexdigest()

    def finished(self) -> dict[str, Any] | None:
        """The figures of the picture's record, if it is finished."""
        if not self.target.with_suffix(".png").is_file():
            return None
        return _figures(self.target, self.digest(), self.folder)

    def stage(self, name: str, job: Job, tile: Tile | None = None) -> Stage:
        return Stage(
            name,
            [self.task.scene_file, *job.inputs],
            view=self.view.name,
            seed=self.scene.render.seed,
            frame=self.task.frame,
            digest=self.digest(tile),
            sources=_sources(job.inputs, self.folder),
        )

    # ---- the work

    def prepare(self) -> Job:
        job = prepare(self.scene, self.folder, self.view, expected_samples(self.budget))
        if self.task.frame is None:
            return job
        return replace(job, exposure=job.exposure or steady_exposure(job))

    def render(self, progress: Progress | None) -> Outcome:
        job = self.prepare()
        with self.stage("render", job) as stage:
            composite, error = accumulate(job.compositor, self.budget, progress)
            write_composite(stage, job, composite, error, self.target)
        return Outcome(self.task, "rendered", os.fspath(self.target), dict(stage.figures))

    # ---- tiles

    def tile_file(self, tile: Tile) -> Path:
        name = f"{self.target.stem}.tile-{tile.index}-of-{tile.count}.exr"
        return self.target.with_name(name)

    def tiles(self) -> list[tuple[Tile, Path]]:
        assert self.task.tile is not None
        count = self.task.tile.count
        every = [Tile(i + 1, count) for i in range(count)]
        return [(tile, self.tile_file(tile)) for tile in every]

    def finished_tile(self, tile: Tile) -> dict[str, Any] | None:
        """The figures of a tile's record, if it is finished."""
        return _figures(self.tile_file(tile), self.digest(tile), self.folder)

    def all_tiles(self) -> bool:
        return all(self.finished_tile(tile) is not None for tile, _ in self.tiles())

    def render_tile(self, tile: Tile, progress: Progress | None) -> Outcome:
        file = self.tile_file(tile)
        check_output(file)
        job = self.prepare()
        rows = tile.rows(job.size[1])
        if not rows.any():
            most = -(-job.size[1] // BAND)
            raise UserError(f"{job.size[1]} rows make {most} tiles at most, not {tile.count}")
        spp, film = self.budget.spp or 1, job.compositor
        with self.stage("render tile", job, tile) as stage:
            while film.samples < spp:
                film.add(min(PASS, spp - film.samples), rows)
                if progress is not None:
                    progress(film.samples, None)
            stage.figures |= {"spp": film.samples, "seconds": stage.elapsed()}
            sums = film.film()[rows]
            about = {
                "tile": str(tile),
                "seed": self.scene.render.seed,
                "samples": film.samples,
                "width": job.size[0],
                "height": job.size[1],
            }
            with stage.output(file) as temporary:
                channels = [f"film.{k:02d}" for k in range(sums.shape[2])]
                write_exr(temporary, sums, channels=channels, attributes=about)
        return Outcome(self.task, "rendered", os.fspath(file), dict(stage.figures))

    def join(self) -> Outcome:
        job = self.prepare()
        width, height = job.size
        film = np.zeros_like(job.compositor.film())
        spp = self.budget.spp or 1
        expected = {
            "seed": self.scene.render.seed,
            "samples": spp,
            "width": width,
            "height": height,
        }
        for tile, file in self.tiles():
            image = read_image(file)
            for name, value in {"tile": str(tile), **expected}.items():
                if image.attributes.get(name) != value:
                    raise UserError(
                        f"this tile has {name} {image.attributes.get(name)}, the picture "
                        f"{value}: render it again, or join with the same options",
                        file=file,
                    )
            if self.finished_tile(tile) is None:
                raise UserError(
                    "scene or inputs have changed since this tile was made: render it again",
                    file=file,
                )
            rows = tile.rows(height)
            if image.pixels.shape != (int(rows.sum()), width, film.shape[2]):
                raise UserError("not the tile's rows: render it again", file=file)
            film[rows] = image.pixels
        with self.stage("render", job) as stage:
            job.compositor.restore(film, spp)
            composite = job.compositor.result()
            error = composite.relative_error() if spp > 1 else None
            write_composite(stage, job, composite, error, self.target)
            stage.figures["tiles"] = len(self.tiles())
            # what the samples took, not what joining them took
            stage.figures["seconds"] = sum(
                float(_record(file)["figures"]["seconds"]) for _, file in self.tiles()
            )
            stage.figures["mrays_per_second"] = None
        for _, file in self.tiles():
            file.unlink(missing_ok=True)
            record_path(file).unlink(missing_ok=True)
        return Outcome(self.task, "rendered", os.fspath(self.target), dict(stage.figures))


def _tile_count(task: Task) -> int:
    """How many tiles the picture was cut into, by the files that lie there."""
    target = _Picture.of(task).target
    found: dict[int, list[Path]] = {}
    for file in target.parent.glob("*.tile-*-of-*.exr"):
        name = re.fullmatch(r"(.*)\.tile-\d+-of-(\d+)\.exr", file.name)
        if name and name[1] == target.stem:
            found.setdefault(int(name[2]), []).append(file)
    if not found:
        raise UserError(
            "no tiles of this picture lie here: render them with --tile", file=target
        )
    if len(found) > 1:
        counts = " and ".join(f"of {count}" for count in sorted(found))
        raise UserError(f"tiles {counts} lie here: remove one kind", file=target)
    return next(iter(found))


# ---- records


def _record(output: Path) -> dict[str, Any]:
    return read_json(record_path(output))


def _figures(output: Path, digest: str, folder: Path) -> dict[str, Any] | None:
    """The figures of an output's record, if the same inputs would give the same output."""
    if not (output.is_file() and record_path(output).is_file()):
        return None
    record = _record(output)
    options = record.get("options", {})
    if options.get("digest") != digest:
        return None
    for name, value in options.get("sources", {}).items():
        file = folder / name
        if not file.is_file() or _hash(file) != value:
            return None
    return dict(record["figures"])


def _sources(inputs: Iterable[Path], folder: Path) -> dict[str, str]:
    """Content hashes of the input files, named from the scene's folder."""
    return {os.path.relpath(path, folder): _hash(path) for path in inputs if path.is_file()}


def _hash(path: Path) -> str:
    stat = path.stat()
    return _hash_of(path, stat.st_ino, stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(4096)
def _hash_of(path: Path, *_state: int) -> str:
    return content_hash(path)  # hashed once as long as the file's state is the same
