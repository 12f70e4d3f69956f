"""What the editor knows of a frame before it knows the weather: maps on the small grid.

They depend on the picture and its geometry alone, so a scene stores them beside the picture and
every weather of it is a function of them, pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical import settling
from weather_aug.edit.physical.site import Site
from weather_aug.taxonomy import ROAD, SKY

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

    step: float
    maps: NDArray[np.float16]
    """(16, h, w), in the order of `NAMES`."""
    plane: Float64
    """(3,) of the road: up = plane[0] + plane[1] along + plane[2] left, street axes."""
    classes: UInt8
    """(H, W) train ids, guessed where nobody labelled."""

    @cached_property
    def illumination(self) -> float:
        """Luminance of a white surface in the recorded street, linear light."""
        return float(np.median(self.maps[ILLUMINATION]))


def layers_of(site: Site, path: Float64 | None = None) -> Layers:
    """Look at a frame's surfaces.

    Args:
        site: The frame.
        path: (P, 2) places of the camera in the order driven, street axes (along, left); None where
            nobody knows: the way then goes straight ahead.
    """
    maps = np.zeros((len(NAMES), *site.shape), np.float32)
    luminance = (site.light @ LUMINANCE).astype(np.float32)
    maps[MATTE_OFFSET] = site.small_classes == SKY
    road = luminance[site.small_classes == ROAD]
    maps[ILLUMINATION] = np.median(road) / 0.12 if len(road) else 1.0
    maps[LUMINANCE_MEAN] = cv2.blur(luminance, (9, 9))
    maps[FACING_UP] = settling.facing_up(site)
    maps[LATERAL_M] = settling.lateral_m(site, path)
    # TODO: mirror
    above = np.where(np.isfinite(site.depth_m)[..., None], site.light, 0)
    sky = (~np.isfinite(site.depth_m)).astype(np.float32)
    h = len(sky)
    idx = np.clip(2 * int(h * 0.47) - np.arange(h), 0, h - 1)
    for base, s, k in ((SHARP, SHARP_SKY, (1, 5)), (ROUGH, ROUGH_SKY, (3, 31))):
        for c in range(3):
            maps[base + c] = cv2.blur(above[idx][..., c].astype(np.float32), k)
        maps[s] = cv2.blur(sky[idx], k)
    stack = maps.astype(np.float16)
    stack.flags.writeable = False
    return Layers(float(site.step), stack, site.plane, site.classes)
