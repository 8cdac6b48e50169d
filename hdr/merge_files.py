"""The merge of files: what a sample of the frames tells, then band after band."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.bracket import Bracket, Picture, mosaics
from chromeball.hdr.exposure import (
    Luminance,
    Suspicion,
    check_exposures,
    luminance_scale,
)
from chromeball.hdr.merge import (
    SATURATED,
    SENSOR_NOISE,
    Radiance,
    code_weights,
    merge_frames,
    merge_linear,
    stops,
)
from chromeball.hdr.noise import (
    CodeNoise,
    Fit,
    chi_square,
    measure_codes,
    measure_linear,
    unsaturated,
)
from chromeball.hdr.preview import Glance, Preview
from chromeball.hdr.response_file import Response
from chromeball.hdr.select import choose
from chromeball.hdr.stream import Frames
from chromeball.scene.errors import UserError
from chromeball.scene.image import exr_rows
from chromeball.scene.raw import Balance, Mosaic, develop, develop_sigma, tiled, touched
from chromeball.scene.vignette import Vignette

type Float = NDArray[np.float64]
type Merge = Callable[[Sequence[NDArray[Any]], Float], Radiance]

#: values that decide which frames are needed, and values of the statistics
_VALUES, _STATISTICS = 40_000, 2_000_000


@dataclass(frozen=True)
class Prepared:
    """How to merge: the frames that are `chosen`, a function for their rows, and figures.

    ``idle`` says of each frame that measures nothing anywhere why.
    """

    chosen: tuple[int, ...]
    merge: Merge
    idle: Mapping[int, str]
    figures: dict[str, Any] = field(default_factory=dict[str, Any])


def prepare_codes(
    frames: Frames, exposures: Float, response: Response, *, sigma: bool, snr: float | None
) -> Prepared:
    """Measure the noise of a bracket of codes and decide which frames are merged."""
    brightest = max(int(s.largest.max()) for s in frames.samples)
    if brightest >= response.codes:
        raise UserError(
            f"code {brightest} in the pictures, but the response has {response.codes} codes: "
            "solve the response from pictures of the same depth"
        )
    order = np.argsort(exposures, kind="stable")
    values = [frames.samples[j].values for j in order]
    noise, origin = measure_codes(values, exposures[order], response), "bracket"
    if noise is None:
        noise, origin = CodeNoise.of(response), "response"
    tables = code_weights(response, noise)
    z = np.stack(values).astype(np.intp)
    channel = np.arange(z.shape[2])
    weight = tables.weight[channel, z] * unsaturated(z, tables.saturated)
    taper = tables.taper[channel, z]
    y = response.log_exposure[channel, z] - np.log(exposures[order])[:, None, None]
    variance = np.where(weight > 0, taper, 1) / np.where(weight > 0, weight, 1)
    fit = chi_square(y, variance, weight > 0)
    chosen, figures = _chosen(frames, order, weight, snr)
    figures |= {
        "noise_from": origin,
        "noise_code": noise.code,
        "noise_shot": noise.shot,
        "noise_read": noise.read,
        "noise_over_response": _over_response(z, y, response),
        **_fit_figures(fit),
    }

    def merge(rows: Sequence[NDArray[Any]], times: Float) -> Radiance:
        return merge_frames(rows, times, response, tables=tables, sigma=sigma)

    idle = _idle(frames, tables.saturated)
    return Prepared(chosen, merge, idle, figures)


def _over_response(z: NDArray[np.intp], y: Float, response: Response) -> float | None:
    """Scatter about the response over that of the pictures it was solved from."""
    if response.method == "given":
        return None
    tables = code_weights(response)
    channel = np.arange(z.shape[2])
    weight = tables.weight[channel, z] * unsaturated(z, tables.saturated)
    taper = tables.taper[channel, z]
    variance = np.where(weight > 0, taper, 1) / np.where(weight > 0, weight, 1)
    found = chi_square(y, variance, weight > 0)
    worst = np.nanmax(found.chi_square) if np.any(np.isfinite(found.chi_square)) else np.nan
    return float(np.sqrt(worst)) if np.isfinite(worst) else None


def prepare_linear(
    frames: Frames,
    exposures: Float,
    *,
    white: float | None,
    noise: tuple[float, float] | None,
    sigma: bool,
    snr: float | None,
) -> Prepared:
    """Measure the noise of a linear bracket and decide which frames are merged."""
    if white is None:
        white = 65535.0 if frames.kind == np.uint16 else _piled_up(frames)
        if not white > 0:
            raise UserError("all pictures are black: take longer exposures")
    elif not (np.isfinite(white) and white > 0):
        raise UserError(f"--white {white:g}: give the value of a saturated pixel")
    order = np.argsort(exposures, kind="stable")
    x = np.stack([frames.samples[j].values for j in order]) / np.float64(white)
    prepared = _prepare_shares(frames, exposures, x, noise, snr)
    model, top = prepared.noise, float(white)

    def merge(rows: Sequence[NDArray[Any]], times: Float) -> Radiance:
        return merge_linear(rows, times, white=top, noise=model, sigma=sigma)

    figures = prepared.figures | {"white": white}
    return Prepared(prepared.chosen, merge, _idle(frames, SATURATED * top), figures)


def _piled_up(frames: Frames) -> float:
    """The value at which float frames saturate.

    Clipped values are equal: the highest value that piles up, with next to nothing above it (a
    hot pixel, a firefly); the largest of all where none does.
    """
    values = np.concatenate([sample.values.ravel() for sample in frames.samples])
    found, counts = np.unique(values[values > 0], return_counts=True)
    above = np.cumsum(counts[::-1])[::-1] - counts
    piles = np.flatnonzero((counts >= 16) & (above <= counts / 20))
    if piles.size:
        return float(found[piles[np.argmax(counts[piles])]])
    return max(float(sample.largest.max()) for sample in frames.samples)


@dataclass(frozen=True)
class _Shares:
    chosen: tuple[int, ...]
    noise: Float  # (C, 2)
    figures: dict[str, Any]


def _prepare_shares(
    frames: Frames,
    exposures: Float,
    x: Float,
    noise: tuple[float, float] | None,
    snr: float | None,
) -> _Shares:
    """Noise and choice of frames from samples x (P, N, C), shares of white, sorted."""
    order = np.argsort(exposures, kind="stable")
    t = exposures[order][:, None, None]
    usable = unsaturated(x, SATURATED)
    origin, model = "--noise", np.broadcast_to(noise or SENSOR_NOISE, (x.shape[2], 2))
    if noise is None:
        found = [
            measure_linear(x[..., c], exposures[order], usable[..., c])
            for c in range(x.shape[2])
        ]
        known = [pair for pair in found if pair is not None]
        origin = "bracket" if len(known) == len(found) else "default"
        if origin == "bracket":
            model = np.stack(known)
    a, b = model[:, 0], model[:, 1]
    times = np.where(usable, t, 0)
    pilot = (times * x).sum(axis=0) / np.maximum((times**2).sum(axis=0), 1e-300)
    level = np.maximum(pilot, 0)
    variance = (a * level * t + b) / t**2
    fit = chi_square(x / t, variance, usable)
    information = np.where(usable, level**2 / variance, 0)
    chosen, figures = _chosen(frames, order, information, snr)
    return _Shares(
        chosen,
        model,
        figures | {"noise_from": origin, "noise": model, **_fit_figures(fit)},
    )


@dataclass
class Sensor:
    """A RAW bracket as pictures of one channel, for :class:`Frames`; what they have in common.

    ``first`` is the first frame's mosaic, ``white`` the lowest level that any frame shows.
    """

    first: Mosaic | None = None
    white: Float = field(default_factory=lambda: np.full((2, 2), np.inf))

    def pictures(self, bracket: Bracket, tell: Callable[[str], None]) -> Iterator[Picture]:
        """Sensor values (H, W, 1) of frame after frame."""
        for path, mosaic in zip(bracket.paths, mosaics(bracket, tell), strict=True):
            self.first = self.first or mosaic
            self.white = np.minimum(self.white, mosaic.white)
            yield Picture(path, mosaic.pixels[..., None], ("sensor",), linear=True)

    @property
    def info(self) -> Mosaic:
        """The first frame's mosaic, with the white of all."""
        if self.first is None:
            raise ValueError("no frame was read")
        return replace(self.first, white=self.white)


