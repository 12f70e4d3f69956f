"""A picture's background in the weather, row by row, in linear light. Compiled.

Serial and without fast-math, so that the same arguments give the same bits in every process.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.edit.physical.materials import (
    CAP_M,
    COVER,
    GROUND,
    LEAF,
    LEVEL,
    MIRROR,
    POROSITY,
    ROAD,
)
from weather_aug.edit.physical.noise import CELL_M, ground_noise
from weather_aug.edit.surface import depth_row, light_row

CAP_ROWS = 96
"""How far above a window the upper edges of things are looked for, pixels."""
NO_CAP_M = 99.0
LANE_M, WHEEL_M, TRACK_HALF_M = 3.5, 0.75, 0.28
SNOW_ALBEDO, SLUSH_ALBEDO = 0.85, 0.5
ASPHALT_ALBEDO = 0.12
FILM_OUT, FILM_BACK = 0.066, 0.475
"""Share of light that a film of water turns back from above, and from below (n = 1.333)."""
MICRO_SLOPE = 0.25
"""Root mean square slope of the stones that stick out of the film, radians."""


class Geometry(NamedTuple):
    """A whole picture's camera over the street, float32."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    along_x: np.float32
    """Steps of a surface's place in street axes for each metre of depth, by tangents (x, y, 1)."""
    along_y: np.float32
    along_z: np.float32
    left_x: np.float32
    left_y: np.float32
    left_z: np.float32
    climb_x: np.float32
    """The same of its height over the road's plane."""
    climb_y: np.float32
    climb_z: np.float32
    along_0: np.float32
    """The camera, modulo the period of the noise."""
    left_0: np.float32
    height_0: np.float32
    """Over the road's plane."""


class Look(NamedTuple):
    """What the weather does to surfaces, float32."""

    overcast: np.float32
    flattening: np.float32
    """Exponent of the light that replaces the sun's: overcast times the tone's contrast."""
    zenith_gain: np.float32
    red: np.float32
    """Airlight."""
    green: np.float32
    blue: np.float32
    film: np.float32
    """Wetness, as far as it darkens."""
    mirror: np.float32
    """Wetness, as far as it mirrors."""
    flooded: np.float32
    """Share of the wet road whose film covers the stones."""
    puddles: np.float32
    snow: np.float32
    road_snow: np.float32
    snow_depth_m: np.float32
    tracks: np.float32
    """1 where wheels keep snow off the road, else 0."""
    exposure: np.float32
    """Of what is not white: the camera exposes for the snow."""
    snow_light: np.float32
    """Most luminance of snow."""


