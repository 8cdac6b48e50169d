"""Pictures within the page itself: read, made no larger than a page needs, base64."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np

#: no wider than this; twice the width of a picture in the page, for dense screens
WIDTH = 1600
#: a PNG of more bytes than this becomes a JPEG where it has no alpha
LARGE = 400_000


def data_uri(path: Path) -> str | None:
    """``data:image/png;base64,...`` of a PNG or JPEG, or None when it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if not content:
        return None
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        return None
    if pixels.dtype != np.uint8:
        pixels = np.round(pixels / 257.0).astype(np.uint8)
    height, width = pixels.shape[:2]
    png = content.startswith(b"\x89PNG")
    large = len(content) > LARGE
    if width <= WIDTH and not (png and large):
        return _uri(content, png)
    if width > WIDTH:
        size = (WIDTH, max(1, round(height * WIDTH / width)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    keep_png = png and (not large or (pixels.ndim == 3 and pixels.shape[2] == 4))
    suffix, options = (".png", []) if keep_png else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    done, encoded = cv2.imencode(suffix, pixels, options)
    return _uri(encoded.tobytes(), keep_png) if done else None


def _uri(content: bytes, png: bool) -> str:
    kind = "png" if png else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
