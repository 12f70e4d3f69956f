"""Light of lamps on a window of a picture: discs, glow, halos and streaks. Compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8, like_image
from weather_aug._compiled import compiled, inlined
from weather_aug._rows import survival
from weather_aug.clip.types import Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.errors import ArgumentError

UInt8 = NDArray[np.uint8]

HALO_EXPONENT = 0.8
HALO_AREA = 2.0 * math.pi * math.gamma(2.0 / HALO_EXPONENT) / HALO_EXPONENT
"""Integral of exp(-rho^0.8) over the plane."""
LONGEST_STREAK = 3.0
"""A streak ends at so many standard deviations from its middle."""


class SeenLamp(NamedTuple):
    """A lamp on a picture; float32, pixels of the whole picture, light over white times pixels."""

    u: Any
    v: Any
    variance_px2: Any
    """Of the disc with the lens' blur."""
    core: Any
    """Light of the disc."""
    glow: Any
    glow_radius_px: Any
    halo: Any
    halo_radius_px: Any
    reach_px: Any
    mirror_u: Any
    mirror_v: Any
    foot_v: Any
    """Row of the road below the lamp: nothing above it mirrors the lamp."""
    streak: Any
    streak_u_px: Any
    """Standard deviation of the streak, across."""
    streak_v_px: Any
    red: Any
    green: Any
    blue: Any


def add_lamps(
    image: UInt8, lamps: Sequence[SeenLamp], *, window: Window, ground: NDArray[Any] | None
) -> UInt8:
    """A window of a picture with the light of lamps added to it; the argument is not changed.

    A window's pixels equal the same pixels of the whole picture.

    Args:
        image: (H, W, 3) uint8 sRGB of the window.
        lamps: Of `seen_lamps`, for the whole picture.
        window: (top, left, height, width) of the image in the whole picture.
        ground: (H, W) bool or uint8 of the window, where the ground is that may mirror lamps; None
            mirrors none.

    Raises:
        ArgumentError: If the image is no uint8 picture of the window's size, or `ground` has
            another shape.
    """
    image = image_uint8("image", image)
    if tuple(window[2:]) != image.shape[:2]:
        raise ArgumentError(f"window {window} is not of the image's size {image.shape[:2]}")
    if ground is not None:
        like_image("ground", ground, (image.shape[0], image.shape[1]))
        if ground.dtype.itemsize != 1 or ground.dtype.kind not in "bu":
            raise ArgumentError(f"ground must be bool or uint8, got {ground.dtype}")
    out = image.copy()
    patch = _patch_of(lamps, window)
    if patch is None:
        return out
    top, left, height, width = patch
    part = (
        slice(top - window[0], top - window[0] + height),
        slice(left - window[1], left - window[1] + width),
    )
    mirrors = np.zeros((height, width), np.uint8)
    if ground is not None:
        mirrors[:] = ground[part]
    light = np.zeros((height, width, 3), np.float32)
    for lamp in lamps:
        _shine(lamp, patch, _DECAY, light)
        if lamp.streak > 0:
            _mirror(lamp, patch, mirrors, light)
    # Into an array of its own: the kernel would be compiled once more for a part of one.
    dark = np.ascontiguousarray(out[part])
    lit = dark.copy()
    _expose(dark, light, _LINEAR, _BORDERS, lit)
    out[part] = lit
    return out


def _patch_of(lamps: Sequence[SeenLamp], window: Window) -> Window | None:
    """The smallest window that holds all light of the lamps in `window`; None without any."""
    if not lamps:
        return None
    rows, columns = [], []
    for lamp in lamps:
        reach, across = float(lamp.reach_px), LONGEST_STREAK * float(lamp.streak_u_px)
        rows += [float(lamp.v) - reach, float(lamp.v) + reach]
        columns += [float(lamp.u) - reach, float(lamp.u) + reach]
        if lamp.streak > 0:
            rows.append(float(lamp.mirror_v) + LONGEST_STREAK * float(lamp.streak_v_px))
            columns += [float(lamp.mirror_u) - across, float(lamp.mirror_u) + across]
    first = max(math.floor(min(rows)), window[0])
    start = max(math.floor(min(columns)), window[1])
    end = min(math.ceil(max(rows)) + 1, window[0] + window[2])
    stop = min(math.ceil(max(columns)) + 1, window[1] + window[3])
    return (first, start, end - first, stop - start) if first < end and start < stop else None


_DECAY_STEPS = 2048
_DECAY_FARTHEST = 4.5
"""Square root of the distance in radii at which the table ends."""
_DECAY = np.exp(
    -(np.linspace(0.0, _DECAY_FARTHEST, _DECAY_STEPS + 1) ** (2.0 * HALO_EXPONENT))
).astype(np.float32)
"""exp(-q^0.8) over the square root of q, where it is smooth."""
_DECAY.flags.writeable = False
_LINEAR = SRGB_LEVELS_LINEAR.astype(np.float32)
_LINEAR.flags.writeable = False
_BORDERS = (0.5 * (SRGB_LEVELS_LINEAR[1:] + SRGB_LEVELS_LINEAR[:-1])).astype(np.float32)
"""(255,) linear light halfway between two levels."""
_BORDERS.flags.writeable = False