def prepare_sensor(
    frames: Frames,
    exposures: Float,
    info: Mosaic,
    *,
    noise: tuple[float, float] | None,
    sigma: bool,
    snr: float | None,
) -> Prepared:
    """As :func:`prepare_linear`, for a Bayer sensor's values; radiance in shares of white."""
    shape = info.pixels.shape
    rows, columns = frames.lattice
    dark, scale = (
        tiled(cell, shape)[rows, columns].reshape(-1, 1)
        for cell in (info.black, info.white - info.black)
    )
    order = np.argsort(exposures, kind="stable")
    x = np.stack([(frames.samples[j].values - dark) / scale for j in order])
    prepared = _prepare_shares(frames, exposures, x, noise, snr)
    model = prepared.noise[0]
    levels = info.white - info.black

    def merge(rows: Sequence[NDArray[Any]], times: Float) -> Radiance:
        merged = merge_linear(
            rows, times, black=info.black, white=info.white, noise=model, sigma=sigma
        )
        share = tiled((1 / levels).astype(np.float32), merged.radiance.shape[:2])[..., None]
        return replace(
            merged,
            radiance=merged.radiance * share,
            sigma=None if merged.sigma is None else merged.sigma * share,
        )

    saturated = float((info.black + SATURATED * levels).min())
    figures = prepared.figures | {
        "black": info.black,
        "white": info.white,
        "white_from": "metadata" if np.all(info.white == info.stated_white) else "pixels",
        "pattern": "".join(info.pattern),
    }
    return Prepared(prepared.chosen, merge, _idle(frames, saturated), figures)


