"""The merge of files: what a sample of the frames tells, then band after band."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        **_fit_figures(fit),
    }

    def merge(rows: Sequence[NDArray[Any]], times: Float) -> Radiance:
        return merge_frames(rows, times, response, tables=tables, sigma=sigma)

    idle = _idle(frames, tables.saturated)
    return Prepared(chosen, merge, idle, figures)


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
        peak = max(float(sample.largest.max()) for sample in frames.samples)
        white = 65535.0 if frames.kind == np.uint16 else peak
    if not white > 0:
        raise UserError("all pictures are black: take longer exposures")
    order = np.argsort(exposures, kind="stable")
    t = exposures[order][:, None, None]
    x = np.stack([frames.samples[j].values for j in order]) / np.float64(white)
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
    figures |= {"noise_from": origin, "noise": model, "white": white, **_fit_figures(fit)}
    top = float(white)

    def merge(rows: Sequence[NDArray[Any]], times: Float) -> Radiance:
        return merge_linear(rows, times, white=top, noise=model, sigma=sigma)

    return Prepared(chosen, merge, _idle(frames, SATURATED * top), figures)


def write_merged(
    path: Path,
    frames: Frames,
    exposures: Float,
    prepared: Prepared,
    *,
    sigma: bool,
    attributes: Mapping[str, Any],
) -> tuple[dict[str, Any], Glance]:
    """Merge band after band into an EXR; figures of it, and how it looks at a glance.

    Raises
    ------
    UserError
        When no pixel of a channel, whichever, is measured.

    """
    height, width, _ = frames.shape
    names = [*frames.channels]
    if sigma:
        names += [f"sigma.{name}" for name in frames.channels]
    names.append("clipped")
    times = exposures[list(prepared.chosen)]
    preview = Preview(height, width)
    stride = max(1, int(np.sqrt(height * width / _STATISTICS)))
    high, low, negative = (np.zeros(len(frames.channels), np.int64) for _ in range(3))
    clipped = 0
    measured: list[NDArray[np.float32]] = []
    relative: list[NDArray[np.float32]] = []
    with exr_rows(path, (width, height), channels=names, attributes=attributes) as append:
        for top, rows in frames.bands(prepared.chosen):
            part = prepared.merge(rows, times)
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
