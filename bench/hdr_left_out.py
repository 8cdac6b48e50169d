"""One exposure of a real bracket left out, and predicted from all others.

No truth is known of a real scene, but a picture that a solver has not seen is one. For each
inner exposure k: the response from all others, all others merged by it, and from that the codes
of frame k at its exposure. Errors are in 8-bit codes, unrounded, over the pixels that every
tool's merge measures (no channel saturated or black in all frames), so that all are judged on
the same ones. The merge is ours for every tool, with the noise that the bracket shows: what
differs is the curve, and the exposures where a tool refines them.

Refined exposures, that of k too, are those solved from all frames; the curve has not seen
frame k. "Times as given" is the same solver without. Peers' curves are made to rise first:
others cannot be inverted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.bench import hdr as room
from chromeball.bench import hdr_solvers as solvers
from chromeball.bench.row import Row
from chromeball.hdr.bracket import read_bracket
from chromeball.hdr.merge import Radiance, code_weights, merge_frames
from chromeball.hdr.noise import lattice, measure_codes
from chromeball.hdr.response import Method, sample, solve
from chromeball.hdr.response_file import Response
from chromeball.scene.image import read_image

type Float = NDArray[np.float64]

#: real brackets: the files, and the step at which their pixels are taken
STACKS = {
    "memorial": ("memorial/memorial*.png", 1),
    "room": ("hdrtoolbox/stack/*.jpg", 1),
    "fisheye, 1/4": ("fisheye_lumilab/JPEG/*.JPG", 4),
    "moving people": ("hdrtoolbox/stack_ghost/*.JPG", 1),
    "hand-held, not aligned": ("hdrtoolbox/stack_alignment/*.jpg", 1),
}
#: about so many pixels of a frame are predicted
JUDGED = 100_000


@dataclass(frozen=True)
class Stack:
    """A bracket by rising exposure; ``marked`` (H, W): pixels its makers say are no picture."""

    frames: room.Frames
    exposures: Float
    marked: NDArray[np.bool_]


@dataclass(frozen=True)
class Tool:
    """How a curve is solved from frames, and the exposures (P,) used from all frames."""

    solve: Callable[[room.Frames, Float], Response]
    exposures: Callable[[room.Frames, Float], Float]


def rows(quick: bool = False) -> list[Row]:
    """Median and 95 % of the errors on each stack whose files are there, by each tool."""
    names = ["room"] if quick else list(STACKS)
    return [row for name in names for row in stack_rows(name)]


def stack_rows(name: str) -> list[Row]:
    """The rows of one stack, all of its inner exposures together."""
    stack = read_stack(name)
    if not stack.frames:
        return []
    exposures = {
        tool: way.exposures(stack.frames, stack.exposures) for tool, way in TOOLS.items()
    }
    seconds: dict[str, list[float]] = {tool: [] for tool in TOOLS}
    errors: dict[str, list[Float]] = {tool: [] for tool in TOOLS}
    some = lattice(stack.marked.shape, JUDGED)
    for k in range(1, len(stack.frames) - 1):
        others = [j for j in range(len(stack.frames)) if j != k]
        frames = [stack.frames[j] for j in others]
        shown = [frame[some] for frame in frames]
        predicted: dict[str, Float] = {}
        measured = ~stack.marked[some]
        for tool, way in TOOLS.items():
            start = time.process_time()
            response = way.solve(frames, stack.exposures[others])
            seconds[tool].append(time.process_time() - start)
            merged = merge(shown, exposures[tool][others], response)
            predicted[tool] = predict(merged, exposures[tool][k], response)
            measured &= merged.clipped == 0
        for tool, codes in predicted.items():
            errors[tool].append(np.abs(codes - stack.frames[k][some])[measured].ravel())
    found: list[Row] = []
    for tool in TOOLS:
        together = np.concatenate(errors[tool])
        half, most = np.quantile(together, [0.5, 0.95])
        by_frame = " ".join(f"{np.median(error):.1f}" for error in errors[tool])
        found.append(
            Row(
                "hdr",
                f"left out, {name}",
                tool,
                float(np.median(seconds[tool])),
                float(half),
                "codes, median",
                f"95 % {most:.2f}; mean {together.mean():.2f}; by frame {by_frame}",
            )
        )
    return found


def read_stack(name: str) -> Stack:
    """A real bracket; empty where its files are absent."""
    pattern, step = STACKS[name]
    paths = sorted(room.DATA.glob(pattern))
    if not paths:
        return Stack([], np.zeros(0), np.zeros((0, 0), np.bool_))
    times = None
    if name == "memorial":
        lines = (room.DATA / "memorial/image_list.txt").read_text().splitlines()
        words = [line.split() for line in lines if line.startswith("memorial")]
        seconds = {row[0]: float(row[1]) for row in words}
        times = [seconds[path.name] for path in paths]
    exposures = read_bracket(paths, times).exposures
    order = np.argsort(exposures)
    frames = [
        np.ascontiguousarray(read_image(paths[j]).pixels[::step, ::step, :3]) for j in order
    ]
    marked = np.zeros(frames[0].shape[:2], np.bool_)
    if name == "memorial":  # pure blue: what registration shifted in from outside
        marked = np.any([(frame == [0, 0, 255]).all(axis=2) for frame in frames], axis=0)
    return Stack(frames, exposures[order], marked)


def merge(frames: room.Frames, exposures: Float, response: Response) -> Radiance:
    """Our merge, its noise measured from the bracket as the command does."""
    rows, columns = lattice((frames[0].shape[0], frames[0].shape[1]))
    values = [frame[rows, columns].reshape(-1, 3) for frame in frames]
    tables = code_weights(response, measure_codes(values, exposures, response))
    return merge_frames(frames, exposures, response, tables=tables)


def predict(merged: Radiance, exposure: float, response: Response) -> Float:
    """The codes (H, W, C), not rounded, that a frame of `exposure` shows."""
    level = np.log(np.maximum(merged.radiance.astype(np.float64), 1e-30) * exposure)
    codes = [
        np.interp(level[..., c], g, np.arange(len(g)))
        for c, g in enumerate(response.log_exposure)
    ]
    return np.stack(codes, axis=-1)


def _given(frames: room.Frames, exposures: Float) -> Float:
    return exposures


def _refined(frames: room.Frames, exposures: Float) -> Float:
    return np.exp(solve([sample(frame) for frame in frames], exposures).log_exposures)


def _ours(
    method: Method = "comparagram", refine_times: bool | None = None
) -> Callable[[room.Frames, Float], Response]:
    def solved(frames: room.Frames, exposures: Float) -> Response:
        found = solve(
            [sample(frame) for frame in frames],
            exposures,
            method=method,
            refine_times=refine_times,
        )
        return solvers.as_response(found)

    return solved


def _peer(solver: solvers.Solver) -> Callable[[room.Frames, Float], Response]:
    def solved(frames: room.Frames, exposures: Float) -> Response:
        return Response.from_log_exposure(solvers.rising(solver(frames, exposures, None)))

    return solved


TOOLS = {
    "chromeball": Tool(_ours(), _refined),
    "chromeball, times as given": Tool(_ours(refine_times=False), _given),
    "chromeball, debevec": Tool(_ours("debevec"), _given),
    "OpenCV Debevec, 500 samples": Tool(_peer(solvers.opencv_debevec_500), _given),
    "the paper (colour-hdri, 300 samples)": Tool(_peer(solvers.paper), _given),
}