def developed(
    frames: Frames,
    exposures: Float,
    prepared: Prepared,
    info: Mosaic,
    white_balance: Balance,
) -> tuple[Radiance, dict[str, Any]]:
    """A RAW bracket merged as its sensor's mosaic and then developed, once; and figures of it.

    Values that the demosaic touches a saturated one for are marked as bounds. Colours outside
    Rec.709 are negative and kept.
    """
    shape = frames.shape[:2]
    mosaic, clipped = np.empty(shape, np.float32), np.empty(shape, np.int8)
    error: NDArray[np.float32] | None = None
    for top, part in merge_bands(frames, exposures, prepared):
        end = top + len(part.radiance)
        mosaic[top:end], clipped[top:end] = part.radiance[..., 0], part.clipped
        if part.sigma is not None:
            error = np.empty(shape, np.float32) if error is None else error
            error[top:end] = part.sigma[..., 0]
    for mark, word, wish in ((1, "saturated", "shorter"), (-1, "black", "longer")):
        if np.all(clipped == mark):
            raise UserError(f"every pixel is {word} in all pictures: take {wish} exposures")
    space: Literal["rec709", "camera"] = "rec709" if info.matrix is not None else "camera"
    rgb = develop(mosaic, info, white_balance, space)
    bound = touched(clipped == 1)
    dark = clipped == -1
    marks = np.where(bound, 1, np.where(dark, -1, 0)).astype(np.int8)
    letters = np.array([list(row) for row in info.pattern])
    counts = [
        [int((tiled(letters == letter, shape) & (clipped == mark)).sum()) for letter in "RGB"]
        for mark in (1, -1)
    ]
    multipliers = info.multipliers(white_balance)
    return Radiance(
        radiance=rgb,
        sigma=None if error is None else develop_sigma(error, info, white_balance, space),
        clipped=marks,
        high=np.array(counts[0]),
        low=np.array(counts[1]),
        negative=(rgb < 0).sum(axis=(0, 1)),
    ), {
        "white_balance": multipliers,
        "white_balance_from": white_balance if isinstance(white_balance, str) else "given",
        "colour_space": space,
    }


