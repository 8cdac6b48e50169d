"""A rig's pictures: which of them belong to one instant, and where they show the board.

A camera is a folder of pictures or a video. Pictures belong together that have the same name,
else the same last number in their names; frames of videos that have the same number. A table
of times overrules both.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate import detect_cache
from chromeball.calibrate.detect import FEWEST
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.search import Frame, search
from chromeball.calibrate.target import Target
from chromeball.scene.errors import UserError

VIDEOS = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"}
NO_PICTURES = {".csv", ".json", ".txt", ".toml", ".yaml", ".yml", ".md", ".vnl", ".cameramodel"}
#: Column names of a table of times.
COLUMNS = {
    "camera": ("camera", "cam_id", "cam", "port"),
    "frame": ("frame", "frame_index", "file", "name"),
    "time": ("time", "frame_time", "timestamp", "seconds"),
    "instant": ("instant", "sync_index"),
}


@dataclass(frozen=True)
class Source:
    """One camera's pictures: ``files`` in order, or the frames of one ``video``."""

    name: str
    files: tuple[Path, ...]
    video: Path | None

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files that it reads."""
        return self.files if self.video is None else (self.video,)


@dataclass(frozen=True)
class Plan:
    """Which frame of which camera belongs to which instant.

    ``frames`` (C, F) index each camera's frames, -1 for none; ``stamps`` (C, F) seconds, or
    None where times are unknown; ``labels`` name the instants.
    """

    frames: NDArray[np.intp]
    stamps: NDArray[np.float64] | None
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Views:
    """What C cameras saw of the board at F instants: ``corners`` (C, F, rows, columns, 2)."""

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    corners: NDArray[np.float64]
    plan: Plan


def find_sources(folders: Sequence[Path]) -> list[Source]:
    """The cameras of a rig: a folder or video each, or one folder that holds them.

    Raises
    ------
    UserError
        When there are fewer than two, or two of one name.

    """
    places = list(folders)
    if len(places) == 1 and places[0].is_dir():
        inside = sorted(p for p in places[0].iterdir() if not p.name.startswith("."))
        videos = [p for p in inside if p.suffix.lower() in VIDEOS]
        places = [p for p in inside if p.is_dir() and _contents(p)] or videos
    sources = [_source(place) for place in places]
    if len(sources) < 2:
        raise UserError(
            "a rig has two cameras or more: name a folder or video for each, or one folder "
            "with a folder or video for each"
        )
    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"two cameras are called {name!r}: give their folders other names")
    return sources


def plan_pairs(sources: Sequence[Source], times: Path | None = None, every: int = 1) -> Plan:
    """Which pictures belong together; of the instants each `every`-th.

    Raises
    ------
    UserError
        When nothing belongs together, or the table of times does not fit.

    """
    if every < 1:
        raise UserError(f"--every {every}: take every first, second ... instant")
    if times is not None:
        plan = _by_times(sources, times)
    elif any(source.video for source in sources):
        plan = _by_frame_numbers(sources)
    else:
        plan = _by_names(sources)
    stamps = None if plan.stamps is None else plan.stamps[:, ::every]
    return Plan(plan.frames[:, ::every], stamps, plan.labels[::every])


def look(
    sources: Sequence[Source],
    plan: Plan,
    target: Target,
    *,
    workers: int = 1,
    cache: Path | None = None,
    progress: Callable[[str], object] | None = None,
) -> Views:
    """Find the board in all pictures of the `plan`, as :func:`chromeball.calibrate.search`.

    Raises
    ------
    UserError
        When a picture cannot be read, or one camera's pictures have several sizes.

    """
    where = [(c, int(v)) for c, own in enumerate(plan.frames) for v in _in_order(own)]
    pictures = (
        picture
        for source, own in zip(sources, plan.frames, strict=True)
        for picture in _pictures(source, own[_in_order(own)], target, cache)
    )
    corners = np.full((*plan.frames.shape, target.rows, target.columns, 2), np.nan)
    sizes = dict[int, tuple[int, int]]()
    verdicts: list[list[str]] = [[] for _ in sources]
    found = search(pictures, len(where), target, workers=workers, cache=cache)
    for (c, v), seen in zip(where, found, strict=True):
        name, size = sources[c].name, sizes.setdefault(c, seen.size)
        if seen.size != size:
            raise UserError(
                "this picture is {}x{}, others of camera {} are {}x{}: pictures of one "
                "camera have one size".format(*seen.size, name, *size),
                file=seen.file,
            )
        verdicts[c].append(seen.verdict)
        if seen.usable:
            corners[c, v] = seen.corners
        if progress is not None:
            progress(f"{name} {plan.labels[v]}: {seen.verdict}")
    for c, source in enumerate(sources):
        if c not in sizes:
            raise UserError(f"camera {source.name} has no picture of any instant")
        if not np.isfinite(corners[c]).any():
            common = max(set(verdicts[c]), key=verdicts[c].count)
            raise UserError(
                f"camera {source.name}: the board {target.spec} is usable in none of its "
                f"{len(verdicts[c])} pictures ({common}): check its counts (a chessboard's are "
                f"inner corners), focus and light; {FEWEST} corners are needed"
            )
    known = tuple(sizes[c] for c in range(len(sources)))
    return Views(tuple(s.name for s in sources), known, corners, plan)


def _in_order(frames: NDArray[np.intp]) -> NDArray[np.intp]:
    """The instants that have a frame, in the order of the frames: videos run forwards."""
    there = np.flatnonzero(frames >= 0)
    return there[np.argsort(frames[there], kind="stable")]


# ---- sources


def _contents(folder: Path) -> list[Path]:
    return sorted(
        p
        for p in folder.iterdir()
        if p.is_file() and not p.name.startswith(".") and p.suffix.lower() not in NO_PICTURES
    )


def _source(place: Path) -> Source:
    if place.is_file() and place.suffix.lower() in VIDEOS:
        return Source(place.stem, (), place)
    if not place.is_dir():
        raise UserError("neither a folder of pictures nor a video", file=place)
    files = _contents(place)
    videos = [p for p in files if p.suffix.lower() in VIDEOS]
    if len(videos) == 1 and len(files) == 1:
        return Source(place.resolve().name, (), videos[0])
    if videos:
        raise UserError("pictures and videos, or several videos, of one camera", file=place)
    if not files:
        raise UserError("no pictures in it", file=place)
    return Source(place.resolve().name, tuple(files), None)


def _capture(video: Path) -> Any:
    import cv2

    capture: Any = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise UserError("not a video that can be read", file=video)
    return capture


def _frame_count(source: Source) -> int:
    if source.video is None:
        return len(source.files)
    import cv2

    return int(_capture(source.video).get(cv2.CAP_PROP_FRAME_COUNT))


def _pictures(
    source: Source, wanted: NDArray[np.intp], target: Target, cache: Path | None
) -> Iterator[Path | Frame | Detection]:
    """The `wanted` frames, ascending; of videos as detections where these are known."""
    if source.video is None:
        yield from (source.files[frame] for frame in wanted)
        return
    import cv2

    known = dict[int, Detection]()
    if cache is not None:
        for frame in wanted:
            kept = detect_cache.entry(cache, source.video, target, int(frame))
            if (seen := detect_cache.load(kept, source.video)) is not None:
                known[int(frame)] = seen
    capture, at = _capture(source.video), -1
    for frame in map(int, wanted):
        if frame in known:
            yield known[frame]
            continue
        while at < frame:
            if not capture.grab():
                raise UserError(
                    f"the video ends at frame {at + 1}, before its time", file=source.video
                )
            at += 1
        _, picture = capture.retrieve()
        pixels = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
        yield Frame(source.video, frame, pixels)


# ---- pairs


def _by_names(sources: Sequence[Source]) -> Plan:
    """By equal names, else by the last number in each."""
    stems = [[p.stem for p in s.files] for s in sources]
    if not _shared(stems):
        numbers = [[_last_number(stem) for stem in own] for own in stems]
        for source, own in zip(sources, numbers, strict=True):
            doubles = [n for n in own if n and own.count(n) > 1]
            if doubles:
                raise UserError(f"camera {source.name} has two pictures number {doubles[0]}")
        stems = numbers
        if not _shared(stems):
            raise UserError(
                "no two cameras have pictures of one name or number: name them alike, such as "
                "left/01.png and right/01.png, or give --times"
            )
    labels = sorted({key for own in stems for key in own if key}, key=_natural)
    frames = np.full((len(sources), len(labels)), -1, np.intp)
    for c, own in enumerate(stems):
        for v, label in enumerate(labels):
            if label in own:
                frames[c, v] = own.index(label)
    return Plan(frames, None, tuple(labels))


def _shared(keys: Sequence[Sequence[str]]) -> bool:
    """Whether some key stands in two lists."""
    every = [key for own in keys for key in set(own) if key]
    return len(every) > len(set(every))


def _last_number(stem: str) -> str:
    found = re.findall(r"\d+", stem)
    return str(int(found[-1])) if found else ""


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Order in which 2 comes before 10."""
    parts = re.findall(r"\d+|\D+", text)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]


