"""PNG bytes: lossless, and the same for the same picture on every run."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError

LEVEL = 3
"""Of zlib; higher levels cost more time than rendering and save less than a tenth."""

ENCODER = f"opencv {cv2.__version__}, PNG level {LEVEL}"
"""Names what decides the bytes; another encoder gives equal pixels in other bytes."""


def encode(picture: NDArray[np.uint8]) -> bytes:
    """Encode (H, W, 3) RGB or a single-channel (H, W) uint8 picture.

    Raises:
        ArgumentError: If the picture cannot be a PNG.
    """
    pixels = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    ok, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, LEVEL])
    if not ok:
        raise ArgumentError(f"a picture of shape {picture.shape} cannot be encoded as PNG")
    encoded: bytes = png.tobytes()
    return encoded