@compiled
def dress(surface, classes, window, geometry, look, curve, matrix, table, maps, step, tile, out):
    """Paint one window's background in the weather.

    Args:
        surface: The recorded picture.
        classes: (N,) train ids of the whole picture, guessed where nobody labelled.
        window: (top, left, height, width) in the whole picture.
        geometry: Camera of the whole picture.
        look: Weather.
        curve: (256,) float32 toned light by sRGB level.
        matrix: (3, 3) float32 colour matrix after it.
        table: (256, 7) float32 materials.
        maps: (14, h, w) float32 on the small grid of the whole picture.
        step: Pixels of a cell.
        tile: Noise.
        out: (3, H, W) uint8 out.
    """
    top, left, height, width = window
    rows, columns = maps.shape[1], maps.shape[2]
    buffer = np.empty((40, width), np.float32)
    small = np.empty(columns, np.float32)
    cell = np.empty(width, np.int32)
    share = np.empty(width, np.float32)
    for x in range(width):
        place = (np.float32(left + x) + np.float32(0.5)) / np.float32(step) - np.float32(0.5)
        place = min(max(place, np.float32(0.0)), np.float32(columns - 1))
        first = min(np.int32(place), np.int32(max(columns - 2, 0)))
        cell[x] = first
        share[x] = place - np.float32(first)
    below_top = np.full(width, np.float32(NO_CAP_M), np.float32)
    depth_above = np.zeros(width, np.float32)
    class_above = np.full(width, np.uint8(255), np.uint8)
    kinds = np.empty(width, np.uint8)
    snowy = (look.snow > 0) | (look.road_snow > 0)
    wet = (look.film > 0) | (look.mirror > 0)
    start = max(top - CAP_ROWS, 0) if snowy else top
    red, green, blue, luma = buffer[0], buffer[1], buffer[2], buffer[3]
    depth = np.empty(width, np.float32)
    bits = depth.view(np.int32)
    for y in range(start, top + height):
        depth_row(surface, y, left, bits, depth)
        first = y * surface.width + left
        for x in range(width):
            kinds[x] = classes[first + x]
        if snowy:
            _caps_row(kinds, depth, geometry.fy, below_top, depth_above, class_above)
        if y < top:
            continue
        place = (np.float32(y) + np.float32(0.5)) / np.float32(step) - np.float32(0.5)
        place = min(max(place, np.float32(0.0)), np.float32(rows - 1))
        upper = min(np.int32(place), np.int32(max(rows - 2, 0)))
        down = place - np.float32(upper)
        light_row(surface, y, left, curve, red, green, blue)
        _luma_row(surface, y, left, luma)
        for k in range(maps.shape[0]):
            _spread_row(maps[k], upper, down, small, cell, share, buffer[8 + k])
        ray_y = (np.float32(y) - geometry.cy) / geometry.fy
        _tone_row(luma, buffer, look, matrix, red, green, blue)
        if wet or snowy:
            for x in range(width):
                ray_x = (np.float32(left + x) - geometry.cx) / geometry.fx
                _ground_pixel(
                    x, ray_x, ray_y, kinds[x], depth[x], below_top[x], geometry, look, table, tile,
                    buffer,
                )
        _sky_row(luma, left, ray_y, geometry, look, buffer, red, green, blue)
        for channel in range(3):
            _encode_row(buffer[channel], out[channel, y - top])


@compiled
def _caps_row(kinds, depth, fy, below_top, depth_above, class_above):
    """How far each pixel lies below the upper edge of its own thing, metres."""
    for x in range(kinds.shape[0]):
        z, above = depth[x], depth_above[x]
        if kinds[x] == class_above[x] and abs(z - above) < np.float32(1.5) + np.float32(0.2) * z:
            below_top[x] += z / fy
        else:
            behind = above > z + np.float32(0.3) + np.float32(0.05) * z
            below_top[x] = np.float32(0.0) if behind else np.float32(NO_CAP_M)
        depth_above[x], class_above[x] = z, kinds[x]


@compiled
def _luma_row(surface, y, left, out):
    top_, left_, _, stride = surface.image_window
    start = (y - top_) * stride + left - left_
    image = surface.image[start : start + out.shape[0]]
    for x in range(out.shape[0]):
        out[x] = (
            np.float32(0.2126 / 255) * np.float32(image[x, 0])
            + np.float32(0.7152 / 255) * np.float32(image[x, 1])
            + np.float32(0.0722 / 255) * np.float32(image[x, 2])
        )


@compiled
def _spread_row(plane, upper, down, small, cell, share, out):
    """One row of a small-grid map at the picture's pixels, bilinear."""
    lower = min(upper + 1, plane.shape[0] - 1)
    for j in range(small.shape[0]):
        a, b = plane[upper, j], plane[lower, j]
        small[j] = a + down * (b - a)
    last = small.shape[0] - 1
    for x in range(out.shape[0]):
        j = cell[x]
        a, b = small[j], small[min(j + 1, last)]
        out[x] = a + share[x] * (b - a)


@compiled
def _tone_row(luma, buffer, look, matrix, red, green, blue):
    """The sun's light and shadow go, then saturation and white."""
    slope, offset = buffer[8], buffer[9]
    for x in range(red.shape[0]):
        gain = np.exp(look.flattening * (slope[x] * luma[x] + offset[x])) * look.exposure
        r, g, b = red[x] * gain, green[x] * gain, blue[x] * gain
        red[x] = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b
        green[x] = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b
        blue[x] = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b


