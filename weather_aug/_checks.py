"""Checks of arguments at the edge: right, or a typed error that names the argument."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from weather_aug.errors import ArgumentError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_PIXELS = 64_000_000


def finite(name: str, value: float, low: float = -math.inf, high: float = math.inf) -> float:
    """Return `value` as a float in [low, high], or refuse it by `name`."""
    number = real(name, value)
    if not math.isfinite(number) or not low <= number <= high:
        raise ArgumentError(f"{name} must be a finite number in [{low:g}, {high:g}], got {value!r}")
    return number


def real(name: str, value: float) -> float:
    """Return `value` as a float, infinities allowed; refuse text, booleans and NaN by `name`."""
    if isinstance(value, bool | str | bytes):
        raise ArgumentError(f"{name} must be a number, got {type(value).__name__}")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(f"{name} must be a number, got {type(value).__name__}") from None
    if math.isnan(number):
        raise ArgumentError(f"{name} must be a number, got NaN")
    return number


def image_uint8(name: str, image: Any) -> NDArray[np.uint8]:
    """Return `image` as a C-contiguous (H, W, 3) uint8 array, or refuse it by `name`."""
    import numpy as np

    if not isinstance(image, np.ndarray):
        raise ArgumentError(f"{name} must be a numpy array, got {type(image).__name__}")
    if image.dtype != np.uint8:
        raise ArgumentError(f"{name} must be uint8, got {image.dtype}")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ArgumentError(f"{name} must have shape (H, W, 3), got {image.shape}")
    height, width, _ = image.shape
    if height == 0 or width == 0:
        raise ArgumentError(f"{name} has a zero side: {image.shape}")
    if height * width > MAX_PIXELS:
        raise ArgumentError(f"{name} has {height * width} pixels, more than {MAX_PIXELS}")
    return np.ascontiguousarray(image)


def like_image(name: str, array: Any, shape: tuple[int, int]) -> None:
    """Refuse an array whose shape is not the image's (H, W)."""
    if tuple(array.shape) != tuple(shape):
        raise ArgumentError(
            f"{name} must have the image's shape {tuple(shape)}, got {tuple(array.shape)}; "
            "crop and resize both together"
        )
