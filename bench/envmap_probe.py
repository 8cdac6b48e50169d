"""A real fisheye probe of an office, and what the reference tool made of the same pictures.

The tool's picture (LumiLab: hdrgen, pcomb) is no truth. What it differs in is put into ours
cause by cause, in its own order from the last to the first, until the two agree; each row has
what is left then. One common scale; the circle but for its outermost 4 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench import hdrgen
from bench.row import Row
from chromeball.envmap.mapping import Mapping, of_camera
from chromeball.envmap.probe import vignetting_gain
from chromeball.envmap.resample import warp
from chromeball.hdr.bracket import read_bracket
from chromeball.hdr.merge import code_weights, merge_frames
from chromeball.hdr.noise import lattice, measure_codes
from chromeball.hdr.response import from_solution, sample, solve
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import luminance
from chromeball.scene.image import read_image

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/hdr/fisheye_lumilab"
PLOT = Path(__file__).resolve().parents[1] / "build/bench/office_probe.png"
WIDTH = 1000  # of the tool's picture
VIEW = 186.0  # degrees that the circle spans, as its makers say
#: c1, c2 of 1 + c1 r^2 + c2 r^4 in their vignetting_f5d6.cal
FALLOFF = (0.1755458928191, -0.528613562104476)
INNER = 0.96  # the rim of a circle is soft
#: the bar: what may be left of the difference
BAR = 0.05


@dataclass(frozen=True)
class Circle:
    """The square around the fisheye's circle in the photographs: edges and side, pixels."""

    left: float
    top: float
    diameter: float

    def mapping(self, size: tuple[int, int], step: int, fov: float) -> Mapping:
        """An equisolid fisheye of `fov` degrees in it, pictures `step` times smaller."""
        radius = self.diameter / 2
        x, y = ((edge + radius) / step - 0.5 for edge in (self.left, self.top))
        return of_camera(
            CameraModel.fisheye(
                "equisolid", size, math.radians(fov), centre=(x, y), radius=radius / step
            )
        )


#: ImageLensInformation.txt: 3612 px, 1019 from the left, 74 from the bottom of 3744
STATED = Circle(1019.0, 3744.0 - 74 - 3612, 3612.0)
#: what the tool's picture shows; :func:`registered` finds it again
FOUND = Circle(1007.4, 16.5, 3663.1)


@dataclass(frozen=True)
class Bracket:
    """The photographs, `step` times smaller, and their exposures as EXIF says."""

    frames: list[NDArray[np.uint8]]
    exposures: Array
    step: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.frames[0].shape[1], self.frames[0].shape[0]


@dataclass(frozen=True)
class Step:
    """A cause put in: the luminance (n, n) that results, and the CPU seconds it took."""

    name: str
    picture: Array
    seconds: float


@dataclass(frozen=True)
class Difference:
    """|ln ratio| of two pictures, one scale taken out.

    ``median`` and ``most`` (90 %) of all pixels; ``classes`` the same of the darkest quarter,
    the middle half, the brightest quarter; ``log`` (n, n) has its sign, NaN outside.
    """

    median: float
    most: float
    classes: tuple[tuple[float, float], ...]
    log: Array


def _luminance(rgb: NDArray[np.floating]) -> Array:
    return np.asarray(luminance(rgb), np.float64)


def rows(quick: bool) -> list[Row]:
    """What is left of the difference after each cause; its map in build/bench."""
    if not DATA.is_dir():
        return []
    step = 4 if quick else 1
    bracket, tool = read(step), reference()
    ours = merged(bracket)
    circle, crop_note = (FOUND, "") if quick else registered(ours, tool)
    block = step  # smaller photographs are softer: so are both pictures then
    found: list[Row] = []
    before: Step | None = None
    steps = causes(bracket, ours, circle)
    for one in steps:
        left = compare(tool, one.picture, block)
        notes = [f"median {_percent(left.median)}"]
        notes += [
            f"{name} {_percent(m)} / {_percent(p)}"
            for name, (m, p) in zip(("dark", "middle", "bright"), left.classes, strict=True)
        ]
        if before is not None:
            share = compare(one.picture, before.picture, block)
            notes.append(f"its share {_percent(share.median)} / {_percent(share.most)}")
        if "crop" in one.name:
            notes.append(crop_note)
        note = "; ".join(part for part in notes if part)
        found.append(_row(f"office probe: {one.name}", one.seconds, left.most, note))
        before = one
    last = steps[-1].picture
    rounding = compare(last, _luminance(hdrgen.quantised(np.repeat(last[..., None], 3, 2))), 1)
    note = f"median {_percent(rounding.median)}; of a grey picture"
    found.append(_row("office probe: RGBE alone", 0.0, rounding.most, note))
    found.append(_directions(circle))
    draw(tool, steps, block)
    return found


def _row(what: str, seconds: float, error: float, note: str) -> Row:
    return Row("envmap", what, "chromeball", seconds, 100 * error, "%, 90 % of pixels", note)


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %"


