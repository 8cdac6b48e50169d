"""Response: CPU seconds against error, ours beside the peers, interleaved.

Errors are RMS of ln exposure over the codes 5 .. 250 of three channels, zero at code 128. The
protocol: 20 DoRF curves x 5 radiance maps x 3 brackets, 0.3 megapixels. Slow tools take every
fifth of these runs: each curve and bracket once, the maps in turn.

A prior must not be judged on curves that it has seen. DoRF has families of near copies (films
of one make, settings of one camera), so each curve is judged by the prior of all *other*
families. The prior that is shipped has seen every curve of the database and has a row of its
own.

What is left is a matter of the bracket and of the curve: exact EV steps do not damp a part of
period one step in g (Grossberg and Nayar 2004), the wider the step the less, and only the prior
tells it from the curve. So a curve that no other family resembles is worst in steps of 2 EV;
rows name it, and say how far its next relative is.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from chromeball.bench import hdr as room
from chromeball.bench import hdr_solvers as solvers
from chromeball.bench.hdr_solvers import Solver
from chromeball.bench.row import Row
from chromeball.scene.errors import UserError

OURS, SEEN = "chromeball", "chromeball, prior that has seen the curve"
FAST: dict[str, Solver] = {
    OURS: solvers.comparagram,
    "OpenCV Debevec, 70 samples": solvers.opencv_debevec,
}
SLOW: dict[str, Solver] = {
    SEEN: solvers.comparagram_shipped,
    "chromeball, debevec": solvers.debevec,
    "OpenCV Debevec, 500 samples": solvers.opencv_debevec_500,
    "OpenCV Robertson": solvers.opencv_robertson,
    "the paper (colour-hdri, 300 samples)": solvers.paper,
}
#: slow tools take one run of so many
SHARE = len(room.MAPS)


@dataclass(frozen=True)
class Case:
    """A bracket to solve: curve `number`, under a map, in one run of `SHARE` for `everyone`."""

    number: int
    map: str
    bracket: str
    frames: room.Frames
    everyone: bool


@dataclass(frozen=True)
class Run:
    """What one solver made of a case, NaN where it refused.

    `missing` and `falling` count codes of 3 x 256.
    """

    number: int
    map: str
    bracket: str
    everyone: bool
    seconds: float
    error: float
    missing: int
    falling: int


type Runs = dict[str, list[Run]]


def rows(quick: bool = False) -> list[Row]:
    """Accuracy by the protocol, then CPU seconds at one megapixel."""
    compile_ours()
    return [*accuracy_rows(quick), *speed_rows(quick)]


def compile_ours() -> None:
    """Solve once by each of our methods, so that no run pays for compiling."""
    frames = room.photograph(room.radiance(room.MAPS[0], 0.05), room.curve(0)[0])
    for solver in (solvers.comparagram, solvers.debevec):
        solver(frames, room.TIMES, None)


def accuracy_rows(quick: bool) -> list[Row]:
    """Median and worst error by the protocol: altogether, and by bracket."""
    runs = judge(cases(quick), FAST | SLOW)
    found = [_row("response", tool, runs) for tool in runs]
    for bracket in room.BRACKETS:
        own = {tool: [r for r in mine if r.bracket == bracket] for tool, mine in runs.items()}
        found += [_row(f"response, {bracket}", tool, own) for tool in FAST]
    return found


def speed_rows(quick: bool) -> list[Row]:
    """CPU seconds for 7 pictures of 1 megapixel, and the error of the same runs."""
    megapixels = 0.25 if quick else 1.0
    numbers = np.linspace(0, 110, 3 if quick else 10).astype(int)

    def photographs() -> Iterator[Case]:
        for k, number in enumerate(numbers):
            name = room.MAPS[k % len(room.MAPS)]
            transfer, _ = room.curve(int(number))
            frames = room.photograph(room.radiance(name, megapixels), transfer)
            yield Case(int(number), name, "7 x 1 EV", frames, everyone=True)

    runs = judge(photographs(), FAST | SLOW)
    return [_row(f"response, 7 x {megapixels:g} MP", tool, runs) for tool in runs]


def cases(quick: bool) -> Iterator[Case]:
    """The protocol's brackets; the sensor's noise is drawn once a map and bracket."""
    numbers = np.linspace(0, 110, 4 if quick else 20).astype(int)
    for k, name in enumerate(room.MAPS[:2] if quick else room.MAPS):
        radiance = room.radiance(name, 0.1 if quick else 0.3)
        for b, (bracket, times) in enumerate(room.BRACKETS.items()):
            sensor = room.expose(radiance, times)
            for i, number in enumerate(map(int, numbers)):
                transfer, _ = room.curve(number)
                frames = room.develop(sensor, transfer)
                yield Case(number, name, bracket, frames, (i + k + b) % SHARE == 0)


def judge(cases: Iterable[Case], tools: dict[str, Solver]) -> Runs:
    """Every case by every tool in turn; the slow ones take those for everyone."""
    runs: Runs = {tool: [] for tool in tools}
    for case in cases:
        prior = solvers.unseen(case.number)
        _, truth = room.curve(case.number)
        for tool, solver in tools.items():
            if tool in SLOW and not case.everyone:
                continue
            start = time.process_time()
            try:
                g = solver(case.frames, room.BRACKETS[case.bracket], prior)
            except UserError:
                g = np.full((3, 256), np.nan)
            seconds = time.process_time() - start
            squares = (g - truth)[:, 5:251] ** 2
            runs[tool].append(
                Run(
                    case.number,
                    case.map,
                    case.bracket,
                    case.everyone,
                    seconds,
                    float(np.sqrt(np.nanmean(squares))) if np.isfinite(g).any() else np.nan,
                    int(np.isnan(g).sum()),
                    int((np.diff(g) <= 0).sum()),
                )
            )
    return runs


def _row(what: str, tool: str, runs: Runs) -> Row:
    def errors(some: Iterable[Run]) -> list[float]:
        return [run.error for run in some if np.isfinite(run.error)]

    mine, ours = runs[tool], runs[OURS]
    worst = max(mine, key=lambda run: np.nan_to_num(run.error))
    notes = [
        f"worst {worst.error:.4f}: curve {worst.number}, {worst.map}, {worst.bracket}, next "
        f"relative {solvers.strangeness(worst.number):.2f} away"
    ]
    if len(mine) < len(ours):
        same = errors(run for run in ours if run.everyone)
        notes.append(
            f"{len(mine)} of {len(ours)} runs; {OURS} on these: median {np.median(same):.4f}, "
            f"worst {max(same):.4f}"
        )
    refused = sum(run.missing == 3 * 256 for run in mine)
    if refused:
        notes.append(f"refuses {refused} of {len(mine)} runs")
    if missing := sum(run.missing > 0 for run in mine) - refused:
        notes.append(f"codes missing in {missing} of {len(mine)} runs")
    if falling := sum(run.falling > 0 for run in mine):
        notes.append(f"curve falls in {falling}")
    return Row(
        "hdr",
        what,
        tool,
        float(np.median([run.seconds for run in mine])),
        float(np.median(errors(mine))),
        "ln RMS, median",
        "; ".join(notes),
    )
