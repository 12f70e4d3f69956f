"""The tiny street as a batch of tensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tiny_clip import TinyClip
from torch import Tensor

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.scene.policy import WeatherPolicy

HEIGHT, WIDTH = 16, 24
SNOW = WeatherPolicy.snow((2.0, 4.0))
RAIN = WeatherPolicy.rain((40.0, 75.0))
FOG = WeatherPolicy.fog((20.0, 40.0))
MIXED = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.5, 1.0))

_FRAME = TinyClip(width=WIDTH, height=HEIGHT).frame(FrameKey(0, "front"))


def pictures(count: int = 3, dtype: torch.dtype = torch.float32) -> Tensor:
    """(B, 3, 16, 24), all the same, so that what differs is the weather."""
    one = torch.from_numpy(_FRAME.image.copy()).permute(2, 0, 1).to(dtype) / 255
    return one.repeat(count, 1, 1, 1)


def masks(count: int = 3, dtype: torch.dtype = torch.int64) -> Tensor:
    """(B, 1, 16, 24) train ids."""
    return torch.from_numpy(_FRAME.label.copy()).to(dtype).repeat(count, 1, 1, 1)


def depths(count: int = 3) -> Tensor:
    """(B, 1, 16, 24) float32 metres."""
    return torch.from_numpy(_FRAME.depth_m.copy()).repeat(count, 1, 1, 1)


def camera() -> Camera:
    """The street's own, which looks elsewhere than the default one."""
    return _FRAME.camera


def psnr(found: NDArray[np.floating], expected: NDArray[np.floating]) -> float:
    """Decibels between two pictures in [0, 1]."""
    error = float(np.mean((np.asarray(found, float) - np.asarray(expected, float)) ** 2))
    return float("inf") if error == 0 else -10 * float(np.log10(error))
