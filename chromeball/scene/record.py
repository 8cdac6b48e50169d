"""Outputs that appear whole or not at all, and the record beside each of them.

``atomic_output`` gives a temporary path in the folder of the final one; on success the file
is synced and renamed, on failure it is removed. ``Stage`` wraps one run of a stage: it
collects inputs with their hashes, figures of quality, and writes ``NAME.record.json`` beside
every output once all of them are whole.
"""

from __future__ import annotations

import fcntl
import glob
import hashlib
import json
import math
import os
import resource
import sys
import tempfile
import time
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec
import numpy as np

from chromeball.scene.errors import UserError

type Json = bool | int | float | str | list[Json] | dict[str, Json] | None


@contextmanager
def atomic_output(path: str | os.PathLike[str]) -> Generator[Path]:
    """Yield a temporary path with the suffix of `path`; rename it to `path` on success.

    The temporary file is hidden, ``.env.x1y2z3w4.exr``, and locked while its writer lives: what
    a killed run left behind is removed by the next one that writes the same output.

    Raises
    ------
    UserError
        If the folder cannot be made or written.

    """
    final = Path(path)
    check_output(final)
    try:
        _remove_leftovers(final)
        handle, name = tempfile.mkstemp(
            prefix=f".{final.stem}.", suffix=final.suffix, dir=final.parent
        )
    except OSError as error:
        raise UserError(f"cannot write here: {error.strerror}", file=final) from error
    temporary = Path(name)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(final)
    finally:
        temporary.unlink(missing_ok=True)
        os.close(handle)


def check_output(
    path: str | os.PathLike[str],
    inputs: Iterable[str | os.PathLike[str]] = (),
    suffix: str | None = None,
) -> None:
    """Refuse an output that cannot be written, before the work for it is done.

    Raises
    ------
    UserError
        If `path` is a folder or one of the `inputs`, does not end in `suffix`, or its own
        folder cannot be made or written.

    """
    final = Path(path)
    if suffix is not None and final.suffix.lower() != suffix:
        raise UserError(f"this is written as {suffix}: name it so", file=final)
    _refuse_input(final, inputs)
    if final.is_dir():
        raise UserError("is a folder; name a file", file=final)
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write here: {error.strerror}", file=final) from error
    if not os.access(final.parent, os.W_OK):
        raise UserError("cannot write here: permission denied", file=final)


def _refuse_input(output: Path, inputs: Iterable[str | os.PathLike[str]]) -> None:
    there = [path for path in inputs if Path(path).exists()]
    if output.exists() and any(os.path.samefile(output, path) for path in there):
        raise UserError("is an input, too; name another output", file=output)


def _remove_leftovers(final: Path) -> None:
    """Remove temporary files of `final` that no living process holds."""
    pattern = f".{glob.escape(final.stem)}.????????{glob.escape(final.suffix)}"
    for path in final.parent.glob(pattern):
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
        except OSError:  # another run is writing it, or has just renamed it
            continue


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a whole file or nothing."""
    with atomic_output(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a whole UTF-8 file or nothing."""
    write_bytes(path, text.encode())


def write_json(path: str | os.PathLike[str], value: object) -> None:
    """Write `value`, numpy arrays included, as JSON, whole or not at all."""
    write_text(path, json.dumps(to_json(value), indent=1, allow_nan=False) + "\n")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file; a missing or broken one is a :class:`UserError`."""
    try:
        return json.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise UserError(f"not a readable JSON file: {error}", file=path) from error


def decode[T](data: bytes, kind: type[T], path: str | os.PathLike[str]) -> T:
    """The JSON `data` of the file `path` as a msgspec struct.

    Raises
    ------
    UserError
        Not JSON, an unknown or missing key, a value of another kind or out of bounds.

    """
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        raise UserError(str(error).replace("`$.", "`"), file=path) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UserError(f"not valid JSON: {error}", file=path) from error


def to_json(value: object) -> Json:
    """Convert numpy values, paths and mappings to plain JSON; NaN and infinity become null."""
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return float(value) if math.isfinite(value) else None  # numpy's are floats, too
        case np.ndarray() | np.generic():
            return to_json(value.tolist())
        case os.PathLike():
            return os.fspath(value)
        case Mapping():
            return {str(key): to_json(item) for key, item in value.items()}
        case Iterable():
            return [to_json(item) for item in value]
        case _:
            raise TypeError(f"no JSON form for {type(value).__name__}")


def content_hash(path: str | os.PathLike[str]) -> str:
    """BLAKE2b-128 of a file's content, in hex."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def record_path(output: str | os.PathLike[str]) -> Path:
    """``env.exr`` -> ``env.exr.record.json``."""
    output = Path(output)
    return output.with_name(output.name + ".record.json")


class Stage:
    """One run of a stage, a context manager around the work.

    >>> with Stage("hdr merge", inputs=frames) as stage:            # doctest: +SKIP
    ...     stage.figures["clipped_pixels"] = 12
    ...     with stage.output("radiance.exr") as temporary:
    ...         write(temporary)

    On a clean exit a record is written beside every output: command, inputs with content
    hashes, versions, seconds, peak memory, figures. `figures` holds whatever the report shows:
    numbers, lists, short strings, paths of plots as strings relative to the output's folder.
    """

    def __init__(
        self, name: str, inputs: Iterable[str | os.PathLike[str]] = (), **options: object
    ) -> None:
        self.name = name
        self.inputs = [Path(path) for path in inputs]
        self.options = options
        self.figures: dict[str, object] = {}
        self.outputs: list[Path] = []

    def __enter__(self) -> Stage:
        self._start = time.perf_counter()
        self._cpu = time.process_time()
        return self

    def elapsed(self) -> float:
        """Seconds since the stage began."""
        return time.perf_counter() - self._start

    @contextmanager
    def output(self, path: str | os.PathLike[str]) -> Generator[Path]:
        """As :func:`atomic_output`; the output gets a record when the stage ends well.

        No stage overwrites what it was made from.
        """
        _refuse_input(Path(path), self.inputs)
        with atomic_output(path) as temporary:
            yield temporary
            # A run killed before its record is written must not leave an older run's figures.
            record_path(path).unlink(missing_ok=True)
        self.outputs.append(Path(path))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            return
        record = {
            "stage": self.name,
            "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
            "inputs": {os.fspath(p): content_hash(p) for p in self.inputs if p.is_file()},
            "options": self.options,
            "outputs": [os.fspath(path) for path in self.outputs],
            "figures": self.figures,
            "seconds": self.elapsed(),
            "cpu_seconds": time.process_time() - self._cpu,
            "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": {name: version(name) for name in ("chromeball", "numpy")},
        }
        for path in self.outputs:
            write_json(record_path(path), record)
