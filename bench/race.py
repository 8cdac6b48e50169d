"""Time against error: tools by turns on one task, against pictures that have converged."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.bench.row import Row
from chromeball.scene.color import srgb_encode

type Picture = NDArray[np.float32]

#: What is expensive is kept between runs, until scene or code change.
CACHE = Path(__file__).resolve().parents[1] / "build/bench"


@dataclass(frozen=True)
class Truth:
    """A converged picture in 8-bit sRGB codes, not rounded, and the RMS of its own noise."""

    codes: NDArray[Any]
    noise: float

    def error(self, picture: Picture) -> float:
        """RMS difference in codes."""
        return rms(codes(picture) - self.codes)


@dataclass(frozen=True)
class Runner:
    """What runs yields tool, note and picture, one or more after each other."""

    run: Callable[[], Iterator[tuple[str, str, Picture]]]
    truth: Truth


def race(what: str, runners: list[Runner], quick: bool) -> list[Row]:
    """The least CPU time of each in several turns (A, B, A, B), and its error.

    One that has had `enough` CPU seconds gets no further turn.
    """
    turns, enough = (2, 1.0) if quick else (5, 3.0)
    found: dict[tuple[int, int], Row] = {}
    spent = [0.0] * len(runners)
    for _ in range(turns):
        for k, runner in enumerate(runners):
            if spent[k] > enough:
                continue
            start = time.process_time()
            for i, (tool, note, picture) in enumerate(runner.run()):
                now = time.process_time()
                before = found.get((k, i))
                error = runner.truth.error(picture) if before is None else before.error
                least = min(now - start, math.inf if before is None else before.cpu_seconds)
                note = f"{note}; the truth's own noise {runner.truth.noise:.2f}"
                found[k, i] = Row("renderer", what, tool, least, error, "8-bit codes", note)
                spent[k] += now - start
                start += time.process_time() - now
    return [found[key] for key in sorted(found)]


def converged(name: str, key: list[Any], half: Callable[[int], Picture]) -> Truth:
    """The mean of two pictures, `half` of the seeds 1 and 2; kept between runs for `key`."""
    digest = hashlib.sha256()
    for part in [Path(__file__).read_bytes(), *key]:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    file = CACHE / f"{name}-{digest.hexdigest()[:16]}.npy"
    if not file.is_file():
        CACHE.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(".part.npy")
        np.save(partial, np.stack([half(seed) for seed in (1, 2)]))
        partial.replace(file)
    first, second = np.load(file)
    return Truth(codes((first + second) / 2), rms(codes(first) - codes(second)) / 2)


def codes(rgb: Picture) -> NDArray[Any]:
    """8-bit sRGB codes, not rounded."""
    return 255 * srgb_encode(np.clip(rgb, 0, 1))


def rms(x: NDArray[Any]) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(np.square(x, dtype=float))))
