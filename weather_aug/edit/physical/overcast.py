"""What a closed cloud deck does to the colours of a recorded picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug.colour import LUMINANCE, SRGB_LEVELS_LINEAR

Float64 = NDArray[np.float64]

MIDDLE_GREY = 0.18
CONTRAST_LOSS = 0.18
SATURATION_LOSS = 0.28
ZENITH_GAIN = 0.6
"""An overcast sky is 1 + this times as bright overhead as at the horizon, where it has the
airlight's colour; less than the CIE's 3, because the camera exposes for the street and clips."""
MEAN_SKY_GAIN = 1.0 + 0.5 * ZENITH_GAIN
"""Its mean over the hemisphere: the mean sine of elevation is one half."""


def tone(overcast: float) -> tuple[Float64, Float64]:
    """How an overcast sky changes recorded colours.

    Contrast falls by a sixth about middle grey, saturation by a quarter, the white turns from
    6500 K to about 7200 K; the auto-exposure hides most of the lost light.

    Args:
        overcast: In [0, 1]; 0 changes nothing.

    Returns:
        Linear light (256,) of each sRGB level after the change of contrast and exposure, and the
        colour matrix (3, 3) to apply after it.
    """
    light = SRGB_LEVELS_LINEAR
    contrast = 1.0 - CONTRAST_LOSS * overcast
    gain = 1.0 - 0.15 * overcast * (1.0 - 0.8)
    curve = gain * MIDDLE_GREY * (light / MIDDLE_GREY) ** contrast if overcast else light
    saturation = 1.0 - SATURATION_LOSS * overcast
    grey = np.broadcast_to(LUMINANCE, (3, 3))
    white = 1.0 + overcast * (np.array([0.96, 1.00, 1.05]) - 1.0)
    matrix = white[:, None] * (saturation * np.eye(3) + (1.0 - saturation) * grey)
    return np.minimum(curve, 1.0), matrix
