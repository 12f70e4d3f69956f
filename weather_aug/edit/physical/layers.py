"""What the editor knows of a frame before it knows the weather: maps on the small grid.

They depend on the picture and its geometry alone, so a scene stores them beside the picture and
every weather of it is a function of them, pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

NAMES = (
    *("flatten_slope", "flatten_offset", "matte_slope", "matte_offset"),
    *("illumination", "luminance", "facing_up", "lateral_m"),
    *("sharp_red", "sharp_green", "sharp_blue", "sharp_sky"),
    *("rough_red", "rough_green", "rough_blue", "rough_sky"),
)
FLATTEN_SLOPE, FLATTEN_OFFSET, MATTE_SLOPE, MATTE_OFFSET = range(4)
ILLUMINATION, LUMINANCE_MEAN, FACING_UP, LATERAL_M = range(4, 8)
SHARP, SHARP_SKY, ROUGH, ROUGH_SKY = 8, 11, 12, 15
"""Colours are three maps each, of surfaces; what the sky adds is its share."""


@dataclass(frozen=True, eq=False)
class Layers:
    """Maps of one frame; `step` pixels of the picture are one cell."""

    step: int
    maps: NDArray[np.float16]
    """(16, h, w), in the order of `NAMES`."""
    plane: Float64
    """(3,) of the road: up = plane[0] + plane[1] along + plane[2] left, street axes."""
    classes: UInt8
    """(H, W) train ids, guessed where nobody labelled."""
