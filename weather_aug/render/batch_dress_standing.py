"""Water and snow on what stands, in torch; the formulas of `edit.physical.standing_rows`.

Differentiable with respect to the light.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor

from weather_aug.edit.physical.layers import ILLUMINATION
from weather_aug.edit.physical.materials import BURIED, CAP_M, COVER, LEAF, LEVEL, POROSITY
from weather_aug.edit.physical.standing_rows import (
    BURIED_RANGE_M,
    GRAIN_NOISE,
    LEAF_SOFTNESS,
    NO_CAP_M,
)
from weather_aug.render.batch_dress_grid import Grid, Pixels
from weather_aug.render.batch_dress_ground import covered, film, laid, luminance, ramp, snow_light

ONE = 2.0**32
"""Fixed point of depths over focal lengths: holds the sum of 30,000 rows of 60 km."""


@torch.no_grad()
def below_top_m(classes: Tensor, depth_m: Tensor, fy: float) -> Tensor:
    """How far each pixel (H, W) lies below the upper edge of its own thing, metres.

    A thing is a run down a column of one class without a jump of depth; it has an upper edge where
    what is above it lies behind it. Without one it is endlessly far below, as `NO_CAP_M`.

    Args:
        classes: (H, W) uint8 train ids.
        depth_m: (H, W), `inf` for what is far.
        fy: Focal length, pixels.
    """
    depth = depth_m.double()
    above = torch.nn.functional.pad(depth, (0, 0, 1, 0))[:-1]
    class_above = torch.nn.functional.pad(classes, (0, 0, 1, 0), value=255)[:-1]
    same = (classes == class_above) & ((depth - above).abs() < 1.5 + 0.2 * depth)
    fresh = torch.where(above > 1.05 * depth + 0.3, 0.0, NO_CAP_M).to(depth.dtype)
    # The sum of steps down to here, less that down to where the run began. In fixed point, because
    # CUDA promises equal bits for running sums of integers only.
    step = torch.where(same, depth / fy, 0.0)
    sunk = (step * ONE).round().long().cumsum(0)
    row = torch.arange(len(depth), device=depth.device)[:, None]
    began = torch.where(same, 0, row).cummax(0).values
    below = (sunk - sunk.gather(0, began)).to(depth.dtype) / ONE + fresh.gather(0, began)
    return below.to(depth_m.dtype)


def holds_snow(material: Tensor) -> Tensor:
    """(N,) bool, whether snow lies on some part of such a thing."""
    return ((material[:, CAP_M] > 0) | (material[:, LEAF] > 0)) & (material[:, COVER] > 0)


def wet_standing(light: Tensor, pixels: Pixels, grid: Grid, look: SimpleNamespace) -> Tensor:
    """Light (3, N) of wet walls, trunks and clothes."""
    (lit,) = grid.at(ILLUMINATION, 1, pixels)
    white = look.exposure * lit.clamp(min=0.02)
    return film(light, white, look.film * pixels.material[:, POROSITY])


def snowed_standing(
    light: Tensor,
    pixels: Pixels,
    below_m: Tensor,
    grid: Grid,
    geometry: SimpleNamespace,
    look: SimpleNamespace,
) -> Tensor:
    """Snow on upper edges, level parts and leaves and around the foot.

    Args:
        light: (3, N) linear light.
        pixels: That hold snow.
        below_m: (N,) of `below_top_m`.
        grid: The editor's maps under the weather's light.
        geometry: `edit.physical.dress.Geometry` of the whole picture, plain.
        look: `edit.physical.look.Look` of the weather, plain.

    Returns:
        (3, N).
    """
    z, material, noise = pixels.depth_m, pixels.material, pixels.noise
    lit, mean, facing_up = grid.at(ILLUMINATION, 3, pixels)
    climb = pixels.towards(geometry.climb_x, geometry.climb_y, geometry.climb_z)
    # Endless depth times a level view would be no number.
    height_m = geometry.height_0 + z.clamp(max=BURIED_RANGE_M) * climb
    height_m = torch.where(z < BURIED_RANGE_M, height_m, NO_CAP_M)
    size_m = (z / geometry.fy).clamp(max=1.0)
    lit = lit.clamp(min=0.02)
    amount = look.snow * material[:, COVER]
    leaf = material[:, LEAF] > 0
    brightness = luminance(light) / (mean.clamp(min=0.002) * look.exposure)
    cover = torch.where(
        leaf,
        _on_leaves(brightness, amount, noise),
        _on_edges(below_m, facing_up, amount, size_m, noise, material, look),
    )
    buried_m = look.snow_depth_m * (0.6 + 0.8 * noise)
    lies = 1.0 - ramp(0.7 * buried_m, 1.1 * buried_m + 1e-6, height_m)
    foot = look.snow * material[:, BURIED] * lies
    bright = snow_light(lit, look) * (0.81 + 0.11 * noise)
    shaded = torch.where(leaf, (0.25 + 4.0 * mean / lit).clamp(max=0.85), 1.0)
    return laid(light, torch.maximum(cover, foot), bright * shaded, look)


def _on_leaves(brightness: Tensor, amount: Tensor, noise: Tensor) -> Tensor:
    """Cover of a crown, the bright parts first; `brightness` is over the mean around it."""
    detail = (0.5 + 0.7 * (brightness - 1.0)).clamp(0.0, 1.0)
    return covered(0.8 * amount, LEAF_SOFTNESS, detail + GRAIN_NOISE * (noise - detail))


def _on_edges(
    below_m: Tensor,
    facing_up: Tensor,
    amount: Tensor,
    size_m: Tensor,
    noise: Tensor,
    material: Tensor,
    look: SimpleNamespace,
) -> Tensor:
    """Cover of a cap on the upper edge and of level parts."""
    edge_m = look.snow * material[:, CAP_M] * (0.6 + 0.8 * noise) + 0.4 * look.snow_depth_m
    cap = ((edge_m - below_m) / size_m.clamp(min=1e-5)).clamp(0.0, 1.0)
    level = ramp(0.55, 0.85, facing_up)
    lies = covered(amount * level, 0.07 + 0.25 * size_m, noise)
    return torch.where(material[:, LEVEL] > 0, torch.maximum(cap, lies), cap)
