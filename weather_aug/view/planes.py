"""The planes of a rendered frame as small pictures to look at."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError
from weather_aug.render.compose import RenderedFrame
from weather_aug.taxonomy import coloured
from weather_aug.view.sheet import transmittance_picture

UInt8 = NDArray[np.uint8]

PLANES = ("image", "label", "overlay", "transmittance")
"""The picture; the label in the colours of Cityscapes, black where it is ignored; both at half
strength; the share of light that comes through, dark where it is small."""


def painted(shot: RenderedFrame, plane: str, max_width: int) -> UInt8:
    """One of `PLANES`, (H, W, 3), in proportion and at most `max_width` pixels wide.

    Raises:
        ArgumentError: If nobody labelled what shall be shown as a label.
    """
    if plane == "image":
        return _shrunk(shot.image, max_width)
    if plane == "transmittance":
        return _shrunk(transmittance_picture(shot.transmittance), max_width)
    if shot.label is None:
        raise ArgumentError(
            f"there is no label to show as {plane}: nobody labelled this frame, or the mask's ids "
            "are no known classes"
        )
    # Colours between those of two classes would be a third one's.
    label = coloured(_shrunk(shot.label, max_width, cv2.INTER_NEAREST))
    if plane == "label":
        return label
    mixed: UInt8 = cv2.addWeighted(_shrunk(shot.image, max_width), 0.5, label, 0.5, 0)
    return mixed


def _shrunk(image: UInt8, max_width: int, way: int = cv2.INTER_AREA) -> UInt8:
    height, width = image.shape[:2]
    if width <= max_width:
        return image
    small: UInt8 = cv2.resize(
        image, (max_width, max(1, round(height * max_width / width))), interpolation=way
    )
    return small
