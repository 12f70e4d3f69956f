"""How much light the air lets through, in torch; the formulas of `weather_aug.render.medium`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.clip.types import FAR_DEPTH_M, Camera
from weather_aug.render.medium import (
    FLATTEST_SINE,
    LAYER_M,
    LONGEST_M,
    LOWEST_HEIGHTS,
    SPRAY_HEIGHT_M,
    THICKEST,
    Medium,
    Optics,
)


@dataclass(frozen=True, eq=False)
class AirColumn:
    """What is between a camera and its surfaces; extinctions in 1/m."""

    fog_per_m: float
    inverse_height_per_m: float
    haze_per_m: float
    precipitation_per_m: float
    resolved_step_m: float
    spray_per_m: float
    """At the road's surface."""
    camera_heights: float
    """Height of the camera over the road, in scale heights of the spray."""
    resolved_depth: Tensor
    """(K + 1,) optical depth that drawn particles carry, on the axis, up to k steps of depth."""
    up_camera: tuple[float, float, float]
    """Unit vector against gravity, camera axes."""

    @classmethod
    def of(
        cls, medium: Medium, optics: Optics, carried: NDArray[np.float32], like: Tensor
    ) -> AirColumn:
        """The same air as the kernels know it, on the device of `like`."""
        return cls(
            **{name: float(value) for name, value in medium._asdict().items()},
            resolved_depth=torch.from_numpy(carried).to(like.device),
            up_camera=(float(optics.up_x), float(optics.up_y), float(optics.up_z)),
        )

    def reach_m(self, z_m: Tensor, ray_x: Tensor, ray_y: Tensor) -> Tensor:
        """Depth at which the air ends: at the surface, for the sky at the top of its layer.

        Args:
            z_m: Depth along the axis, metres; `inf` is the sky.
            ray_x: Tangents x / z, of a shape that fits `z_m`.
            ray_y: Tangents y / z.
        """
        slant, rise = self._slant(ray_x, ray_y), self._rise(ray_x, ray_y)
        beyond_m = (LAYER_M / (rise / slant).clamp(min=FLATTEST_SINE)).clamp(max=LONGEST_M)
        return torch.where(z_m >= FAR_DEPTH_M, beyond_m / slant, z_m)

    def optical_depth(
        self, z_m: Tensor, ray_x: Tensor, ray_y: Tensor, fog_share: Tensor | None = None
    ) -> Tensor:
        """Optical depth from the camera to a finite depth `z_m` along the rays (ray_x, ray_y, 1).

        Args:
            z_m: Depth along the axis, metres.
            ray_x: Tangents x / z, of a shape that fits `z_m`.
            ray_y: Tangents y / z.
            fog_share: Uneven fog's optical depth over that of even fog; 1 if None.

        Returns:
            A tensor of the common shape, in [0, 60].

        Source:
            Fog and spray that thin exponentially with height, in closed form.
        """
        slant, rise = self._slant(ray_x, ray_y), self._rise(ray_x, ray_y)
        tau = self.fog_per_m * z_m
        if self.inverse_height_per_m > 0.0:
            tau = tau * layer_share(z_m * rise * self.inverse_height_per_m)
        if fog_share is not None:
            tau = tau * fog_share
        tau = tau + self.haze_per_m * z_m
        if self.spray_per_m > 0.0:
            spray = spray_share(z_m * rise / SPRAY_HEIGHT_M, self.camera_heights)
            tau = tau + self.spray_per_m * spray * z_m
        if self.precipitation_per_m > 0.0:
            last = self.resolved_depth.shape[0] - 1
            step = (z_m / self.resolved_step_m + 0.5).clamp(max=last).long()
            rest = self.precipitation_per_m * z_m - self.resolved_depth.to(z_m.dtype)[step]
            tau = tau + rest.clamp(min=0.0)
        return (tau * slant).clamp(max=THICKEST)

    def _slant(self, ray_x: Tensor, ray_y: Tensor) -> Tensor:
        """Length of the rays per metre of depth."""
        return torch.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)

    def _rise(self, ray_x: Tensor, ray_y: Tensor) -> Tensor:
        """Climb of the rays per metre of depth."""
        up_x, up_y, up_z = self.up_camera
        return up_x * ray_x + up_y * ray_y + up_z


def layer_share(heights: Tensor) -> Tensor:
    """Mean of exp(-h) along a ray that climbs by `heights` scale heights, (1 - exp(-h)) / h."""
    heights = heights.clamp(min=LOWEST_HEIGHTS)
    level = heights == 0.0
    away = heights.masked_fill(level, 1.0)
    return (-torch.expm1(-away) / away).masked_fill(level, 1.0)


def spray_share(heights: Tensor, camera_heights: float) -> Tensor:
    """Mean density along a ray that climbs by `heights` scale heights, over that at the road.

    There is none below the road's plane; see `medium.spray_share`.
    """
    above = math.exp(-camera_heights) * layer_share(heights.clamp(min=-camera_heights))
    share = -camera_heights / heights.clamp(max=-0.01)
    return above * share.masked_fill(heights >= -camera_heights, 1.0)


def pixel_rays(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Tangents (1, W) and (H, 1) of the camera's pixel centres, in the dtype of `like`."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    columns = torch.arange(camera.width, dtype=like.dtype, device=like.device)
    rows = torch.arange(camera.height, dtype=like.dtype, device=like.device)
    return ((columns - cx) / fx)[None, :], ((rows - cy) / fy)[:, None]
