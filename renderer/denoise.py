"""Noise taken out of a still by Intel's Open Image Denoise (the extra ``denoise``).

It sees what is kept of the plate and what is added to it, never the photograph: grain and
detail of the plate stay, and pixels that no object changes keep their bits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.composite import Composite
from chromeball.scene.errors import UserError


def denoise(composite: Composite, plate: NDArray[np.float32]) -> Composite:
    """The composite over `plate` (H, W, 3) with ``kept``, ``added`` and ``rgb`` denoised.

    The other layers and the standard error stay those of the samples.

    Raises
    ------
    UserError
        Where the extra ``denoise`` is not installed.

    """
    try:
        import pyoidn
    except ImportError as error:
        raise UserError(
            "denoising needs the extra: pip install 'chromeball[denoise]'"
        ) from error
    changed = composite.changed[..., None]
    if not changed.any():
        return composite
    kept = np.where(changed, np.maximum(pyoidn.denoise(composite.kept, hdr=True), 0), 1)
    added = np.where(changed, np.maximum(pyoidn.denoise(composite.added, hdr=True), 0), 0)
    kept, added = kept.astype(np.float32), added.astype(np.float32)
    rgb = np.where(changed, np.maximum(plate * kept + added, 0), composite.rgb)
    return replace(composite, rgb=rgb.astype(np.float32), kept=kept, added=added)