@inlined
def _ramp(low, high, value):
    t = (value - low) / (high - low)
    t = min(max(t, np.float32(0.0)), np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@inlined
def fresnel_of_sine(s):
    one = np.float32(1.0)
    t = one - s
    return np.float32(0.02) + np.float32(0.98) * t * t * t * t * t


@inlined
def _ground_pixel(x, ray_x, ray_y, kind, z, below_top, geometry, look, table, tile, buffer):
    """Water and snow on one pixel."""
    zero, one = np.float32(0.0), np.float32(1.0)
    if not z < np.float32(1e4):
        return
    r, g, b = buffer[0, x], buffer[1, x], buffer[2, x]
    light = max(buffer[12, x], np.float32(0.02))
    mean = max(buffer[13, x], np.float32(0.002))
    lateral = buffer[15, x]
    ground = table[kind, GROUND] > zero
    road = table[kind, ROAD] > zero
    climb = geometry.climb_x * ray_x + geometry.climb_y * ray_y + geometry.climb_z
    along = geometry.along_0 + z * (
        geometry.along_x * ray_x + geometry.along_y * ray_y + geometry.along_z
    )
    left = geometry.left_0 + z * (
        geometry.left_x * ray_x + geometry.left_y * ray_y + geometry.left_z
    )
    height = geometry.height_0 + z * climb
    slant = np.sqrt(one + ray_x * ray_x + ray_y * ray_y)
    sine = -climb / slant
    sine = min(max(sine, np.float32(0.004)), one)
    footprint = z / geometry.fy
    if ground:
        footprint /= max(sine, np.float32(0.02))
    else:
        along += np.float32(0.6) * height
        left += np.float32(0.6) * height
    noise = ground_noise(tile, along, left, footprint, zero)
    fuzz = min(np.float32(0.07) + np.float32(0.25) * footprint, np.float32(0.5))
    y_here = np.float32(0.2126) * r + np.float32(0.7152) * g + np.float32(0.0722) * b

    # Where wheels run.
    lateral += np.float32(0.5) * (noise - np.float32(0.5))
    lane = lateral - np.float32(LANE_M) * np.floor(lateral / np.float32(LANE_M) + np.float32(0.5))
    off_track = abs(abs(lane) - np.float32(WHEEL_M))
    track = one - _ramp(np.float32(0.5 * TRACK_HALF_M), np.float32(1.5 * TRACK_HALF_M), off_track)
    lanes_off = abs(lateral - lane) * np.float32(1.0 / LANE_M)
    track *= max(one - np.float32(0.45) * lanes_off, zero)
    track = look.tracks * track if road else zero

    # Snow: how much of this pixel it covers.
    cover = zero
    if look.snow > zero or look.road_snow > zero:
        if road:
            spared = one - np.float32(0.85) * track
            amount = look.road_snow * spared
        else:
            amount = look.snow * table[kind, COVER]
        if ground:
            threshold = one + fuzz - amount * (one + np.float32(2.0) * fuzz)
            cover = _ramp(threshold - fuzz, threshold + fuzz, noise)
        else:
            cap = table[kind, CAP_M] * look.snow * (np.float32(0.6) + np.float32(0.8) * noise)
            cap += np.float32(0.4) * look.snow_depth_m if cap > zero else zero
            if cap > zero:
                cover = one - _ramp(cap * np.float32(0.7), cap * np.float32(1.2), below_top)
                level = _ramp(np.float32(0.55), np.float32(0.85), buffer[14, x])
                level *= table[kind, LEVEL]
                threshold = one + fuzz - amount * level * (one + np.float32(2.0) * fuzz)
                cover = max(cover, _ramp(threshold - fuzz, threshold + fuzz, noise))
            if table[kind, LEAF] > zero:
                detail = min(max(np.float32(0.5) + np.float32(0.7) * (y_here / mean - one), zero), one)
                grain = np.float32(0.45) * noise + np.float32(0.55) * detail
                amount *= np.float32(0.8)
                threshold = np.float32(1.2) - amount * np.float32(1.4)
                cover = _ramp(threshold - np.float32(0.2), threshold + np.float32(0.2), grain)
            buried = look.snow_depth_m * (np.float32(0.6) + np.float32(0.8) * noise)
            if height < buried and z < np.float32(30.0) and table[kind, COVER] > zero:
                cover = max(cover, look.snow)

    # Water.
    wet = look.film
    if wet > zero:
        bare = one / light
        scale = (one - np.float32(FILM_OUT)) * (one - np.float32(FILM_BACK))
        share = wet * table[kind, POROSITY]
        for channel in range(3):
            value = buffer[channel, x]
            albedo = min(max(value * bare, np.float32(0.01)), np.float32(0.95))
            ratio = scale / (one - np.float32(FILM_BACK) * albedo)
            buffer[channel, x] = value * (one + share * (ratio - one))
    shine = look.mirror * table[kind, MIRROR]
    if shine > zero:
        amount = look.puddles * (one + np.float32(1.5) * track)
        pool = zero
        if amount > zero:
            lie = ground_noise(tile, along, left, footprint, np.float32(11.3))
            threshold = one + fuzz - amount * (one + np.float32(2.0) * fuzz)
            pool = _ramp(threshold - fuzz, threshold + fuzz, lie) if road else zero
        flooded = look.flooded + pool * (one - look.flooded)
        flat = fresnel_of_sine(sine)
        rough = fresnel_of_sine(np.sqrt(sine * sine + np.float32(MICRO_SLOPE * MICRO_SLOPE)))
        stones = shine * (one - flooded) * np.float32(0.5) * rough
        calm = shine * flooded * flat
        dark = one - np.float32(0.2) * pool
        for channel in range(3):
            sharp_light = buffer[16 + channel, x]
            rough_light = buffer[19 + channel, x]
            film_light = rough_light + pool * (sharp_light - rough_light)
            value = buffer[channel, x] * dark
            buffer[channel, x] = (
                value * (one - stones - calm) + stones * rough_light + calm * film_light
            )

    if cover > zero:
        bright = np.float32(SNOW_ALBEDO) * light * look.exposure
        bright = min(max(bright, np.float32(0.62) * look.snow_light), look.snow_light)
        if table[kind, LEAF] > zero:
            bright *= min(np.float32(0.25) + np.float32(4.0) * mean / light, np.float32(0.85))
        detail = min(y_here / (np.float32(ASPHALT_ALBEDO) * light), np.float32(2.0))
        shade = np.float32(0.90) + np.float32(0.12) * noise
        shade *= np.float32(0.95) + np.float32(0.05) * detail
        if not ground:
            shade *= np.float32(0.9)
        grey = np.float32(0.2126) * look.red + np.float32(0.7152) * look.green
        grey = bright * shade / (grey + np.float32(0.0722) * look.blue)
        buffer[0, x] += cover * (look.red * grey - buffer[0, x])
        buffer[1, x] += cover * (look.green * grey - buffer[1, x])
        buffer[2, x] += cover * (look.blue * grey * np.float32(1.02) - buffer[2, x])


@compiled
def _sky_row(luma, left, ray_y, geometry, look, buffer, red, green, blue):
    """An overcast sky where the sky is, also between leaves."""
    zero, one = np.float32(0.0), np.float32(1.0)
    slope, offset = buffer[10], buffer[11]
    for x in range(red.shape[0]):
        matte = slope[x] * luma[x] + offset[x]
        matte = min(max(matte, zero), one)
        weight = look.overcast * matte
        ray_x = (np.float32(left + x) - geometry.cx) / geometry.fx
        climb = geometry.climb_x * ray_x + geometry.climb_y * ray_y + geometry.climb_z
        sine = climb / np.sqrt(one + ray_x * ray_x + ray_y * ray_y)
        brighter = one + look.zenith_gain * max(sine, zero)
        red[x] += weight * (look.red * brighter - red[x])
        green[x] += weight * (look.green * brighter - green[x])
        blue[x] += weight * (look.blue * brighter - blue[x])


@compiled
def _encode_row(light, out):
    """As `render.shade.encode_row`."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(light.shape[0]):
        v = light[x]
        v = v if v > zero else zero
        v = v if v < one else one
        s = np.sqrt(v)
        p = np.float32(-1.6236571) + s * np.float32(0.5173023)
        p = np.float32(2.0315735) + s * p
        p = np.float32(-1.4027363) + s * p
        p = np.float32(1.5179509) + s * p
        p = np.float32(-0.0401096) + s * p
        p = p if v > np.float32(0.0031308) else np.float32(12.92) * v
        out[x] = np.uint8(np.int32(p * np.float32(255.0) + np.float32(0.5)))
