"""Noise taken out of a still by Intel's Open Image Denoise (the extra ``denoise``).

It sees what is kept of the plate and what is added to it, never the photograph: grain and
detail of the plate stay, and pixels that no object changes keep their bits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

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
    from scipy.ndimage import distance_transform_edt

    changed = composite.changed[..., None]
    if not changed.any():
        return composite
    alpha = composite.alpha[..., None]

    def clean(layer: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
        """A layer that covers `share` of each pixel, by its own colour: outlines stay sharp."""
        if not layer.any():
            return layer
        shown = share[..., 0] > 0.02
        if not shown.any():
            return layer
        own = np.divide(layer, share, out=np.zeros_like(layer), where=shown[..., None])
        # where it does not show it goes on as beside, so that nothing bleeds in
        nearest: Any = distance_transform_edt(
            ~shown, return_distances=False, return_indices=True
        )
        own = pyoidn.denoise(np.ascontiguousarray(own[tuple(nearest)]), hdr=True)
        return np.where(shown[..., None], np.maximum(own, 0) * share, layer)

    rest = clean(composite.added - composite.objects, 1 - alpha)  # light added to the set
    kept = np.where(changed, clean(composite.kept, 1 - alpha), 1)
    added = np.where(changed, clean(composite.objects, alpha) + rest, 0)
    kept, added = kept.astype(np.float32), added.astype(np.float32)
    rgb = np.where(changed, np.maximum(plate * kept + added, 0), composite.rgb)
    return replace(composite, rgb=rgb.astype(np.float32), kept=kept, added=added)
