"""Water and snow on ground pixels in torch; the formulas of `edit.physical.ground_rows`.

Pixels of all ground classes go through them together: where a class takes no snow, no water or no
mirror, the amounts are 0 and change nothing. Differentiable with respect to the light.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import torch
from torch import Tensor

from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical.fresnel import (
    DIFFUSE_FROM_AIR,
    DIFFUSE_FROM_WATER,
    WATER_INDEX,
)
from weather_aug.edit.physical.ground_rows import (
    ASPHALT_ALBEDO,
    CLEAN,
    FLATTEST_SINE,
    GUESSED_HEIGHTS,
    LANE_M,
    MICRO_SLOPE,
    POOL_DARKENING,
    RUT_WATER,
    SHARPEST,
    SHOWING_THROUGH,
    SLUSH,
    SNOW_ALBEDO,
    TRACK_COVER,
    TRACK_M,
    TRACK_SOFTNESS,
    WANDER_M,
    WHEEL_M,
)
from weather_aug.edit.physical.layers import ILLUMINATION, LATERAL_M, SHARP
from weather_aug.edit.physical.materials import COVER, MIRROR, POROSITY, ROAD
from weather_aug.render.batch_dress_grid import Grid, Pixels
from weather_aug.render.batch_dress_ripples import rippled

FARTHEST_M = 1e4
STEEPEST = 0.004
"""Least sine of the angle between view and road."""
OTHER_LANES_LESS = 0.45
LIGHTEST = 1.02
"""Brightness of the lightest snow."""


class _Places(NamedTuple):
    """Of ground pixels, (N,) each."""

    sine: Tensor
    """Of the angle between view and road."""
    size_m: Tensor
    """Of the pixel on the road, along it."""
    height_m: Tensor
    """Over the road's plane."""


def dressed_ground(
    light: Tensor, pixels: Pixels, grid: Grid, geometry: SimpleNamespace, look: SimpleNamespace
) -> Tensor:
    """Wet and snowed on ground.

    Args:
        light: (3, N) linear light under the weather's sky.
        pixels: Of ground classes.
        grid: The editor's maps under the weather's light.
        geometry: `edit.physical.dress.Geometry` of the whole picture, plain.
        look: `edit.physical.look.Look` of the weather, plain.

    Returns:
        (3, N).
    """
    material = pixels.material
    road = material[:, ROAD] > 0
    amount = torch.where(road, look.road_snow, look.snow * material[:, COVER])
    (lit,) = grid.at(ILLUMINATION, 1, pixels)
    places = _places(pixels, geometry)
    (lateral_m,) = grid.at(LATERAL_M, 1, pixels)
    tracks = torch.where(road, look.tracks * tracks_at(lateral_m, pixels.noise), 0.0)
    if look.film > 0:
        light = film(light, look.exposure * lit.clamp(min=0.02), look.film * material[:, POROSITY])
    if look.mirror > 0:
        pools = torch.where(road, look.puddles * (1.0 + RUT_WATER * tracks), 0.0)
        pool = covered(pools, _fuzz(places.size_m), pixels.lie)
        level = 1.0 - ramp(*GUESSED_HEIGHTS, places.height_m)
        level = geometry.labelled + (1.0 - geometry.labelled) * level
        shine = look.mirror * material[:, MIRROR] * level
        shown = grid.at(SHARP, 6, pixels)
        if look.ripples > 0:
            shown = rippled(shown, pool, places.size_m, pixels, geometry, look)
        light = _mirrored(light, shown, pool, shine, places.sine, look.flooded)
    if max(look.road_snow, look.snow) > 0:
        left = 1.0 - (1.0 - TRACK_COVER) * tracks
        softness = torch.where(road, TRACK_SOFTNESS, 0.0).to(lit.dtype)
        cover = left * covered(amount, _fuzz(places.size_m) + softness, pixels.noise)
        least = torch.where(road, SLUSH, CLEAN).to(lit.dtype)
        under = (luminance(light) / (ASPHALT_ALBEDO * look.exposure * lit)).clamp(max=2.0)
        shade = (least + (LIGHTEST - least) * pixels.noise) * (
            1.0 - SHOWING_THROUGH + SHOWING_THROUGH * under
        )
        light = laid(light, cover, snow_light(lit, look) * shade, look)
    return light


