"""Decoding, fog, encoding and labels of a picture in torch; the formulas of `render.shade`.

Differentiable with respect to the picture.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from weather_aug.render.label import (
    DOUBTFUL_TRANSMITTANCE,
    HAZY_TRANSMITTANCE,
    LEAST_TRANSMITTANCE,
    NEIGHBOURHOOD_PX,
)
from weather_aug.taxonomy import IGNORE, SKY


def decoded(image: Tensor, curve: Tensor) -> Tensor:
    """Linear light (3, H, W) of an sRGB picture in [0, 1], by a table (256,) of its levels.

    Between 8-bit levels the table is interpolated; at a level the slope is that of the interval
    above.
    """
    level = image * 255.0
    below = level.detach().floor().clamp(max=254.0)
    index = below.flatten().int()
    dark = curve.index_select(0, index).view_as(level)
    slope = curve.diff().index_select(0, index).view_as(level)
    return torch.addcmul(dark, level - below, slope)


def veiled(light: Tensor, through: Tensor, airlight: Tensor) -> Tensor:
    """Linear light (3, H, W) behind air of transmittance (H, W)."""
    air = airlight[:, None, None]
    return air + through * (light - air)


def encoded(light: Tensor) -> Tensor:
    """Linear light as sRGB, both in [0, 1] (IEC 61966-2-1); the slope is finite everywhere."""
    light = light.clamp(0.0, 1.0)
    power = 1.055 * light.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, power)


def neighbourhood(mask: Tensor) -> Tensor:
    """(H, W) bool: true where the mask is within 7 x 7 pixels."""
    rim = NEIGHBOURHOOD_PX // 2
    grown = functional.pad(mask, (rim, rim, rim, rim))
    for side in (0, 1):
        # Windows of 2, 4 and 7 pixels, each the union of two of the ones before.
        for step in (1, 2, NEIGHBOURHOOD_PX - 4):
            count = grown.shape[side] - step
            grown = grown.narrow(side, 0, count) | grown.narrow(side, step, count)
    return grown


def readable(
    label: Tensor | None, far: Tensor, through: Tensor, distinct: Tensor, covered: Tensor
) -> tuple[Tensor | None, Tensor]:
    """Label for training (H, W) and invalid mask (H, W) uint8, by the rules of `render.label`.

    Args:
        label: (H, W) train ids of the clear picture, or None.
        far: (H, W) bool, where the depth is endless: the sky, where nobody labelled.
        through: (H, W) share of the surface's light that reaches the pixel.
        distinct: (H, W) bool, where it still differs visibly from the airlight.
        covered: (H, W) bool, where a large particle hides the surface.
    """
    surface = ~far if label is None else label != SKY
    near_distinct = neighbourhood(distinct & surface)
    lost = (through < LEAST_TRANSMITTANCE) | ((through < HAZY_TRANSMITTANCE) & ~near_distinct)
    unseen = (surface & lost) | covered
    invalid = (unseen | (surface & (through < DOUBTFUL_TRANSMITTANCE))).to(torch.uint8)
    return None if label is None else label.masked_fill(unseen, IGNORE), invalid