def _by_frame_numbers(sources: Sequence[Source]) -> Plan:
    """Videos, frame by frame; their times by their frame rates."""
    import cv2

    if any(source.video is None for source in sources):
        raise UserError("some cameras are videos, others pictures: give --times")
    counts = [_frame_count(source) for source in sources]
    rates = [float(_capture(s.video).get(cv2.CAP_PROP_FPS)) for s in sources if s.video]
    index = np.arange(max(counts))
    frames = np.array([np.where(index < n, index, -1) for n in counts])
    known = all(math.isfinite(rate) and rate > 0 for rate in rates)
    stamps = np.array([index / rate for rate in rates]) if known else None
    return Plan(frames, stamps, tuple(str(i) for i in index))


def _by_times(sources: Sequence[Source], table: Path) -> Plan:
    """By a table's instants, or else by its times."""
    rows = _read_times(table)
    told = [_rows_of(source, rows, table) for source in sources]
    if all(row.instant for own in told for row in own):
        labels = sorted({row.instant for own in told for row in own}, key=_natural)
        place = {label: v for v, label in enumerate(labels)}
        where = [[place[row.instant] for row in own] for own in told]
    else:
        reference = np.sort([row.time for row in max(told, key=len)])
        labels = [f"{t:.3f}" for t in reference]
        half = 0.5 * float(np.median(np.diff(reference))) if len(reference) > 1 else math.inf
        where = []
        for own in told:
            off = np.abs(np.array([[row.time] for row in own]) - reference)
            near = off.argmin(axis=1)
            where.append([int(v) if off[i, v] <= half else -1 for i, v in enumerate(near)])
    frames = np.full((len(sources), len(labels)), -1, np.intp)
    stamps = np.full(frames.shape, np.nan)
    for c, (own, places) in enumerate(zip(told, where, strict=True)):
        for row, v in zip(own, places, strict=True):
            if v >= 0:
                frames[c, v], stamps[c, v] = row.index, row.time
    return Plan(frames, stamps, tuple(labels))