def deghosted(
    frames: Frames,
    exposures: Float,
    prepared: Prepared,
    response: Response | None,
    white: float | None,
) -> tuple[Radiance, dict[str, Any]]:
    """A bracket merged whole, what moved taken from one exposure; and figures of it."""
    from chromeball.hdr.ghost import find_ghosts
    from chromeball.hdr.ghost import replace as replace_ghosts

    if response is not None and response.codes != 256:
        raise UserError("ghosts are found in 8-bit and in linear pictures; leave --deghost out")
    chosen = list(prepared.chosen)
    height = frames.shape[0]
    held = frames.part(chosen, 0, height)
    merged = prepared.merge(held, exposures[chosen])
    given = [frames.bracket.frames[j].transform for j in chosen]
    valid = None
    if frames.bracket.aligned:
        valid = [_inside(frames.shape[:2], transform) for transform in given]
    curve = None if response is None else response.log_exposure
    noise = np.ones(1) if response is None else response.code_noise
    ghosts = find_ghosts(
        held,
        exposures[chosen],
        curve,
        noise,
        sigma=None if response is None else response.sigma,
        valid=valid,
        white=white,
    )
    radiance, clipped = replace_ghosts(
        merged.radiance,
        merged.clipped,
        held,
        exposures[chosen],
        curve,
        ghosts,
        valid=valid,
        white=white,
    )
    error = merged.sigma
    if error is not None:
        for j in {region.frame for region in ghosts.regions}:
            alone = prepared.merge([held[j]], exposures[chosen][[j]]).sigma
            assert alone is not None  # as in the merge of all
            taken = [r.frame == j for r in ghosts.regions]
            here = np.array([False, *taken])[ghosts.labels]
            error = np.where(here[..., None], alone, error).astype(np.float32)
    names = [path.name for path in frames.bracket.paths]
    largest = sorted(ghosts.regions, key=lambda region: -region.area)[:20]
    return replace(merged, radiance=radiance, clipped=clipped, sigma=error), {
        "ghost_regions": len(ghosts.regions),
        "ghost_pixels": ghosts.pixels,
        "ghost_share": ghosts.pixels / (height * frames.shape[1]),
        "ghost_reference": names[chosen[ghosts.reference]],
        "ghosts": [
            {
                "box": " ".join(map(str, region.box)),
                "pixels": region.area,
                "from": names[chosen[region.frame]],
                "clipped": region.clipped,
            }
            for region in largest
        ],
    }


def _inside(shape: tuple[int, int], transform: Float | None) -> NDArray[np.bool_]:
    """Where a resampled frame has pixels, (H, W)."""
    from chromeball.hdr.align import warp

    if transform is None:
        return np.ones(shape, bool)
    return warp(np.ones((*shape, 1), np.uint8), transform)[1]


def merge_bands(
    frames: Frames, exposures: Float, prepared: Prepared
) -> Iterator[tuple[int, Radiance]]:
    """(first row, radiance) of band after band, from the top."""
    times = exposures[list(prepared.chosen)]
    for top, rows in frames.bands(prepared.chosen):
        yield top, prepared.merge(rows, times)


def scaled(part: Radiance, factor: float) -> Radiance:
    """The part in other units."""
    if factor == 1:
        return part
    f = np.float32(factor)
    return replace(
        part,
        radiance=part.radiance * f,
        sigma=None if part.sigma is None else part.sigma * f,
    )


