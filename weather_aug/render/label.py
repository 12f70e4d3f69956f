"""What a label may still claim: pixels whose surface the weather hides become ignore.

Everything is read off the recorded label, the geometry and what the renderer knows of its light;
nothing is ever read off the edited picture.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.colour import LUMINANCE
from weather_aug.taxonomy import IGNORE, SKY, TRAIN_ID

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
LabelPolicy = Literal["ignore_unseen", "keep", "acdc"]

LEAST_TRANSMITTANCE = 0.02
"""Less than this of a surface's light reaches the pixel: nobody can name it."""
DOUBTFUL_TRANSMITTANCE = 0.05
"""The surface is beyond the meteorological optical range."""
LEAST_CONTRAST_LEVELS = 2.5
"""Largest difference within 7 x 7 pixels, in sRGB levels, that still cannot be seen."""
NEIGHBOURHOOD_PX = 7
MARGIN_PX = 2 * (NEIGHBOURHOOD_PX // 2)
"""How far around a pixel its label depends on light: the sky on surfaces within 3 pixels, and
those on what is distinct within 3 more."""
HAZY_TRANSMITTANCE = 0.5
"""Above it a surface of the airlight's own colour counts as seen: the air is clear enough."""
MOVING = tuple(
    TRAIN_ID[name]
    for name in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
)
"""What a picture of the same place in clear weather, taken another day, does not show."""


class Sight(NamedTuple):
    """What can be seen of the surfaces."""

    unseen: UInt8
    """(H, W), 1 where the surface cannot be detected."""
    invalid: UInt8
    """(H, W), 1 there and where it is doubtful, as ACDC's mask."""


def readable_labels(
    label: UInt8,
    air: Float32,
    transmittance: Float32,
    distinct: UInt8,
    covered: UInt8,
    small: UInt8 | None = None,
) -> Sight:
    """Where surfaces can be seen through air, particles and glass.

    The sky stays the sky, because it is what the airlight looks like; only where what stood at the
    horizon has vanished, nobody can say where the sky began: within 3 pixels it is invalid. What
    nobody labelled stands nowhere: its depth is often unknown, so it seems to vanish in any air.

    Args:
        label: (H, W) train ids of the clear frame.
        air: (H, W) share of the surface's light that comes through air and particles.
        transmittance: (H, W) the same through the glass as well.
        distinct: (H, W), 1 where what is left of a surface's light differs visibly from the
            airlight (by `least_linear_contrast`); 0 on the sky.
        covered: (H, W), 1 where a large particle or what is on the glass hides the surface.
        small: (H, W), 1 where a thing is so small that beyond the optical range it is invalid; if
            None, all are.

    Source:
        docs/physics.md, labels: 2.5 levels of contrast within 7 x 7 pixels, 2 % of the light; ACDC
        (Sakaridis et al. 2021) for the invalid mask.
    """
    near = np.ones((NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX), np.uint8)
    limits = (HAZY_TRANSMITTANCE, DOUBTFUL_TRANSMITTANCE, LEAST_TRANSMITTANCE)
    if small is None:
        small = np.ones_like(label)
    unseen, invalid, gone = (np.empty(label.shape, np.uint8) for _ in range(3))
    inputs = (label, air, transmittance, cv2.dilate(distinct, near), covered, small)
    count = read_labels(
        *(np.ascontiguousarray(plane).reshape(-1) for plane in inputs),
        tuple(np.float32(limit) for limit in limits),
        *(plane.reshape(-1) for plane in (unseen, invalid, gone)),
    )
    if count:
        invalid |= cv2.dilate(gone, near) & (label == SKY)
    return Sight(unseen, invalid)


def kept_labels(label: UInt8, unseen: UInt8, policy: LabelPolicy) -> UInt8:
    """Train ids (H, W) for training: what becomes of a label whose surface cannot be seen.

    Args:
        label: (H, W) train ids of the clear frame.
        unseen: (H, W), 1 where the surface cannot be seen.
        policy: See `RenderOptions.labels`.
    """
    lost = np.arange(256, dtype=np.uint8)
    if policy == "ignore_unseen":
        lost[:] = IGNORE
    elif policy == "acdc":
        lost[list(MOVING)] = IGNORE
    return np.where(unseen != 0, cv2.LUT(label, lost), label)


def least_linear_contrast(airlight: NDArray[np.floating]) -> float:
    """The least visible difference in linear light, by the slope of the encoding at the airlight.

    Args:
        airlight: (3,) linear RGB.
    """
    luminance = max(float(airlight @ LUMINANCE), 0.0031308)
    slope = 1.055 / 2.4 * luminance ** (1 / 2.4 - 1)
    return LEAST_CONTRAST_LEVELS / 255 / slope


@compiled
def read_labels(label, air, through, near_distinct, covered, small, limits, unseen, invalid, gone):
    """What cannot be seen or is doubtful, by `readable_labels`; all arrays are (N,).

    Args:
        label: uint8 train ids.
        air: float32 transmittance of air and particles.
        through: float32 transmittance of air, particles and glass.
        near_distinct: uint8, 1 where something distinct is near.
        covered: uint8, 1 where the surface is hidden.
        small: uint8, 1 where a thing beyond the optical range is invalid.
        limits: Transmittances below which a surface is hazy, doubtful, hidden.
        unseen: uint8 out, 1 where a surface is hidden or cannot be told from the air.
        invalid: uint8 out, 1 there and where a small surface is beyond the optical range.
        gone: uint8 out, 1 where a surface that somebody labelled cannot be told from the air.

    Returns:
        Number of surfaces that are gone.
    """
    hazy, doubt, hidden = limits
    count = np.int64(0)
    for i in range(label.shape[0]):
        t = through[i]
        surface = label[i] != np.uint8(SKY)
        lost = surface & ((t < hidden) | ((air[i] < hazy) & (near_distinct[i] == 0)))
        doubtful = np.uint8(1) if surface & (t < doubt) else np.uint8(0)
        blind = np.uint8((np.uint8(1) if lost else np.uint8(0)) | covered[i])
        unseen[i] = blind
        invalid[i] = np.uint8(blind | np.uint8(doubtful & small[i]))
        known = lost & (label[i] != np.uint8(IGNORE))
        gone[i] = np.uint8(1) if known else np.uint8(0)
        count += np.int64(1) if known else np.int64(0)
    return count
