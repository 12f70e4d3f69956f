"""Decoding, fog and encoding of a picture in torch; the formulas of `render.shade`.

Differentiable with respect to the picture.
"""

from __future__ import annotations

import torch
from torch import Tensor


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
