"""``response.json`` and the plot beside it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from chromeball.hdr.response import CODES, MIDDLE, Solution, hat
from chromeball.scene.errors import UserError
from chromeball.scene.record import to_json

type Float = NDArray[np.float64]


class Exposed(Struct, frozen=True, forbid_unknown_fields=True):
    """A frame the curve was solved from: its exposure as given, and as used (refined)."""

    file: str
    given: Annotated[float, Meta(gt=0)]
    used: Annotated[float, Meta(gt=0)]


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    channels: Annotated[list[str], Meta(min_length=1)]
    codes: int
    log_exposure: list[list[float]]
    sigma: list[list[float]]
    weights: list[float]
    code_noise: list[float]
    refined: bool
    exposures: list[Exposed]
    record: dict[str, Any]
    version: int = 1


@dataclass(frozen=True)
class Response:
    """A camera's response.

    ``log_exposure``, ``sigma`` (C, 256): natural logarithm of exposure for each code, zero at
    code 128 and strictly rising, and its standard error. ``weights`` (256,): the hat it was
    solved with. ``code_noise`` (C,): standard deviation of a pixel, in codes. ``refined``: the
    frames' exposures were unknowns too, and ``exposures`` holds both. ``record``: where the
    curve comes from, and its figures.
    """

    channels: tuple[str, ...]
    log_exposure: Float
    sigma: Float
    weights: Float
    code_noise: Float
    refined: bool = False
    exposures: tuple[Exposed, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @classmethod
    def from_log_exposure(cls, log_exposure: Float) -> Response:
        """A curve that is known: (C, 256), or (256,) for grey; zero at code 128 afterwards."""
        curves = np.atleast_2d(log_exposure)
        curves = curves - curves[:, MIDDLE, None]
        return cls(
            channels=("R", "G", "B") if len(curves) == 3 else ("Y",),
            log_exposure=curves,
            sigma=np.zeros_like(curves),
            weights=hat(),
            code_noise=np.full(len(curves), 12**-0.5),
        )


def from_solution(
    solution: Solution,
    channels: tuple[str, ...],
    files: list[Path],
    exposures: Float,
    record: Mapping[str, Any],
) -> Response:
    """The contract's form of what the solver found."""
    rows = zip(files, exposures, np.exp(solution.log_exposures), strict=True)
    return Response(
        channels=channels,
        log_exposure=solution.g,
        sigma=solution.sigma,
        weights=hat(),
        code_noise=solution.code_noise,
        refined=solution.refined,
        exposures=tuple(Exposed(f.name, float(given), float(used)) for f, given, used in rows),
        record=record,
    )


def encode_response(response: Response) -> bytes:
    """The bytes of a ``response.json``."""
    content = {
        "version": 1,
        "channels": response.channels,
        "codes": CODES,
        "log_exposure": response.log_exposure,
        "sigma": response.sigma,
        "weights": response.weights,
        "code_noise": response.code_noise,
        "refined": response.refined,
        "exposures": [msgspec.to_builtins(row) for row in response.exposures],
        "record": response.record,
    }
    return msgspec.json.format(msgspec.json.encode(to_json(content)), indent=1) + b"\n"


def read_response(path: str | os.PathLike[str]) -> Response:
    """Read and check a ``response.json``.

    Raises
    ------
    UserError
        Missing, not JSON, an unknown or missing key, wrong lengths, a curve that does not rise
        or is not zero at the middle code.

    """
    try:
        return parse_response(Path(path).read_bytes(), path)
    except FileNotFoundError as error:
        raise UserError("no such response; `hdr response` makes one", file=path) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error


