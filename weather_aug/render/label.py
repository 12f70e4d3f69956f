"""What a label may still claim: pixels whose surface the weather hides become ignore."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
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
    label: UInt8, transmittance: Float32, distinct: UInt8, covered: UInt8
) -> tuple[UInt8, UInt8]:
    """Labels for training and the mask of unreadable pixels.

    Args:
        label: (H, W) train ids of the clear frame.
        transmittance: (H, W) share of the surface's light that reaches the pixel.
        distinct: (H, W), 1 where what is left of a surface's light differs visibly from the
            airlight (by `least_linear_contrast`); 0 on the sky.
        covered: (H, W), 1 where a large particle hides the surface.

    Returns:
        (H, W) train ids with 255 where the surface cannot be detected, and (H, W) uint8 with 1
        where it is undetectable or beyond the optical range (as ACDC's invalid mask). The sky stays
        the sky: it is what the airlight looks like.
    """
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    near_distinct = cv2.dilate(distinct, np.ones(size, np.uint8))
    out, invalid = np.empty_like(label), np.empty_like(label)
    limits = (HAZY_TRANSMITTANCE, DOUBTFUL_TRANSMITTANCE, LEAST_TRANSMITTANCE)
    inputs = (label, transmittance, near_distinct, covered)
    read_labels(
        *(plane.reshape(-1) for plane in inputs),
        tuple(np.float32(limit) for limit in limits),
        np.uint8(IGNORE),
        np.uint8(SKY),
        out.reshape(-1),
        invalid.reshape(-1),
    )
    return out, invalid


def least_linear_contrast(airlight: NDArray[np.floating]) -> float:
    """The least visible difference in linear light, by the slope of the encoding at the airlight.

    Args:
        airlight: (3,) linear RGB.
    """
    luminance = max(float(airlight @ LUMINANCE), 0.0031308)
    slope = 1.055 / 2.4 * luminance ** (1 / 2.4 - 1)
    return LEAST_CONTRAST_LEVELS / 255 / slope


@compiled
def read_labels(label, through, near_distinct, covered, limits, ignore, sky_id, out, invalid):
    """Labels and invalid mask by the rules of `readable_labels`; all arrays are (N,).

    Args:
        label: uint8 train ids.
        through: float32 transmittance.
        near_distinct: uint8, 1 where something distinct is near.
        covered: uint8.
        limits: Transmittances below which a surface is hazy, doubtful, hidden.
        ignore: Id of what cannot be seen.
        sky_id: Id of the sky.
        out: uint8 out.
        invalid: uint8 out.
    """
    hazy, doubtful, hidden = limits
    for i in range(label.shape[0]):
        t = through[i]
        surface = label[i] != sky_id
        unseen = surface & ((t < hidden) | ((t < hazy) & (near_distinct[i] == 0)))
        unseen = unseen | (covered[i] != 0)
        out[i] = ignore if unseen else label[i]
        invalid[i] = np.uint8(1) if unseen | (surface & (t < doubtful)) else np.uint8(0)
