"""Pictures on their way into a network and back: scaled with their aspect kept, padded, cut.

Nothing is squeezed into a square: what is missing to a multiple of the network's step is the
picture's own mirror image, on the right and below.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import DataError

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]

MULTIPLE_PX = 8
"""Of a latent's pixel."""


def edited_size(shape: tuple[int, ...], rows: int | None) -> tuple[int, int]:
    """(height, width) at which a picture of a shape (H, W, ...) is edited; `rows` None: its own."""
    height, width = shape[:2]
    return (height, width) if rows is None else (rows, max(1, round(width * rows / height)))


def fitted(image: UInt8, rows: int | None, multiple: int = MULTIPLE_PX) -> UInt8:
    """A picture (H, W, 3) at the edited size, mirrored up to multiples of `multiple` pixels."""
    height, width = edited_size(image.shape, rows)
    if image.shape[:2] != (height, width):
        smaller = height < image.shape[0]
        kind = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
        image = np.asarray(cv2.resize(image, (width, height), interpolation=kind), np.uint8)
    return mirrored(image, multiple)


def mirrored(array: NDArray[np.uint8], multiple: int = MULTIPLE_PX) -> UInt8:
    """A map (H, W, ...) with its mirror image right and below, to multiples of `multiple` px."""
    sides = [(0, -side % multiple) for side in array.shape[:2]]
    return np.pad(array, [*sides, *[(0, 0)] * (array.ndim - 2)], mode="reflect")


def restored(pixels: Float32, frame: Frame, rows: int | None) -> UInt8:
    """What a network made of a fitted picture, as a picture of the frame's size.

    Args:
        pixels: (H', W', 3) in [0, 1], of the fitted size; what lies outside is cut off.
        frame: Whose picture it was.
        rows: As in `fitted`.

    Returns:
        (H, W, 3) sRGB.

    Raises:
        DataError: If it holds NaN.
    """
    image = levels(pixels, frame.key)
    height, width = edited_size(frame.image.shape, rows)
    image = image[:height, :width]
    if image.shape != frame.image.shape:
        size = frame.image.shape[1::-1]
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    return np.ascontiguousarray(image)


def levels(pixels: Float32, key: FrameKey) -> UInt8:
    """SRGB levels of values in [0, 1], which are clipped.

    Raises:
        DataError: If there is NaN; it names the frame.
    """
    if not np.isfinite(pixels).all():
        raise DataError(
            f"frame {key}: the editor's picture holds NaN; use the model in float32 (half=False)"
        )
    return np.round(255.0 * np.clip(pixels, 0.0, 1.0)).astype(np.uint8)
