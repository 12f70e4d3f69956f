"""Rings that drops draw on the water of a road, in torch; those of `edit.physical.ripples`."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from weather_aug.edit.physical.ripples import (
    CELL_M,
    COARSEST_M,
    LIFE_S,
    ON_FILM,
    ON_POOL,
    SPEED_M_PER_S,
    WAVE_M,
)
from weather_aug.render.batch_dress_grid import Pixels

WORD = 0xFFFFFFFF
"""Words of 32 bits in tensors of 64: torch multiplies no unsigned numbers."""


@torch.no_grad()
def rippled(
    shown: Tensor,
    pool: Tensor,
    size_m: Tensor,
    pixels: Pixels,
    geometry: SimpleNamespace,
    look: SimpleNamespace,
) -> Tensor:
    """What is mirrored (6, N), modulated by rings where pixels are small enough to show them.

    Args:
        shown: (6, N) what calm water and what a film mirrors.
        pool: (N,) standing water, in [0, 1].
        size_m: (N,) of the pixels on the road.
        pixels: Of the ground.
        geometry: `edit.physical.dress.Geometry` of the whole picture, plain.
        look: `edit.physical.look.Look` of the weather, plain.
    """
    near = torch.nonzero(size_m < COARSEST_M)[:, 0]
    if len(near) == 0:
        return shown
    mine, pool, size_m = pixels.at(near), pool[near], size_m[near]
    z = mine.depth_m
    along = mine.towards(geometry.along_x, geometry.along_y, geometry.along_z)
    left = mine.towards(geometry.left_x, geometry.left_y, geometry.left_z)
    wave = rings(geometry.along_0 + z * along, geometry.left_0 + z * left, look)
    wave = wave * (1.0 - size_m / COARSEST_M)
    deep = ON_FILM + pool * (ON_POOL - ON_FILM)
    change = (1.0 + deep * wave).clamp(min=0.0)
    return shown.index_copy(1, near, shown.index_select(1, near) * change)


def rings(along_m: Tensor, left_m: Tensor, look: SimpleNamespace) -> Tensor:
    """Height of the rings at places (N,), in [-1, 1]; each cell has its own beat."""
    i, j = torch.floor(along_m * (1.0 / CELL_M)), torch.floor(left_m * (1.0 / CELL_M))
    row, column = i.long() & WORD, j.long() & WORD
    # As the kernel rounds it: after an hour a double's beat would be another one.
    beats = float(np.float32(look.time_s) * np.float32(1.0 / LIFE_S))
    beat = beats + _unit(_hashed(row, column, torch.zeros_like(row)), along_m.dtype)
    whole = torch.floor(beat)
    age = beat - whole
    word = _hashed(row, column, whole.long() & WORD)
    falls = _unit(word, along_m.dtype) < look.ripples
    word = _mixed((word + 0x9E3779B9) & WORD)
    centre_u = 0.3 + 0.4 * _unit(word, along_m.dtype)
    centre_v = 0.3 + 0.4 * _unit(_mixed(word), along_m.dtype)
    du, dv = along_m - (i + centre_u) * CELL_M, left_m - (j + centre_v) * CELL_M
    off = torch.sqrt(du * du + dv * dv) - SPEED_M_PER_S * LIFE_S * age
    phase = off * (1.0 / WAVE_M)
    packet = (1.0 - phase * phase) * (1.0 - age) * torch.cos(2.0 * math.pi * phase)
    return torch.where(falls & (phase.abs() < 1.0), packet, 0.0)


def _hashed(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    word = _mixed((a * 0x85EBCA6B + 0x27D4EB2F) & WORD)
    word = _mixed(word ^ (b * 0xC2B2AE35 & WORD))
    return _mixed(word ^ (c * 0x165667B1 & WORD))


def _mixed(word: Tensor) -> Tensor:
    """The finaliser of MurmurHash3."""
    word = ((word ^ (word >> 16)) * 0x85EBCA6B) & WORD
    word = ((word ^ (word >> 13)) * 0xC2B2AE35) & WORD
    return word ^ (word >> 16)


def _unit(word: Tensor, dtype: torch.dtype) -> Tensor:
    """In [0, 1)."""
    return (word >> 8).to(dtype) * 2.0**-24
