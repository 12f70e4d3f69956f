"""PNG bytes: lossless, and the same for the same picture on every run."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError

LEVEL = 3
"""Of zlib; higher levels cost more time than rendering and save less than a tenth."""


def png_bytes(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode a (H, W, 3) uint8 RGB picture, or a plane (H, W) of uint8 or uint16.

    Raises:
        ArgumentError: If the picture cannot be a PNG.
    """
    # OpenCV answers other arrays with exceptions of its own.
    if image.size == 0 or not _is_picture(image):
        raise ArgumentError(
            "a picture must be uint8 of shape (H, W) or (H, W, 3), or uint16 of shape (H, W), got "
            f"{image.dtype} {image.shape}"
        )
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, LEVEL])
    if not ok:
        raise ArgumentError(f"a picture of shape {image.shape} cannot be encoded as PNG")
    encoded: bytes = png.tobytes()
    return encoded


def _is_picture(image: NDArray[Any]) -> bool:
    if image.ndim == 2:
        return image.dtype in (np.uint8, np.uint16)
    return image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