def read(step: int = 1) -> Bracket:
    """The 18 photographs, longest first."""
    import cv2

    paths = sorted((DATA / "JPEG").glob("*.JPG"))
    kinds = {
        1: cv2.IMREAD_COLOR,
        2: cv2.IMREAD_REDUCED_COLOR_2,
        4: cv2.IMREAD_REDUCED_COLOR_4,
    }
    frames = [
        np.ascontiguousarray(np.asarray(cv2.imread(str(path), kinds[step]))[..., ::-1])
        for path in paths
    ]
    return Bracket(frames, read_bracket(paths).exposures, step)


def reference() -> Array:
    """The tool's luminance, (1000, 1000), relative."""
    pixels = read_image(DATA / f"lumilab_pipeline-output-{WIDTH}x{WIDTH}.hdr").pixels
    return _luminance(pixels[..., :3])


def merged(bracket: Bracket) -> Picture:
    """Radiance as `hdr response` and `hdr merge` make it, curve and times from the pictures."""
    found = solve([sample(frame) for frame in bracket.frames], bracket.exposures)
    names = [Path(str(j)) for j in range(len(bracket.frames))]
    response = from_solution(found, ("R", "G", "B"), names, bracket.exposures, {})
    exposures = np.exp(found.log_exposures)
    width, height = bracket.size
    shown = [frame[lattice((height, width))].reshape(-1, 3) for frame in bracket.frames]
    tables = code_weights(response, measure_codes(shown, exposures, response))
    return merge_frames(bracket.frames, exposures, response, tables=tables).radiance


def polynomials() -> list[Array]:
    """The tool's response, the highest power first."""
    text = (DATA / "response_function_files/Response_function.rsp").read_text()
    return [np.array([float(v) for v in line.split()[1:]]) for line in text.splitlines()[:3]]


def warped(
    radiance: Picture, circle: Circle, step: int, fov: float, vignetting: Sequence[float]
) -> Array:
    """Luminance as `envmap warp --from fisheye --to fisheye` makes it: equidistant."""
    source = circle.mapping((radiance.shape[1], radiance.shape[0]), step, fov)
    target = of_camera(CameraModel.fisheye("equidistant", (WIDTH, WIDTH), math.radians(fov)))
    gain = vignetting_gain(source, vignetting).astype(np.float32)
    return _luminance(warp(radiance * gain[..., None], source, target).radiance)


def causes(bracket: Bracket, ours: Picture, circle: Circle) -> list[Step]:
    """Ours, and what the tool does otherwise put into it one after the other."""
    result: list[Step] = []
    start = time.process_time()

    def add(name: str, picture: Array) -> None:
        nonlocal start
        result.append(Step(name, picture, time.process_time() - start))
        start = time.process_time()

    step = bracket.step
    add("ours", warped(ours, STATED, step, VIEW, FALLOFF))
    add("+ the crop that it used", warped(ours, circle, step, VIEW, FALLOFF))
    add("+ 180 degrees for 186", warped(ours, circle, step, 180.0, FALLOFF))

    def bent(radiance: Picture) -> Array:
        square = circle.left / step, circle.top / step, circle.diameter / step
        return _luminance(hdrgen.bend(hdrgen.crop(radiance, *square, WIDTH)))

    source = circle.mapping(bracket.size, step, 180.0)
    gain = vignetting_gain(source, FALLOFF).astype(np.float32)
    add("+ its fisheye_corr, pixels and filter", bent(ours * gain[..., None]))
    fall = np.polynomial.Polynomial([1, *FALLOFF])(np.minimum(_radius(), 1) ** 2)
    add("+ vignetting after it, not before", bent(ours) / fall)
    plain, still = hdrgen.merge(bracket.frames, bracket.exposures, polynomials())
    add("+ its response, times and weights", bent(plain) / fall)
    add("+ its ghost removal", bent(still) / fall)
    clean = np.maximum(still - hdrgen.flare(still), 0)
    add("+ its flare removal: what is left", bent(clean) / fall)
    return result


def _radius() -> Array:
    """Distance from the middle of the tool's picture, 1 at its edge."""
    middle = (WIDTH - 1) / 2
    y, x = np.mgrid[:WIDTH, :WIDTH] - middle
    return np.hypot(x, y) / (WIDTH / 2)


def compare(one: Array, other: Array, block: int = 1) -> Difference:
    """`one` over `other`, where both are lit, after means over blocks of pixels."""
    n = WIDTH // block
    a, b, r = (v.reshape(n, block, n, block).mean(axis=(1, 3)) for v in (one, other, _radius()))
    seen = (r < INNER) & (a > 0) & (b > 0)
    log = np.full(a.shape, np.nan)
    log[seen] = np.log(a[seen] / b[seen])
    log -= np.nanmedian(log)
    off, level = np.abs(log[seen]), a[seen]
    low, high = np.percentile(level, [25, 75])
    parts = (level < low, (level >= low) & (level < high), level >= high)
    spreads = [np.percentile(off[part], [50, 90]) for part in parts]
    median, most = np.percentile(off, [50, 90])
    classes = tuple((float(m), float(p)) for m, p in spreads)
    return Difference(float(median), float(most), classes, log)