def parse_response(data: bytes, path: str | os.PathLike[str] = "response.json") -> Response:
    """As :func:`read_response`, from the bytes."""
    try:
        content = msgspec.json.decode(data, type=_File)
    except msgspec.ValidationError as error:
        raise UserError(str(error).replace("`$.", "`"), file=path) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UserError(f"not valid JSON: {error}", file=path) from error
    if content.version != 1:
        raise UserError(f"version {content.version}: this program reads version 1", file=path)
    if content.codes != CODES:
        raise UserError(f"{content.codes} codes: only {CODES} are supported", file=path)
    count = len(content.channels)
    if len(set(content.channels)) != count:
        raise UserError("two channels have one name", file=path)
    curves = _table(content.log_exposure, (count, CODES), "log_exposure", path)
    sigma = _table(content.sigma, (count, CODES), "sigma", path)
    weights = _table([content.weights], (1, CODES), "weights", path)[0]
    noise = _table([content.code_noise], (1, count), "code_noise", path)[0]
    for name, curve in zip(content.channels, curves, strict=True):
        if np.any(np.diff(curve) <= 0):
            code = int(np.argmax(np.diff(curve) <= 0)) + 1
            raise UserError(
                f"log_exposure of channel {name} does not rise at code {code}", file=path
            )
        if abs(curve[MIDDLE]) > 1e-9:
            raise UserError(
                f"log_exposure of channel {name} is not zero at code {MIDDLE}", file=path
            )
        if np.ptp(curve) > 80:
            raise UserError(f"log_exposure of channel {name} spans e^80 or more", file=path)
    for name, table in (("sigma", sigma), ("weights", weights), ("code_noise", noise)):
        if np.any(table < 0):
            raise UserError(f"{name} holds negative values", file=path)
    return Response(
        channels=tuple(content.channels),
        log_exposure=curves,
        sigma=sigma,
        weights=weights,
        code_noise=noise,
        refined=content.refined,
        exposures=tuple(content.exposures),
        record=content.record,
    )


def _table(
    rows: list[list[float]], shape: tuple[int, int], name: str, path: str | os.PathLike[str]
) -> Float:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise UserError(f"{name} needs {shape[0]} x {shape[1]} numbers", file=path)
    table = np.array(rows, np.float64)
    if not np.all(np.isfinite(table)):
        raise UserError(f"{name} holds values that are not finite", file=path)
    return table


def exposures_for(
    response: Response, exposures: Float, *, tolerance: float = 1e-3
) -> tuple[Float, int]:
    """Refined exposures for frames that were given `exposures`, and how many were found.

    A camera's nominal times are rounded always alike, so a refined exposure serves every frame
    of the same nominal one. Nothing is changed unless the response was refined.
    """
    if not response.refined:
        return exposures, 0
    given = np.array([row.given for row in response.exposures])
    used = np.array([row.used for row in response.exposures])
    result = exposures.copy()
    found = 0
    for k, exposure in enumerate(exposures):
        nearest = int(np.argmin(np.abs(np.log(given / exposure))))
        if abs(math.log(given[nearest] / exposure)) < tolerance:
            result[k] = used[nearest]
            found += 1
    return result, found


def plot_response(response: Response, path: str | os.PathLike[str]) -> None:
    """Draw ln exposure over code with a band of two standard errors, and the errors, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    curve, error = figure.subplots(1, 2)
    z = np.arange(CODES)
    colors = {"R": "#c0392b", "G": "#27853d", "B": "#2c5fa8"}
    for name, g, sigma in zip(
        response.channels, response.log_exposure, response.sigma, strict=True
    ):
        color = colors.get(name, "#444444")
        curve.plot(z, g, color=color, lw=1.5, label=name)
        curve.fill_between(z, g - 2 * sigma, g + 2 * sigma, color=color, alpha=0.2, lw=0)
        error.semilogy(z[sigma > 0], sigma[sigma > 0], color=color, lw=1.2)
    curve.set(xlabel="code", ylabel="ln exposure", title="response, ± 2 standard errors")
    error.set(xlabel="code", ylabel="standard error of ln exposure", title="standard error")
    low, high = response.log_exposure.min(), response.log_exposure.max()
    curve.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    curve.legend(frameon=False)
    for axes in (curve, error):
        axes.grid(alpha=0.3)
        axes.set_xlim(0, CODES - 1)
    figure.savefig(path, dpi=110, format="png", metadata={"Software": None})
