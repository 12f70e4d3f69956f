"""What a label may still claim: pixels whose surface the weather hides become ignore."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.colour import LUMINANCE
from weather_aug.taxonomy import IGNORE, SKY

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

LEAST_TRANSMITTANCE = 0.02
"""Less than this of a surface's light reaches the pixel: nobody can name it."""
DOUBTFUL_TRANSMITTANCE = 0.05
"""The surface is beyond the meteorological optical range."""
LEAST_CONTRAST_LEVELS = 2.5
"""Largest difference within 7 x 7 pixels, in sRGB levels, that still cannot be seen."""
NEIGHBOURHOOD_PX = 7
HAZY_TRANSMITTANCE = 0.5
"""Above it a surface of the airlight's own colour counts as seen: the air is clear enough."""


def readable_labels(
    label: UInt8,
    transmittance: Float32,
    gap: Float32,
    covered: UInt8,
    airlight: NDArray[np.floating],
) -> tuple[UInt8, UInt8]:
    """Labels for training and the mask of unreadable pixels.

    Args:
        label: (H, W) train ids of the clear frame.
        transmittance: (H, W) share of the surface's light that reaches the pixel.
        gap: (H, W) largest linear difference of a surface from the airlight.
        covered: (H, W), 1 where a large particle hides the surface.
        airlight: (3,) linear RGB.

    Returns:
        (H, W) train ids with 255 where the surface cannot be detected, and (H, W) uint8 with 1
        where it is undetectable or beyond the optical range (as ACDC's invalid mask). The sky stays
        the sky: it is what the airlight looks like.
    """
    out = label.copy()
    invalid = covered.copy()
    out[covered > 0] = IGNORE
    if transmittance.size == 0 or transmittance.min() >= HAZY_TRANSMITTANCE:
        return out, invalid
    surface = label != SKY
    distinct = surface & (transmittance * gap >= _least_linear_contrast(airlight))
    near_distinct = cv2.dilate(
        distinct.view(np.uint8), np.ones((NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), np.uint8)
    )
    hidden = (transmittance < HAZY_TRANSMITTANCE) & (near_distinct == 0)
    hidden |= transmittance < LEAST_TRANSMITTANCE
    hidden &= surface
    out[hidden] = IGNORE
    invalid[hidden | (surface & (transmittance < DOUBTFUL_TRANSMITTANCE))] = 1
    return out, invalid


def _least_linear_contrast(airlight: NDArray[np.floating]) -> float:
    """The sRGB threshold as linear light, by the slope of the encoding at the airlight."""
    luminance = max(float(airlight @ LUMINANCE), 0.0031308)
    slope = 1.055 / 2.4 * luminance ** (1 / 2.4 - 1)
    return LEAST_CONTRAST_LEVELS / 255 / slope