def ramp(low: float | Tensor, high: float | Tensor, value: Tensor) -> Tensor:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = ((value - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def covered(amount: Tensor, fuzz: float | Tensor, noise: Tensor) -> Tensor:
    """How far a place of this noise is covered when a share `amount` of all places is.

    `fuzz` is how soft borders are; it gives way where a border would leave the noise's range.
    """
    soft = torch.minimum(amount, 1.0 - amount).clamp(max=fuzz).clamp(min=SHARPEST)
    threshold = 1.0 + SHARPEST - amount * (1.0 + 2.0 * SHARPEST)
    return ramp(threshold - soft, threshold + soft, noise)


def _fuzz(size_m: Tensor) -> Tensor:
    """How soft the border of a patch is at a pixel of this size."""
    return (0.07 + 0.25 * size_m).clamp(max=0.5)


def _places(pixels: Pixels, geometry: SimpleNamespace) -> _Places:
    z = pixels.depth_m.clamp(max=FARTHEST_M)
    climb = pixels.towards(geometry.climb_x, geometry.climb_y, geometry.climb_z)
    across = 1.0 + pixels.ray_y * pixels.ray_y
    sine = (-climb / torch.sqrt(across + pixels.ray_x * pixels.ray_x)).clamp(min=STEEPEST)
    size_m = z / geometry.fy / sine.clamp(min=FLATTEST_SINE)
    return _Places(sine, size_m, geometry.height_0 + z * climb)


def tracks_at(lateral_m: Tensor, noise: Tensor) -> Tensor:
    """How far in a wheel's track, in [0, 1]; other lanes are driven less.

    Args:
        lateral_m: (N,) how far left of the driven way, metres.
        noise: (N,) by which tracks wander.
    """
    side = lateral_m + WANDER_M * (noise - 0.5)
    lane = torch.floor(side * (1.0 / LANE_M) + 0.5)
    off = ((side - LANE_M * lane).abs() - WHEEL_M).abs()
    track = 1.0 - ramp(0.3 * TRACK_M, 1.7 * TRACK_M, off)
    return track * (1.0 - OTHER_LANES_LESS * lane.abs()).clamp(min=0.0)


def film(light: Tensor, white: Tensor, wet: Tensor) -> Tensor:
    """Light (3, N) under a film of water, `wet` (N,) of it; `white` (N,) is a white surface's."""
    albedo = (light / white).clamp(0.01, 0.95)
    passes = (1.0 - DIFFUSE_FROM_AIR) * (1.0 - DIFFUSE_FROM_WATER)
    ratio = passes / (1.0 - DIFFUSE_FROM_WATER * albedo)
    return light * (1.0 + wet * (ratio - 1.0))


def _mirrored(
    light: Tensor, shown: Tensor, pool: Tensor, shine: Tensor, sine: Tensor, flooded_share: float
) -> Tensor:
    """What the film and the puddles mirror; `shown` (6, N) is the light in calm and rough water."""
    flooded = flooded_share + pool * (1.0 - flooded_share)
    rough = fresnel_of_sine(torch.sqrt(sine * sine + MICRO_SLOPE * MICRO_SLOPE))
    stones = shine * (1.0 - flooded) * 0.5 * rough
    calm = shine * flooded * fresnel_of_sine(sine)
    kept = (1.0 - stones - calm) * (1.0 - POOL_DARKENING * pool)
    sharp, smeared = shown[:3], shown[3:]
    return kept * light + stones * smeared + calm * (smeared + pool * (sharp - smeared))


def fresnel_of_sine(sine: Tensor) -> Tensor:
    """Share of unpolarised light that water mirrors, by the sine of the grazing angle."""
    index2 = WATER_INDEX**2
    inside = torch.sqrt(sine * sine + (index2 - 1.0))
    across = (inside - sine) / (inside + sine)
    along = (index2 * sine - inside) / (index2 * sine + inside)
    return 0.5 * (across * across + along * along)


def luminance(light: Tensor) -> Tensor:
    """(N,) of linear light (3, N)."""
    red, green, blue = (float(weight) for weight in LUMINANCE)
    return red * light[0] + green * light[1] + blue * light[2]


def snow_light(lit: Tensor, look: SimpleNamespace) -> Tensor:
    """Luminance of snow under this light, as the camera exposes it."""
    bright = SNOW_ALBEDO * lit * look.exposure
    return bright.clamp(0.62 * look.snow_light, look.snow_light)


def laid(light: Tensor, cover: Tensor, luminance_of_snow: Tensor, look: SimpleNamespace) -> Tensor:
    """Light (3, N) with snow of this luminance (N,), in the airlight's colour, blended over it."""
    airlight = light.new_tensor((look.red, look.green, look.blue))
    white = luminance_of_snow / luminance(airlight)
    tint = airlight * light.new_tensor((1.0, 1.0, 1.02))
    return light + cover * (tint[:, None] * white - light)