def without_vignetting(
    parts: Iterable[tuple[int, Radiance]], falloff: Vignette, size: tuple[int, int]
) -> Iterator[tuple[int, Radiance]]:
    """Bands (first row, radiance) divided by a lens's fall-off; `size` is of the picture."""
    for top, part in parts:
        rows = (top, top + len(part.radiance))
        gain = np.float32(1) / falloff.picture(size, rows)[..., None]
        sigma = None if part.sigma is None else part.sigma * gain
        yield top, replace(part, radiance=part.radiance * gain, sigma=sigma)


def vignetting_strays(falloff: Vignette, bracket: Bracket, size: tuple[int, int]) -> float:
    """By how much V differs, relatively, between where a pixel is and where frames saw it."""
    known = falloff.size
    scale = np.array([known[0] / size[0], known[1] / size[1]])
    q = np.stack(
        np.meshgrid(np.linspace(0, size[0] - 1, 9), np.linspace(0, size[1] - 1, 9)), axis=-1
    ).reshape(-1, 2)
    here = falloff.at((q + 0.5) * scale - 0.5)
    worst = 0.0
    for frame in bracket.frames:
        if frame.transform is not None:
            moved = np.concatenate([q, np.ones((len(q), 1))], axis=1) @ frame.transform.T
            there = falloff.at((moved[:, :2] / moved[:, 2:] + 0.5) * scale - 0.5)
            worst = max(worst, float(np.abs(np.log(there / here)).max()))
    return worst


def write_merged(
    path: Path,
    size: tuple[int, int],
    channels: Sequence[str],
    parts: Iterable[tuple[int, Radiance]],
    *,
    sigma: bool,
    attributes: Mapping[str, Any],
) -> tuple[dict[str, Any], Glance]:
    """Write bands (first row, radiance) to an EXR; figures of it, and how it looks at a glance.

    `size` is width and height.


    Raises
    ------
    UserError
        When no pixel of a channel, whichever, is measured.

    """
    width, height = size
    names = [*channels]
    if sigma:
        names += [f"sigma.{name}" for name in channels]
    names.append("clipped")
    preview = Preview(height, width)
    stride = max(1, int(np.sqrt(height * width / _STATISTICS)))
    high, low, negative = (np.zeros(len(channels), np.int64) for _ in range(3))
    clipped = 0
    measured: list[NDArray[np.float32]] = []
    relative: list[NDArray[np.float32]] = []
    with exr_rows(path, (width, height), channels=names, attributes=attributes) as append:
        for top, part in parts:
            high, low, negative = high + part.high, low + part.low, negative + part.negative
            clipped += int(np.count_nonzero(part.clipped))
            planes = [part.radiance, *([] if part.sigma is None else [part.sigma])]
            append(
                np.concatenate([*planes, part.clipped[..., None].astype(np.float32)], axis=2)
            )
            preview.add(top, part.radiance, part.clipped, stride)
            some = slice(-top % stride, None, stride), slice(None, None, stride)
            keep = part.clipped[some] == 0
            measured.append(part.radiance[some][keep])
            if part.sigma is not None:
                value = part.radiance[some][keep]
                shown = value > 0
                relative.append(part.sigma[some][keep][shown] / value[shown])
        for marked, word, wish in ((high, "saturated", "shorter"), (low, "black", "longer")):
            if np.all(marked == height * width):
                raise UserError(f"every pixel is {word} in all pictures: take {wish} exposures")
    figures: dict[str, Any] = {
        "clipped_high": high,
        "clipped_low": low,
        "negative": negative,
        "clipped_share": clipped / (height * width),
        "dynamic_range_stops": stops(np.concatenate(measured)),
    }
    if sigma:
        ratios = np.concatenate(relative)
        figures["relative_sigma_median"] = float(np.median(ratios)) if ratios.size else None
    return figures, preview.finish()