@dataclass(frozen=True)
class _Row:
    camera: str
    frame: str
    time: float
    instant: str
    index: int = -1


def _read_times(table: Path) -> list[_Row]:
    try:
        with table.open(newline="") as file:
            reader = csv.DictReader(file)
            fields = {f.strip().lower(): f for f in reader.fieldnames or []}
            columns = {
                role: next((fields[n] for n in names if n in fields), None)
                for role, names in COLUMNS.items()
            }
            for role in ("camera", "frame", "time"):
                if columns[role] is None:
                    raise UserError(
                        f"no column {' or '.join(COLUMNS[role][:2])}: a table of times has "
                        "camera, frame, time and maybe instant",
                        file=table,
                    )
            rows: list[_Row] = []
            for line, row in enumerate(reader, 2):
                camera, frame, time, instant = (
                    (row[name] or "").strip() if name else "" for name in columns.values()
                )
                try:
                    seconds = float(time)
                except ValueError as error:
                    raise UserError(f"line {line}: {time!r} is no time", file=table) from error
                if not math.isfinite(seconds):
                    raise UserError(f"line {line}: {time!r} is no time", file=table)
                rows.append(_Row(camera, frame, seconds, instant))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"not a readable table: {error}", file=table) from error
    return rows


def _rows_of(source: Source, rows: Sequence[_Row], table: Path) -> list[_Row]:
    """A camera's rows with the index of each one's picture or frame."""
    own = [row for row in rows if row.camera == source.name]
    number = _last_number(source.name)
    if not own and number:
        own = [row for row in rows if row.camera.isdecimal() and str(int(row.camera)) == number]
    if not own:
        raise UserError(f"no times of camera {source.name}", file=table)
    count = _frame_count(source)
    if source.video is None:
        names = {p.name: i for i, p in enumerate(source.files)}
        names |= {p.stem: i for i, p in enumerate(source.files)}
        numbers = {_last_number(p.stem): i for i, p in enumerate(source.files)}
        index = [names.get(r.frame, numbers.get(_last_number(r.frame), -1)) for r in own]
    elif not all(row.frame.isdecimal() for row in own):
        raise UserError(f"frames of the video {source.name} are numbers", file=table)
    elif len(own) == count:  # recorders count on before and after what they keep
        order = sorted(range(count), key=lambda i: int(own[i].frame))
        index = [order.index(i) for i in range(count)]
    else:
        index = [int(row.frame) if int(row.frame) < count else -1 for row in own]
    return [
        _Row(row.camera, row.frame, row.time, row.instant, i)
        for row, i in zip(own, index, strict=True)
        if i >= 0
    ]
