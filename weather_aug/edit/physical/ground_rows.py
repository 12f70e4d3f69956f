"""Water and snow on a run of ground pixels. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.edit.physical.buffer import (
    COVERED,
    HEIGHT,
    LIE,
    LIT,
    MIRRORED,
    NOISE,
    POOL,
    SIDE,
    SINE,
    SIZE,
    B,
    G,
    R,
)
from weather_aug.edit.physical.fresnel import film_ratio_of, fresnel_of_sine
from weather_aug.edit.physical.layers import ILLUMINATION, LATERAL_M, SHARP
from weather_aug.edit.physical.materials import COVER, MIRROR, POROSITY, ROAD
from weather_aug.edit.physical.ripples import ripple
from weather_aug.edit.physical.spread import spread_run

LANE_M, WHEEL_M, TRACK_M = 3.5, 0.75, 0.28
"""Width of a lane, wheels from its middle, half the width of a track."""
SNOW_ALBEDO, ASPHALT_ALBEDO = 0.85, 0.12
SHARPEST = 1e-3
"""Of the border of a cover, in noise."""
WANDER_M = 0.16
"""How far tracks wander within the width of a lane."""
TRACK_COVER, TRACK_SOFTNESS = 0.15, 0.16
"""Share of the road's snow that stays in a track, and how much softer snow ends on a road."""
FLATTEST_SINE = 0.02
RUT_WATER = 1.5
"""How much more water stands in wheel tracks, as a share."""
POOL_DARKENING = 0.2
"""Of what lies under standing water, besides the film's."""
SHOWING_THROUGH = 0.1
"""Share of the contrast below the snow that is left."""
CLEAN, SLUSH = 0.90, 0.76
"""Brightness of the darkest snow over the lightest, beside the road and on it."""
GUESSED_HEIGHTS = (0.05, 0.20)
"""Over the road's plane, metres: where nobody labelled, what rises from it mirrors less."""
MICRO_SLOPE = 0.25
"""Root mean square slope of the stones that stick out of a film, radians."""


@inlined
def ramp(low, high, value):
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = (value - low) / (high - low)
    t = t if t > np.float32(0.0) else np.float32(0.0)
    t = t if t < np.float32(1.0) else np.float32(1.0)
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@inlined
def covered(amount, fuzz, noise):
    """How far a place of this noise is covered when a share `amount` of all places is.

    `fuzz` is how soft borders are; it gives way where a border would leave the noise's range, so
    that the mean over all places is the amount.
    """
    one, least = np.float32(1.0), np.float32(SHARPEST)
    soft = min(fuzz, min(amount, one - amount))
    soft = soft if soft > least else least
    threshold = one + least - amount * (one + np.float32(2.0) * least)
    return ramp(threshold - soft, threshold + soft, noise)


@compiled
def ground_run(run, depth, geometry, look, material, small, cell, share, b):
    """Wet and snow on pixels x0 to x1 of one ground class.

    Args:
        run: (x0, x1, left, y): pixels of the window's row, unsigned (see `spread_run`), and where
            the row starts in the picture, float32.
        depth: (W,) metres.
        geometry: Of the whole picture.
        look: Weather.
        material: (9,) of the class.
        small: (18, w) maps at this row.
        cell: (W,) for `spread_run`.
        share: (W,) for `spread_run`.
        b: Buffer, with the light and the noise of the row.
    """
    x0, x1, _, _ = run
    zero = np.float32(0.0)
    road = material[ROAD] > zero
    amount = look.road_snow if road else look.snow * material[COVER]
    pools = look.puddles if road else zero
    shine = look.mirror * material[MIRROR]
    _places(run, depth, geometry, b)
    spread_run(small, ILLUMINATION, 1, cell, share, x0, x1, b, LIT)
    if amount > zero or pools > zero:
        spread_run(small, LATERAL_M, 1, cell, share, x0, x1, b, SIDE)
        _tracks(x0, x1, look.tracks if road else zero, b)
    if look.film > zero:
        film(x0, x1, look.film * material[POROSITY], look.exposure, b)
    if shine > zero:
        spread_run(small, SHARP, 6, cell, share, x0, x1, b, MIRRORED)
        _pools(x0, x1, pools, b)
        _shine(x0, x1, shine, geometry.labelled, b)
        if look.ripples > zero:
            ripple(run, depth, geometry, look, b)
        _mirror(x0, x1, look.flooded, b)
    if amount > zero:
        _cover(x0, x1, amount, np.float32(TRACK_SOFTNESS) if road else zero, b)
        _lay(x0, x1, look, np.float32(SLUSH) if road else np.float32(CLEAN), b)


@inlined
def _fuzz(size_m):
    """How soft the border of a patch is at a pixel of this size."""
    soft = np.float32(0.07) + np.float32(0.25) * size_m
    return soft if soft < np.float32(0.5) else np.float32(0.5)


@compiled
def _places(run, depth, geometry, b):
    """How flat the pixels are seen, how long they are on the ground, and how high they lie."""
    x0, x1, left, y = run
    one, steepest = np.float32(1.0), np.float32(0.004)
    ray_y = (y - geometry.cy) / geometry.fy
    climb_y = geometry.climb_y * ray_y + geometry.climb_z
    per_fx, per_fy = one / geometry.fx, one / geometry.fy
    across = one + ray_y * ray_y
    for x in range(x0, x1):
        z = min(depth[x], np.float32(1e4))
        ray_x = (left + np.float32(x) - geometry.cx) * per_fx
        climb = geometry.climb_x * ray_x + climb_y
        sine = max(-climb / np.sqrt(across + ray_x * ray_x), steepest)
        b[SINE, x] = sine
        b[SIZE, x] = z * per_fy / max(sine, np.float32(FLATTEST_SINE))
        b[HEIGHT, x] = geometry.height_0 + z * climb


