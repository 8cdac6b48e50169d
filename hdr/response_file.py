"""``response.json``."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from chromeball.hdr.knots import DEPTHS
from chromeball.hdr.rsp import parse_rsp
from chromeball.scene.errors import UserError
from chromeball.scene.record import decode, to_json

type Float = NDArray[np.float64]

#: ln exposure up to which a refined exposure may be a camera's rounding
ROUNDED = 0.2


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
    code_noise: list[float]
    method: str
    refined: bool
    exposures: list[Exposed]
    record: dict[str, Any]
    version: int = 2


@dataclass(frozen=True)
class Response:
    """A camera's response.

    ``log_exposure``, ``sigma`` (C, codes): natural logarithm of exposure for each code, zero
    at the middle code and strictly rising, and its standard error. ``code_noise`` (C,):
    standard deviation of a pixel, in codes: the median over the codes. ``method``: how it was
    found. ``refined``: the frames' exposures were unknowns too, and ``exposures`` holds both.
    ``record``: where the curve comes from, and its figures.
    """

    channels: tuple[str, ...]
    log_exposure: Float
    sigma: Float
    code_noise: Float
    method: str = "given"
    refined: bool = False
    exposures: tuple[Exposed, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def codes(self) -> int:
        """Number of code values."""
        return self.log_exposure.shape[1]

    @classmethod
    def from_log_exposure(cls, log_exposure: Float) -> Response:
        """A curve that is known, (C, codes), or (codes,) for grey; zero at its middle then."""
        curves = np.atleast_2d(log_exposure)
        curves = curves - curves[:, curves.shape[1] // 2, None]
        return cls(
            channels=("R", "G", "B") if len(curves) == 3 else ("Y",),
            log_exposure=curves,
            sigma=np.zeros_like(curves),
            code_noise=np.full(len(curves), 12**-0.5),
        )


def encode_response(response: Response) -> bytes:
    """The bytes of a ``response.json``."""
    content = {
        "version": 2,
        "channels": response.channels,
        "codes": response.codes,
        "method": response.method,
        "log_exposure": response.log_exposure,
        "sigma": _short(response.sigma),
        "code_noise": response.code_noise,
        "refined": response.refined,
        "exposures": [msgspec.to_builtins(row) for row in response.exposures],
        "record": response.record,
    }
    return msgspec.json.format(msgspec.json.encode(to_json(content)), indent=1) + b"\n"


def read_response(path: str | os.PathLike[str]) -> Response:
    """Read and check a ``response.json``, or a ``.rsp`` of Radiance's hdrgen.

    Raises
    ------
    UserError
        Missing, not JSON, an unknown or missing key, wrong lengths, a curve that does not rise
        or is not zero at the middle code.

    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise UserError("no such response; `hdr response` makes one", file=path) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error
    if Path(path).suffix.lower() == ".rsp":
        return Response.from_log_exposure(parse_rsp(data.decode(errors="replace"), path))
    return parse_response(data, path)


def parse_response(data: bytes, path: str | os.PathLike[str] = "response.json") -> Response:
    """As :func:`read_response`, from the bytes."""
    content = decode(data, _File, path)
    if content.version != 2:
        raise UserError(
            f"version {content.version}: this program reads version 2; solve it anew",
            file=path,
        )
    codes = content.codes
    if codes not in DEPTHS:
        known = ", ".join(map(str, DEPTHS))
        raise UserError(f"{codes} codes: cameras have one of {known}", file=path)
    count = len(content.channels)
    if len(set(content.channels)) != count:
        raise UserError("two channels have one name", file=path)
    curves = _table(content.log_exposure, (count, codes), "log_exposure", path)
    sigma = _table(content.sigma, (count, codes), "sigma", path)
    noise = _table([content.code_noise], (1, count), "code_noise", path)[0]
    for name, curve in zip(content.channels, curves, strict=True):
        if np.any(np.diff(curve) <= 0):
            code = int(np.argmax(np.diff(curve) <= 0)) + 1
            raise UserError(
                f"log_exposure of channel {name} does not rise at code {code}", file=path
            )
        if abs(curve[codes // 2]) > 1e-9:
            raise UserError(
                f"log_exposure of channel {name} is not zero at code {codes // 2}", file=path
            )
        if np.ptp(curve) > 80:
            raise UserError(f"log_exposure of channel {name} spans e^80 or more", file=path)
    for name, table in (("sigma", sigma), ("code_noise", noise)):
        if np.any(table < 0):
            raise UserError(f"{name} holds negative values", file=path)
    return Response(
        channels=tuple(content.channels),
        log_exposure=curves,
        sigma=sigma,
        code_noise=noise,
        method=content.method,
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
    response: Response,
    exposures: Float,
    names: Sequence[str] = (),
    *,
    tolerance: float = 1e-3,
) -> tuple[Float, int]:
    """Refined exposures for frames that were given `exposures`, and how many were found.

    A frame that the response was solved from is known by its name. A camera's nominal times
    are rounded always alike, so a refined exposure serves other frames of the same nominal one
    as well, unless two frames of that one came out differently. Nothing is changed unless the
    response was refined.
    """
    if not response.refined:
        return exposures, 0
    result = exposures.copy()
    found = 0
    for k, exposure in enumerate(exposures):
        alike = [
            row for row in response.exposures if abs(math.log(row.given / exposure)) < tolerance
        ]
        own = [row for row in alike if k < len(names) and row.file == names[k]]
        # an exposure that was wrong, not rounded, is one frame's alone
        rounded = [row for row in alike if abs(math.log(row.used / row.given)) < ROUNDED]
        used = {row.used for row in own or rounded}
        if used and max(used) / min(used) < 1.02:
            result[k] = float(np.mean(list(used)))
            found += 1
    return result, found


def _short(table: Float) -> list[list[float]]:
    """Six digits: what is itself an estimate needs no more."""
    return [[float(f"{value:.6g}") for value in row] for row in table.tolist()]