def registered(radiance: Picture, tool: Array) -> tuple[Circle, str]:
    """The crop behind the tool's picture, by features in both; and how well it fits."""
    import cv2
    from scipy.optimize import least_squares

    small = 3  # features of the tool's scale
    size = (radiance.shape[1] // small, radiance.shape[0] // small)
    ours = cv2.resize(luminance(radiance).astype(np.float32), size, interpolation=3)
    sift = cv2.SIFT.create(6000, contrastThreshold=0.02, enable_precise_upscale=True)
    points: list[Array] = []
    described: list[NDArray[np.float32]] = []
    for picture in (tool, np.asarray(ours)):
        log = np.log(np.maximum(picture, np.percentile(picture[picture > 0], 0.5)))
        low, high = np.percentile(log, [20, 99.9])
        grey = (255 * np.clip((log - low) / (high - low), 0, 1)).astype(np.uint8)
        keys, vectors = sift.detectAndCompute(grey, None)
        points.append(np.array([key.pt for key in keys]))
        described.append(np.asarray(vectors, np.float32))
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in cv2.BFMatcher().knnMatch(described[0], described[1], k=2)
        if best.distance < 0.75 * second.distance
    ]
    here, there = (points[k][[pair[k] for pair in pairs]] for k in (0, 1))
    there = (there + 0.5) * small
    d = here - [WIDTH / 2, WIDTH / 2 - 1]
    r = np.maximum(np.hypot(*d.T) / (WIDTH / 2), 1e-9)
    inside = r < INNER
    source = here + d * (hdrgen.fetched(np.minimum(r, 1)) / r - 1)[:, None] + 0.5

    def off(p: Array) -> Array:
        return ((p[:2] + source * p[2] / WIDTH) - there)[inside].ravel()

    start = np.array([STATED.left, STATED.top, STATED.diameter])
    fit = least_squares(off, start, loss="cauchy")
    error = np.median(np.hypot(*off(fit.x).reshape(-1, 2).T)) * WIDTH / fit.x[2]
    circle = Circle(*(float(v) for v in fit.x))
    below = radiance.shape[0] - circle.top - circle.diameter
    return circle, (
        f"{circle.diameter:.0f} px from {circle.left:.0f}, {below:.0f}, not 3612 from 1019, "
        f"74: {inside.sum()} features, median {error:.2f} px of {WIDTH}"
    )


def _directions(circle: Circle) -> Row:
    """How far the directions that the tool's picture claims are from the lens as stated."""
    r = np.linspace(0, INNER, 200)
    radius = hdrgen.fetched(r) * circle.diameter / STATED.diameter
    theta = 2 * np.arcsin(radius * math.sin(math.radians(VIEW / 4)))
    off = np.degrees(theta) - 90 * r
    note = f"at half the radius {np.interp(0.5, r, off):.2f}; the lens as its makers state it"
    return Row(
        "envmap",
        "office probe: directions, the tool's label against the lens",
        "LumiLab",
        0.0,
        float(np.abs(off).max()),
        "degrees",
        note,
    )


def draw(tool: Array, steps: Sequence[Step], block: int, path: Path = PLOT) -> None:
    """Maps of the log ratio at first, without geometry, and at last; ratio over luminance."""
    from matplotlib.figure import Figure

    chosen = [steps[0], steps[4], steps[5], steps[-1]]
    figure = Figure(figsize=(16, 11), layout="constrained")
    grid = figure.subplots(2, 3).ravel()
    grid[0].imshow(np.clip(tool / np.percentile(tool, 80), 0, 1) ** 0.45, cmap="gray")
    grid[0].set_title("the reference tool's picture")
    for axes, one in zip(grid[1:5], chosen, strict=True):
        left = compare(tool, one.picture, block)
        axes.imshow(left.log, cmap="RdBu_r", vmin=-0.2, vmax=0.2)
        axes.set_title(
            f"{one.name}\nmedian {_percent(left.median)}, 90 % {_percent(left.most)}"
        )
    figure.colorbar(grid[1].images[0], ax=list(grid[:5]), label="ln (tool / ours)", shrink=0.6)
    n = WIDTH // block
    level = tool.reshape(n, block, n, block).mean(axis=(1, 3))
    for one in (steps[4], *steps[-3:]):
        log = compare(tool, one.picture, block).log
        seen = np.isfinite(log)
        edges = np.quantile(level[seen], np.linspace(0, 1, 41))
        which = np.clip(np.searchsorted(edges, level[seen]) - 1, 0, 39)
        middle = [float(np.median(log[seen][which == k])) for k in range(40)]
        grid[5].semilogx(np.sqrt(edges[1:] * edges[:-1]), middle, label=one.name)
    grid[5].axhline(0, color="#444444", lw=0.8)
    grid[5].set(xlabel="luminance, relative", ylabel="median ln (tool / ours)")
    grid[5].legend(frameon=False, fontsize=8)
    grid[5].grid(alpha=0.3)
    for axes in grid[:5]:
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80, format="png")
