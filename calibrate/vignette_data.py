"""What measures a lens's fall-off: linear pictures, and samples of smooth light in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]
type Index = NDArray[np.intp]

#: Least relative error of a place: paper and print, or a panel's grain.
PAPER = 0.002


@dataclass(frozen=True)
class Picture:
    """``radiance`` (H, W) linear; ``unusable`` (H, W): saturated, or not valid."""

    name: str
    radiance: NDArray[np.float32]
    unusable: NDArray[np.bool_]


@dataclass(frozen=True)
class Samples:
    """N measurements of light that varies smoothly over each group.

    ``pixels`` (N, 2); ``log`` (N,) ln of the radiance; ``sigma`` (N,) its deviation, up to a
    common factor; ``group`` (N,) 0 .. G - 1, of one light each; ``cluster`` (N,): what errs
    together; ``light`` (N, L): what the light may do within a group, in coordinates of about
    -1 .. 1, with ``kinds`` (L,) that share a variance; ``shared`` (N, M) what it does in all.
    """

    pixels: Float
    log: Float
    sigma: Float
    group: Index
    cluster: Index
    light: Float
    kinds: tuple[int, ...]
    shared: Float

    def of(self, chosen: NDArray[np.bool_]) -> Samples:
        """Some of them, groups and clusters numbered anew."""
        return replace(
            self,
            pixels=self.pixels[chosen],
            log=self.log[chosen],
            sigma=self.sigma[chosen],
            group=np.unique(self.group[chosen], return_inverse=True)[1],
            cluster=np.unique(self.cluster[chosen], return_inverse=True)[1],
            light=self.light[chosen],
            shared=self.shared[chosen],
        )


def apertures_agree(apertures: Sequence[float | None]) -> float | None:
    """The one aperture of all pictures, or None where none is told.

    Raises
    ------
    UserError
        Pictures of several apertures: the fall-off changes with it.

    """
    told = {a for a in apertures if a is not None and a > 0}
    if len(told) > 1:
        listed = ", ".join(f"f/{a:g}" for a in sorted(told))
        raise UserError(
            f"pictures of several apertures ({listed}): the fall-off changes with it; "
            "measure each by itself"
        )
    return told.pop() if told else None
