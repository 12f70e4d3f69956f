"""PNG bytes: lossless, and the same for the same picture on every run."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError

LEVEL = 3
"""Of zlib; higher levels cost more time than rendering and save less than a tenth."""


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """Encode (H, W, 3) RGB or a single-channel (H, W) uint8 picture.

    Raises:
        ArgumentError: If the picture cannot be a PNG.
    """
    # OpenCV answers other arrays with exceptions of its own.
    if image.dtype != np.uint8 or image.size == 0 or not _is_picture(image.shape):
        raise ArgumentError(
            f"a picture must be uint8 of shape (H, W) or (H, W, 3), got {image.dtype} {image.shape}"
        )
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, LEVEL])
    if not ok:
        raise ArgumentError(f"a picture of shape {image.shape} cannot be encoded as PNG")
    encoded: bytes = png.tobytes()
    return encoded


def _is_picture(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