@compiled
def _tracks(x0, x1, strength, b):
    """From how far left of the way to how far in a wheel's track; other lanes are driven less."""
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    for x in range(x0, x1):
        side = b[SIDE, x] + np.float32(WANDER_M) * (b[NOISE, x] - half)
        lane = np.floor(side * np.float32(1.0 / LANE_M) + half)
        off = abs(abs(side - np.float32(LANE_M) * lane) - np.float32(WHEEL_M))
        track = one - ramp(np.float32(0.3 * TRACK_M), np.float32(1.7 * TRACK_M), off)
        driven = one - np.float32(0.45) * abs(lane)
        b[SIDE, x] = strength * track * (driven if driven > zero else zero)


@compiled
def film(x0, x1, wet, exposure, b):
    """Darken a run under a film of water."""
    least, most, one = np.float32(0.01), np.float32(0.95), np.float32(1.0)
    for channel in range(3):
        for x in range(x0, x1):
            value = b[channel, x]
            albedo = value / (exposure * max(b[LIT, x], np.float32(0.02)))
            albedo = min(max(albedo, least), most)
            b[channel, x] = value * (one + wet * (film_ratio_of(albedo) - one))


@compiled
def _pools(x0, x1, share, b):
    """Standing water; more of it in the ruts."""
    one = np.float32(1.0)
    for x in range(x0, x1):
        amount = share * (one + np.float32(RUT_WATER) * b[SIDE, x])
        b[POOL, x] = covered(amount, _fuzz(b[SIZE, x]), b[LIE, x])


@compiled
def _shine(x0, x1, shine, labelled, b):
    """How far each pixel's water mirrors; where nobody labelled, only what lies in the plane."""
    one = np.float32(1.0)
    low, high = np.float32(GUESSED_HEIGHTS[0]), np.float32(GUESSED_HEIGHTS[1])
    for x in range(x0, x1):
        level = one - ramp(low, high, b[HEIGHT, x])
        b[COVERED, x] = shine * (labelled + (one - labelled) * level)


@compiled
def _mirror(x0, x1, flooded_share, b):
    """What the film and the puddles mirror."""
    one = np.float32(1.0)
    slope2 = np.float32(MICRO_SLOPE * MICRO_SLOPE)
    for x in range(x0, x1):
        sine, shine = b[SINE, x], b[COVERED, x]
        flooded = flooded_share + b[POOL, x] * (one - flooded_share)
        rough = fresnel_of_sine(np.sqrt(sine * sine + slope2))
        b[SINE, x] = shine * (one - flooded) * np.float32(0.5) * rough
        b[COVERED, x] = shine * flooded * fresnel_of_sine(sine)
    for channel in range(3):
        for x in range(x0, x1):
            pool, stones, calm = b[POOL, x], b[SINE, x], b[COVERED, x]
            kept = (one - stones - calm) * (one - np.float32(POOL_DARKENING) * pool)
            sharp, smeared = b[MIRRORED + channel, x], b[MIRRORED + 3 + channel, x]
            calm *= smeared + pool * (sharp - smeared)
            b[channel, x] = kept * b[channel, x] + stones * smeared + calm


@compiled
def _cover(x0, x1, amount, softness, b):
    one = np.float32(1.0)
    for x in range(x0, x1):
        left = one - np.float32(1.0 - TRACK_COVER) * b[SIDE, x]
        b[COVERED, x] = left * covered(amount, _fuzz(b[SIZE, x]) + softness, b[NOISE, x])


@compiled
def _lay(x0, x1, look, least, b):
    """Snow over what lies there, at `least` of its brightness; a little of that shows through."""
    asphalt = np.float32(ASPHALT_ALBEDO)
    grey = luminance(look.red, look.green, look.blue)
    for x in range(x0, x1):
        light = b[LIT, x]
        bright = snow_light(light, look)
        under = luminance(b[R, x], b[G, x], b[B, x]) / (asphalt * look.exposure * light)
        under = under if under < np.float32(2.0) else np.float32(2.0)
        shade = least + (np.float32(1.02) - least) * b[NOISE, x]
        shade *= np.float32(1.0 - SHOWING_THROUGH) + np.float32(SHOWING_THROUGH) * under
        lay_snow(x, b[COVERED, x], bright * shade / grey, look, b)


@inlined
def luminance(red, green, blue):
    """Of linear light."""
    return np.float32(0.2126) * red + np.float32(0.7152) * green + np.float32(0.0722) * blue


@inlined
def snow_light(light, look):
    """Luminance of snow under this light, as the camera exposes it."""
    bright = np.float32(SNOW_ALBEDO) * light * look.exposure
    least = np.float32(0.62) * look.snow_light
    bright = bright if bright > least else least
    return bright if bright < look.snow_light else look.snow_light


@inlined
def lay_snow(x, cover, white, look, b):
    """Blend snow of `white` times the airlight's colour over one pixel."""
    b[R, x] += cover * (look.red * white - b[R, x])
    b[G, x] += cover * (look.green * white - b[G, x])
    b[B, x] += cover * (np.float32(1.02) * look.blue * white - b[B, x])