def _chosen(
    frames: Frames, order: NDArray[np.intp], information: Float, snr: float | None
) -> tuple[tuple[int, ...], dict[str, Any]]:
    """Numbers of the frames to merge, and what was left out; `information` (P, N, C)."""
    everything = tuple(range(len(order)))
    if snr is None:
        return everything, {}
    if not (np.isfinite(snr) and snr > 0):
        raise UserError(f"a signal-to-noise ratio of {snr:g}: give a positive number")
    flat = information.reshape(len(order), -1)
    flat = flat[:, :: max(1, flat.shape[1] // _VALUES)]
    choice = choose(flat[:, flat.any(axis=0)], snr)
    paths = frames.bracket.paths
    left_out = [
        {"file": paths[order[j]].name, "share_it_would_help": cost}
        for j, cost in zip(choice.left_out, choice.cost, strict=True)
    ]
    chosen = tuple(sorted(int(order[j]) for j in choice.kept))
    return chosen, {"target_snr": snr, "left_out": left_out}


def _idle(frames: Frames, saturated: Any) -> dict[int, str]:
    """Frames that measure nothing anywhere, and why."""
    found: dict[int, str] = {}
    for j, sample in enumerate(frames.samples):
        if np.all(sample.least >= saturated):
            found[j] = "saturated everywhere"
        elif np.all(sample.largest <= 0):
            found[j] = "black everywhere"
    return found


def _fit_figures(fit: Fit) -> dict[str, Any]:
    return {
        "chi_square": fit.chi_square,
        "chi_square_by_range": fit.by_range,
        "outliers": fit.outliers,
    }


def suspicious(
    frames: Frames,
    exposures: Float,
    response: Response | None,
    info: Mosaic | None,
    white: float | None,
) -> list[Suspicion]:
    """Frames whose brightness contradicts their exposures, by the samples of all frames."""
    if len(frames.samples) < 2:
        return []
    values = [sample.values for sample in frames.samples]
    if response is not None:
        if response.codes != 256 or frames.kind != np.uint8:
            return check_exposures([np.exp(_looked_up(response, v)) for v in values], exposures)
        return check_exposures(values, exposures, response.log_exposure)
    if info is not None:
        rows, columns = frames.lattice
        dark, scale = (
            tiled(cell, info.pixels.shape)[rows, columns].reshape(-1, 1)
            for cell in (info.black, info.white - info.black)
        )
        return check_exposures([(v - dark) / scale for v in values], exposures, white=1.0)
    top = white if white is not None else 65535.0 if frames.kind == np.uint16 else None
    return check_exposures([v.astype(np.float64) for v in values], exposures, white=top)


def _looked_up(response: Response, values: NDArray[Any]) -> Float:
    return response.log_exposure[np.arange(values.shape[1]), values.astype(np.intp)]


def read_luminance(
    frames: Frames,
    exposures: Float,
    prepared: Prepared,
    place: Sequence[int],
    luminance: float,
    whole: Radiance | None = None,
    falloff: Vignette | None = None,
) -> Luminance:
    """Calibrate by a reading of `luminance` cd/m^2 at `place`, x, y or x, y, width, height.

    `whole` is the merged picture where it is at hand; else the rows of the place are merged.
    `falloff` is divided out first.
    """
    height, width, _ = frames.shape
    x, y, across, down = place if len(place) == 4 else (place[0] - 3, place[1] - 3, 7, 7)
    if x < 0 or y < 0 or x + across > width or y + down > height or across < 1 or down < 1:
        raise UserError(
            f"the measured place, {across} x {down} pixels at x {x}, y {y}, is not in the "
            f"picture of {width} x {height}"
        )
    part, top = whole, 0
    if part is None:
        rows = frames.part(prepared.chosen, y, y + down)
        part, top = prepared.merge(rows, exposures[list(prepared.chosen)]), y
    if falloff is not None:
        _, part = next(without_vignetting([(top, part)], falloff, (width, height)))
    return luminance_scale(
        part.radiance, (x, y - top, across, down), luminance, clipped=part.clipped != 0
    )
