"""Radiance back to the codes of the camera that took the plate (rows P9, A4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError


def expose(
    rgb: NDArray[np.floating], response: Response, exposure: float
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Codes (H, W, 3) that the camera gives for radiance `rgb` (H, W, 3) at `exposure`.

    `exposure` is in the units of the merge (its attribute ``exposures``), so that a frame's own
    radiance becomes that frame again, code for code. 256 codes are uint8; more are spread over
    uint16.

    Raises
    ------
    UserError
        A response of neither one nor three channels.

    """
    curves = response.log_exposure
    if len(curves) not in (1, rgb.shape[2]):
        raise UserError(
            f"the response has {len(curves)} channels, the composite {rgb.shape[2]}: it is of "
            "another camera"
        )
    codes = response.codes
    numbers = np.arange(codes)
    with np.errstate(divide="ignore"):
        log_x = np.log(np.asarray(rgb, float) * exposure)
    z = np.stack(
        [np.interp(log_x[..., c], curves[c % len(curves)], numbers) for c in range(3)], axis=-1
    )
    if codes == 256:
        return np.rint(z).astype(np.uint8)
    return np.rint(z * (65535 / (codes - 1))).astype(np.uint16)


def best_frame(
    plate: NDArray[np.floating], response: Response, exposures: Sequence[float]
) -> int:
    """The number of the exposure that shows most of the plate: neither black nor white."""
    stride = max(1, int(np.sqrt(plate[..., 0].size / 1e5)))
    some = np.asarray(plate[::stride, ::stride], float).reshape(-1, plate.shape[2])
    curves = response.log_exposure
    ends = curves[:, [response.codes // 32, response.codes - 1 - response.codes // 32]]
    with np.errstate(divide="ignore"):
        log_l = np.log(some)
    shown = [
        np.mean((log_l + np.log(x) > ends[:, 0]) & (log_l + np.log(x) < ends[:, 1]))
        for x in exposures
    ]
    return int(np.argmax(shown))
