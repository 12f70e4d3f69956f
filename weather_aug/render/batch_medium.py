"""How much light the air lets through, in torch; the formulas of `weather_aug.render.medium`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from weather_aug.clip.types import Camera
from weather_aug.render.medium import FAR_DEPTH_M

LAYER_M = 1000.0
"""Height of the layer of weather: a ray to the sky ends at its top."""
LONGEST_M = 20_000.0
FLATTEST_SINE = 0.05
THICKEST = 60.0
"""Optical depth beyond which no light is left in any number format."""


@dataclass(frozen=True, eq=False)
class AirColumn:
    """What is between a camera and its surfaces; extinctions in 1/m."""

    fog_per_m: float
    inverse_height_per_m: float
    haze_per_m: float
    precipitation_per_m: float
    resolved_depth: Tensor
    """(K + 1,) optical depth that drawn particles carry, on the axis, up to k steps of depth."""
    resolved_step_m: float
    up_camera: tuple[float, float, float]
    """Unit vector against gravity, camera axes."""

    def optical_depth(self, z_m: Tensor, ray_x: Tensor, ray_y: Tensor) -> Tensor:
        """Optical depth from the camera to depth `z_m` along the rays (ray_x, ray_y, 1).

        Args:
            z_m: Depth along the axis, metres; `inf` is the sky.
            ray_x: Tangents x / z, of a shape that fits `z_m`.
            ray_y: Tangents y / z.

        Returns:
            A tensor of the common shape, in [0, 60].

        Source:
            Exponential fog in closed form; a ray to the sky ends at the top of a layer of 1 km.
        """
        up_x, up_y, up_z = self.up_camera
        slant = torch.sqrt(1.0 + ray_x * ray_x + ray_y * ray_y)
        rise = up_x * ray_x + up_y * ray_y + up_z
        sine = (rise / slant).clamp(min=FLATTEST_SINE)
        beyond_m = (LAYER_M / sine).clamp(max=LONGEST_M)
        z_m = torch.where(z_m >= FAR_DEPTH_M, beyond_m / slant, z_m)
        tau = (self.fog_per_m * self._share(z_m * rise) + self.haze_per_m) * z_m * slant
        if self.precipitation_per_m > 0.0:
            last = self.resolved_depth.shape[0] - 1
            step = (z_m / self.resolved_step_m).clamp(max=last).long()
            rest = self.precipitation_per_m * z_m - self.resolved_depth.to(z_m.dtype)[step]
            tau = tau + rest.clamp(min=0.0) * slant
        return tau.clamp(max=THICKEST)

    def _share(self, rise_m: Tensor) -> Tensor:
        """Mean density of the fog on the way up by `rise_m`, as a share of that at the camera."""
        heights = (rise_m * self.inverse_height_per_m).clamp(min=-8.0)
        level = heights == 0.0
        away = torch.where(level, torch.ones_like(heights), heights)
        return torch.where(level, torch.ones_like(heights), -torch.expm1(-away) / away)


def pixel_rays(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Tangents (1, W) and (H, 1) of the camera's pixel centres, in the dtype of `like`."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    columns = torch.arange(camera.width, dtype=like.dtype, device=like.device)
    rows = torch.arange(camera.height, dtype=like.dtype, device=like.device)
    return ((columns - cx) / fx)[None, :], ((rows - cy) / fy)[:, None]
