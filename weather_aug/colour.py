"""sRGB and linear light; the one owner of the conversion."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709 weights of linear RGB."""


def linear_from_srgb(value: Float64) -> Float64:
    """Linear light in [0, 1] of an sRGB value in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, np.float64)
    linear: Float64 = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear


def srgb_from_linear(value: Float64) -> Float64:
    """Encode linear light in [0, 1] as an sRGB value in [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, np.float64)
    low, high = value * 12.92, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055
    srgb: Float64 = np.where(value <= 0.0031308, low, high)
    return srgb


SRGB_LEVELS_LINEAR = linear_from_srgb(np.arange(256) / 255.0)
"""(256,) linear light of each 8-bit sRGB level."""


@lru_cache(maxsize=1)
def srgb_of_16_bits() -> NDArray[np.uint8]:
    """(65536,) sRGB level of linear light, 65535 for white."""
    return np.round(255.0 * srgb_from_linear(np.arange(65536) / 65535.0)).astype(np.uint8)
