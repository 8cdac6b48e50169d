"""Which exposures a picture needs.

Information adds over the frames: a frame that measures a value with variance v of ln E adds
1 / v, and the signal-to-noise ratio is the root of the sum (Hasinoff et al. 2010 plan captures
by it). Frames whose information is not needed for the target are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Float = NDArray[np.float64]

#: the share of values that must keep what they need
SHARE = 0.999
#: values below the target may lose this share of their signal-to-noise ratio
LOSS = 0.05


@dataclass(frozen=True)
class Choice:
    """Numbers of the frames `kept` and `left_out`.

    ``cost`` of each left out: the share of values that would reach their need with it alone
    put back, and do not without.
    """

    kept: tuple[int, ...]
    left_out: tuple[int, ...]
    cost: tuple[float, ...]


def choose(information: Float, snr: float) -> Choice:
    """Leave out frames, one at a time, while the values keep what they need.

    `information` (P, N): 1 / variance of ln E that frame j adds to value i, zero where it
    measures nothing. A value needs the smaller of `snr` and (1 - LOSS) of what all frames give;
    SHARE of the values must keep it. The frame left out is each time the one whose loss hurts
    fewest values, then the one that adds least: greedy, so not always the smallest set.
    """
    need = np.minimum(snr**2, (1 - LOSS) ** 2 * information.sum(axis=0))
    need *= 1 - 1e-9  # a sum in another order is not a loss
    kept = list(range(len(information)))
    left_out: list[int] = []
    while len(kept) > 1:
        total = information[kept].sum(axis=0)
        hurt = [float(np.mean(total - information[j] < need)) for j in kept]
        adds = [float(np.minimum(information[j], snr**2).mean()) for j in kept]
        best = min(range(len(kept)), key=lambda k: (hurt[k], adds[k]))
        if hurt[best] > 1 - SHARE:
            break
        left_out.append(kept.pop(best))
    total = information[kept].sum(axis=0)
    short = total < need
    cost = [float(np.mean(short & (total + information[j] >= need))) for j in left_out]
    return Choice(tuple(kept), tuple(left_out), tuple(cost))
