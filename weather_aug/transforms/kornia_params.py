"""Draws and cameras of a batch as rows of tensors, because kornia's parameters are tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError
from weather_aug.transforms.picture import Drawn
from weather_aug.weather import Weather

Params = dict[str, Tensor]

_WEATHER = tuple(each.name for each in fields(Weather))
_CAMERA = {
    "intrinsics": (3, 3),
    "world_from_camera": (4, 4),
    "exposure_s": (),
    "aperture_m": (),
    "velocity_m_per_s": (3,),
    "angular_velocity_rad_per_s": (3,),
}
_CAMERA_NUMBERS = 33


def drawn_rows(drawn: Sequence[Drawn]) -> Params:
    """What was drawn for B pictures.

    Returns:
        `weather` (B, F) float64, the fields of `Weather` in their order, wind as three of them;
        `seed` (B,) int64; `speed_m_per_s` (B,) float64.
    """
    weathers = [
        np.hstack([getattr(each.weather, name) for name in _WEATHER]).tolist() for each in drawn
    ]
    return {
        "weather": torch.tensor(weathers, dtype=torch.float64),
        "seed": torch.tensor([each.seed for each in drawn], dtype=torch.int64),
        "speed_m_per_s": torch.tensor([each.speed_m_per_s for each in drawn], dtype=torch.float64),
    }


def drawn_of(params: Params, row: int) -> Drawn:
    """One picture's draw: the inverse of `drawn_rows`, to the bit."""
    numbers = iter(params["weather"][row].tolist())
    weather: dict[str, Any] = {
        name: tuple(next(numbers) for _ in range(3)) if name == "wind_m_per_s" else next(numbers)
        for name in _WEATHER
    }
    return Drawn(Weather(**weather), int(params["seed"][row]), float(params["speed_m_per_s"][row]))


def camera_rows(cameras: Sequence[Camera | None]) -> Tensor:
    """(B, 33) float64: all of B cameras but their size; NaN where there is none."""
    rows = [
        np.full(_CAMERA_NUMBERS, np.nan)
        if camera is None
        else np.hstack([np.ravel(getattr(camera, name)) for name in _CAMERA])
        for camera in cameras
    ]
    return torch.from_numpy(np.array(rows, np.float64).reshape(-1, _CAMERA_NUMBERS))


def camera_of(params: Params, row: int, shape: tuple[int, int]) -> Camera | None:
    """One picture's camera of (H, W) pixels, or None: the inverse of `camera_rows`."""
    if "camera" not in params or bool(params["camera"][row].isnan().any()):
        return None
    numbers = params["camera"][row].cpu().numpy()
    values: dict[str, Any] = {}
    for name, form in _CAMERA.items():
        count = math.prod(form)
        values[name] = numbers[:count].reshape(form) if form else float(numbers[0])
        numbers = numbers[count:]
    return Camera(width=shape[1], height=shape[0], **values)


def check_params(params: Params, count: int) -> None:
    """Refuse what is not drawn for `count` pictures; where there is no gate all get through.

    Raises:
        ArgumentError: If it is not.
    """
    if "weather" not in params or len(params["weather"]) != count:
        raise ArgumentError(
            f"params must hold what was drawn for {count} pictures: take them of a call "
            "(_params) or of forward_parameters"
        )
    params.setdefault("batch_prob", torch.ones(count))