@inlined
def _decayed(squared_px2: Any, radius_px: Any, decay: Any) -> Any:
    """exp(-(rho / radius)^0.8) of a squared distance rho^2."""
    root = np.sqrt(np.sqrt(squared_px2) / radius_px)
    place = root * np.float32(_DECAY_STEPS / _DECAY_FARTHEST)
    last = np.float32(_DECAY_STEPS - 1)
    place = place if place < last else last
    i = np.int64(place)
    return decay[i] + (place - np.float32(i)) * (decay[i + 1] - decay[i])


@compiled
def _shine(lamp: Any, patch: Any, decay: Any, light: Any) -> None:
    """Add disc, glow and halo of a lamp to the light (H, W, 3) of a patch.

    Each profile has its value at the reach taken away, so that no edge shows where it ends.
    """
    top, left, height, width = patch
    zero, half = np.float32(0.0), np.float32(0.5)
    reach2 = lamp.reach_px * lamp.reach_px
    core = lamp.core / (np.float32(2.0 * math.pi) * lamp.variance_px2)
    glow_r, halo_r = lamp.glow_radius_px, lamp.halo_radius_px
    glow = lamp.glow / (np.float32(HALO_AREA) * glow_r * glow_r)
    halo = lamp.halo / (np.float32(HALO_AREA) * halo_r * halo_r)
    glow_end, halo_end = _decayed(reach2, glow_r, decay), _decayed(reach2, halo_r, decay)
    first = max(np.int64(np.floor(lamp.v - lamp.reach_px)) - top, 0)
    last = min(np.int64(np.ceil(lamp.v + lamp.reach_px)) - top, height - 1)
    start = max(np.int64(np.floor(lamp.u - lamp.reach_px)) - left, 0)
    stop = min(np.int64(np.ceil(lamp.u + lamp.reach_px)) - left, width - 1)
    for y in range(first, last + 1):
        dy = np.float32(y + top) - lamp.v
        for x in range(start, stop + 1):
            dx = np.float32(x + left) - lamp.u
            squared = dx * dx + dy * dy
            if squared >= reach2:
                continue
            away = half * squared / lamp.variance_px2
            value = core * survival(away) if away < np.float32(30.0) else zero
            value += glow * (_decayed(squared, glow_r, decay) - glow_end)
            value += halo * (_decayed(squared, halo_r, decay) - halo_end)
            light[y, x, 0] += value * lamp.red
            light[y, x, 1] += value * lamp.green
            light[y, x, 2] += value * lamp.blue


@compiled
def _mirror(lamp: Any, patch: Any, mirrors: Any, light: Any) -> None:
    """Add the streak of a lamp where `mirrors` (H, W) is not 0 and the road is before the lamp."""
    top, left, height, width = patch
    half, longest = np.float32(0.5), np.float32(LONGEST_STREAK)
    across, down = longest * lamp.streak_u_px, longest * lamp.streak_v_px
    area = np.float32(2.0 * math.pi) * lamp.streak_u_px * lamp.streak_v_px
    peak, end = lamp.streak / area, survival(half * longest * longest)
    first = max(np.int64(np.floor(max(lamp.mirror_v - down, lamp.foot_v))) - top, 0)
    last = min(np.int64(np.ceil(lamp.mirror_v + down)) - top, height - 1)
    start = max(np.int64(np.floor(lamp.mirror_u - across)) - left, 0)
    stop = min(np.int64(np.ceil(lamp.mirror_u + across)) - left, width - 1)
    for y in range(first, last + 1):
        dy = (np.float32(y + top) - lamp.mirror_v) / lamp.streak_v_px
        # The road begins below the lamp within a pixel.
        begun = np.float32(y + top) - lamp.foot_v + half
        begun = min(max(begun, np.float32(0.0)), np.float32(1.0))
        for x in range(start, stop + 1):
            dx = (np.float32(x + left) - lamp.mirror_u) / lamp.streak_u_px
            away = half * (dx * dx + dy * dy)
            if mirrors[y, x] == 0 or away >= half * longest * longest:
                continue
            value = begun * peak * (survival(away) - end)
            light[y, x, 0] += value * lamp.red
            light[y, x, 1] += value * lamp.green
            light[y, x, 2] += value * lamp.blue


@compiled
def _expose(image: Any, light: Any, linear: Any, borders: Any, out: Any) -> None:
    """Write `image` plus linear light as sRGB levels; where no light is added nothing changes."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for channel in range(3):
                added = light[y, x, channel]
                if added <= np.float32(0.0):
                    continue
                value = linear[image[y, x, channel]] + added
                low, high = np.int64(image[y, x, channel]), np.int64(255)
                while low < high:
                    middle = (low + high) >> 1
                    if value > borders[middle]:
                        low = middle + 1
                    else:
                        high = middle
                out[y, x, channel] = np.uint8(low)
