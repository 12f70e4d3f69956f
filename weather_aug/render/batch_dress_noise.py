"""World-anchored noise in torch; the look-ups of `edit.physical.noise` and `.noise_rows`."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import torch
from torch import Tensor

from weather_aug.edit.physical.noise import (
    CELL_M,
    COARSE_SHARE,
    COARSER,
    LEVELS,
    TILE_CELLS,
    TURN,
    noise_tile,
)
from weather_aug.edit.physical.noise_rows import FARTHEST_M, FLATTEST_SINE, KNOT_PX, OBLIQUE

COARSER_LEVELS = 4
"""By so many copies the tile is finer at the coarse look, which is 16 times as large."""


@torch.no_grad()
def noise_of_rows(
    depth_m: Tensor,
    is_ground: Tensor,
    rays: tuple[Tensor, Tensor],
    geometry: SimpleNamespace,
    offset_m: float,
) -> Tensor:
    """Noise (R, W) of the places that some rows show, straight between every fourth column.

    Args:
        depth_m: (R, W), `inf` for what is far.
        is_ground: (R, W) bool.
        rays: Tangents (1, W) and (R, 1).
        geometry: `edit.physical.dress.Geometry` of the whole picture, plain.
        offset_m: Of `ground_noise`.
    """
    width = depth_m.shape[1]
    column = torch.arange(width, device=depth_m.device)
    knot = (KNOT_PX * torch.arange((width - 1) // KNOT_PX + 2, device=depth_m.device)).clamp(
        max=width - 1
    )
    x, y, z = rays[0][:, knot], rays[1], depth_m[:, knot]
    known = z < FARTHEST_M
    z = z.clamp(max=FARTHEST_M)
    along = geometry.along_x * x + (geometry.along_y * y + geometry.along_z)
    left = geometry.left_x * x + (geometry.left_y * y + geometry.left_z)
    climb = geometry.climb_x * x + (geometry.climb_y * y + geometry.climb_z)
    sine = (-climb / torch.sqrt(1.0 + y * y + x * x)).clamp(min=FLATTEST_SINE)
    low = is_ground[:, knot]
    slope = torch.where(low, 0.0, OBLIQUE * (geometry.height_0 + z * climb))
    size = z / geometry.fy
    size = torch.where(low, size / sine, KNOT_PX * size)
    along_m = geometry.along_0 + z * along + slope
    left_m = geometry.left_0 + z * left + slope
    noise = ground_noise(along_m.flatten(), left_m.flatten(), size.flatten(), offset_m)
    noise = torch.where(known, noise.view_as(z), 0.5)
    before = column // KNOT_PX
    share = (column - KNOT_PX * before).to(noise.dtype) / KNOT_PX
    return torch.lerp(noise[:, before], noise[:, before + 1], share.expand_as(depth_m))


@torch.no_grad()
def ground_noise(along_m: Tensor, left_m: Tensor, footprint_m: Tensor, offset_m: float) -> Tensor:
    """Noise in [0, 1], evenly spread, of places on the ground; `offset_m` chooses another one.

    Args:
        along_m: (N,) metres along the street.
        left_m: (N,) metres to its left.
        footprint_m: (N,) size of the pixel on the ground: what is smaller is averaged.
        offset_m: Metres at the fine look; at the coarse one it is as many cells.

    Returns:
        (N,), of the places' dtype and device.
    """
    tile = _tile_on(along_m.device)
    per_m = 1.0 / CELL_M
    limits = torch.arange(LEVELS - 1, device=along_m.device).to(along_m.dtype)
    level = torch.bucketize(footprint_m * per_m, 1.5 * torch.exp2(limits), out_int32=True)
    fine = _looked_up(tile, (along_m + offset_m) * per_m, (left_m - offset_m) * per_m, level)
    cosine, sine = TURN
    u, v = cosine * along_m + sine * left_m, cosine * left_m - sine * along_m
    slow, aside = per_m / COARSER, offset_m * per_m
    coarse_level = (level - COARSER_LEVELS).clamp(min=0)
    coarse = _looked_up(tile, u * slow - aside, v * slow + aside, coarse_level)
    return evened(COARSE_SHARE * coarse + (1.0 - COARSE_SHARE) * fine)


@cache
def _tile_on(device: torch.device) -> Tensor:
    """The tile and its smaller copies, uploaded once; torch owns what it may write to."""
    return torch.tensor(noise_tile(), device=device)


def _looked_up(tile: Tensor, u: Tensor, v: Tensor, level: Tensor) -> Tensor:
    """Bilinear values in [0, 1] at (u, v), in cells of level 0, on copies of the tile."""
    size = torch.bitwise_right_shift(torch.full_like(level, TILE_CELLS), level)
    # Level k starts after 4/3 (512^2 - size^2) cells.
    start = (4 * TILE_CELLS**2 - 4 * size * size) // 3
    scale = torch.exp2(-level.to(u.dtype))
    x, y = u * scale - 0.5, v * scale - 0.5
    left, top = x.floor(), y.floor()
    mask = size - 1
    column, row = left.int(), top.int()
    above, below = start + (row & mask) * size, start + ((row + 1) & mask) * size
    near, far = column & mask, (column + 1) & mask
    a, b, c, d = (
        tile.index_select(0, index).to(u.dtype)
        for index in (above + near, above + far, below + near, below + far)
    )
    upper = torch.lerp(a, b, x - left)
    lower = torch.lerp(c, d, x - left)
    return torch.lerp(upper, lower, y - top) / 255.0


def evened(value: Tensor) -> Tensor:
    """Distribution function of the sum of both looks: what makes it evenly spread again."""
    a, b = COARSE_SHARE, 1.0 - COARSE_SHARE
    low = value * value / (2.0 * a * b)
    high = 1.0 - (1.0 - value).square() / (2.0 * a * b)
    middle = (value - 0.5 * b) / a
    return torch.where(value < b, low, torch.where(value > a, high, middle))
