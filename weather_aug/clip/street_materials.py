"""How everything but the ground is painted (numba).

A paint is the linear albedo (3) and the share of light that the surface mirrors.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.street_facade import brickwork, facade_paint, roof_paint
from weather_aug.clip.street_shapes import draws_of
from weather_aug.clip.street_texture import band, mixed, noise, smooth, stripe, times

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Colour = tuple[float, float, float]
Paint = tuple[float, float, float, float]


@compiled
def _car_body(
    tile: Float32, look: Float64, x: float, y: float, z: float, nx: float, ny: float, f: float
) -> Paint:
    """Paint the lower half of a car; detail: half length, half width, wheel x, radius."""
    base = times((look[0], look[1], look[2]), 1.0 + 0.06 * noise(tile, x, y + z, 3.0, f))
    width, axle, radius = look[4], look[5], look[6]
    mirror = 0.07
    dirt = smooth(0.55, 0.15, z) * (0.5 + 0.5 * noise(tile, x + look[7], z + y, 1.5, f))
    colour = mixed(base, (0.17, 0.15, 0.12), 0.55 * dirt)
    if abs(ny) > 0.6:
        arch = math.hypot(abs(x) - axle, z - radius) - radius - 0.06
        seam = band(x, 0.62, 0.635, f) + band(x, -0.30, -0.285, f) + band(x, -1.02, -1.005, f)
        seam *= band(z, 0.30, 2.0, f)
        handle = band(z, 0.76, 0.79, f) * (band(x, -0.20, -0.02, f) + band(x, -0.92, -0.76, f))
        colour = times(colour, 1.0 - 0.7 * min(seam, 1.0) - 0.5 * min(handle, 1.0))
        dark = max(band(z, 0.0, 0.27, f), smooth(f + 0.005, -f - 0.005, arch))
        colour = mixed(colour, (0.012, 0.012, 0.013), dark)
        mirror *= 1.0 - dark
    elif nx > 0.5:
        lamp = band(abs(y), width - 0.44, width - 0.12, f) * band(z, 0.57, 0.68, f)
        grille = band(abs(y), -1.0, 0.42, f) * band(z, 0.38, 0.60, f)
        grille *= 0.75 + 0.25 * stripe(z, 0.05, 0.0, 0.03, f)
        plate = band(abs(y), -1.0, 0.26, f) * band(z, 0.40, 0.50, f)
        colour = mixed(colour, (0.015, 0.015, 0.016), max(grille, band(z, 0.0, 0.30, f)))
        colour = mixed(mixed(colour, (0.70, 0.70, 0.66), plate), (0.48, 0.50, 0.53), lamp)
        mirror += 0.25 * lamp
    elif nx < -0.5:
        lamp = band(abs(y), width - 0.42, width - 0.08, f) * band(z, 0.60, 0.80, f)
        plate = band(abs(y), -1.0, 0.26, f) * band(z, 0.50, 0.61, f)
        colour = mixed(colour, (0.03, 0.03, 0.03), band(z, 0.0, 0.34, f))
        colour = times(colour, 1.0 - 0.5 * band(z, 0.83, 0.845, f))
        colour = mixed(mixed(colour, (0.70, 0.70, 0.62), plate), (0.42, 0.015, 0.012), lamp)
        mirror += 0.10 * lamp
    return colour[0], colour[1], colour[2], mirror


@compiled
def _car_cabin(
    look: Float64, x: float, y: float, z: float, nx: float, ny: float, nz: float, f: float
) -> Paint:
    """Paint roof and windows; detail: x of the front and rear base, run of the rear, height."""
    colour = (look[0], look[1], look[2])
    front, rear, run, top = look[3], look[4], look[5], look[6]
    rise = (z - 0.90) / (top - 0.90)
    glass = band(z, 0.955, top - 0.085, f)
    if nz > 0.93:
        glass = 0.0
    elif abs(ny) > 0.55:
        low, high = rear + run * rise + 0.16, front - 0.75 * rise - 0.15
        middle = 0.5 * (low + high) - 0.05
        glass *= band(x, low, high, f) * (1.0 - band(x, middle - 0.05, middle + 0.05, f))
    else:
        glass *= band(abs(y), -1.0, 0.72 - 0.24 * rise, f)
    inner = (
        0.016
        + 0.03 * smooth(0.5, 0.0, rise) * draws_of(int(look[7]), int(look[7]), int(look[7]), 1.0)[0]
    )
    colour = mixed(colour, (inner, inner, inner * 1.1), glass)
    return colour[0], colour[1], colour[2], 0.07 + 0.13 * glass


@compiled
def _coach(
    tile: Float32, look: Float64, x: float, y: float, z: float, nx: float, ny: float, f: float
) -> Paint:
    """Paint a bus, a van or a lorry; detail: half length, half width, glass from and to."""
    base = times((look[0], look[1], look[2]), 1.0 + 0.12 * noise(tile, x + y, z, 4.0, f))
    length, width, low, high = look[3], look[4], look[5], look[6]
    colour = times(base, 1.0 - 0.45 * smooth(0.9, 0.3, z))
    glass, mirror = 0.0, 0.05
    if abs(ny) > 0.5 and high > low:
        glass = band(z, low, high, f) * (1.0 - stripe(x + length, 1.45, 0.0, 0.12, f))
        glass *= band(abs(x), -1.0, length - 0.25, f)
        trim = band(z, low - 0.5, low - 0.35, f)
        colour = mixed(colour, (0.65, 0.65, 0.6), 0.7 * trim)
        for axle in range(2):
            at = length * (0.62 if axle == 0 else -0.58)
            gap = math.hypot(x - at, z - 0.48) - 0.54
            colour = mixed(colour, (0.012, 0.012, 0.012), smooth(f, -f, gap))
    elif abs(nx) > 0.5:
        reach = width - 0.14
        if high > low:
            glass = band(z, low - (0.35 if nx > 0 else 0.0), high, f) * band(abs(y), -1, reach, f)
        colour = mixed(colour, (0.02, 0.02, 0.02), band(z, 0.0, 0.5, f))
        lamp = band(abs(y), width - 0.42, width - 0.12, f) * band(z, 0.62, 0.80, f)
        tint = (0.8, 0.82, 0.85) if nx > 0 else (0.42, 0.015, 0.012)
        colour = mixed(colour, tint, lamp)
        plate = band(abs(y), -1.0, 0.26, f) * band(z, 0.52, 0.63, f)
        colour = mixed(colour, (0.7, 0.7, 0.64), plate)
    if high <= low:
        rib = stripe(x + y, 0.6, 0.0, 0.03, f)
        colour = times(colour, 1.0 - 0.18 * rib)
    colour = mixed(colour, (0.02, 0.021, 0.024), glass)
    return colour[0], colour[1], colour[2], mirror + 0.15 * glass


@compiled
def _sign(look: Float64, y: float, z: float, front: bool, f: float) -> Paint:
    """Paint a plate; y, z from its middle; detail: kind, radius or half width, half height."""
    if not front:
        return 0.30, 0.31, 0.32, 0.05
    kind, radius, tall = int(look[3]), look[4], look[5]
    r = math.hypot(y, z)
    white, red, blue, black = (0.80, 0.80, 0.78), (0.55, 0.02, 0.02), (0.02, 0.10, 0.42), 0.02
    if kind == 0:
        colour = mixed(red, white, band(r, -1.0, radius * 0.76, f))
        # A thirty: two right halves of rings, then an oval; the reader's right is -y.
        right, unit = -y / radius, f / radius
        rounds = abs(math.hypot(right + 0.24, abs(z) / radius - 0.17) - 0.16)
        three = band(rounds, -1.0, 0.055, unit) * band(right, -0.27, 1.0, unit)
        oval = abs(math.hypot((right - 0.24) * 1.75, z / radius) - 0.31)
        ink = max(three, band(oval, -1.0, 0.075, unit))
        colour = mixed(colour, (black, black, black), ink)
    elif kind == 1:
        colour = mixed(white, blue, band(r, -1.0, radius * 0.93, f))
        shaft = band(abs(y), -1.0, radius * 0.13, f) * band(z, -0.62 * radius, 0.2 * radius, f)
        head = band(abs(y), -1.0, max(0.0, (0.66 * radius - z) * 0.8), f)
        head *= band(z, 0.1 * radius, 0.66 * radius, f)
        colour = mixed(colour, white, max(shaft, head))
    elif kind == 2:
        colour = mixed(
            white, blue, band(abs(y), -1, radius - 0.03, f) * band(abs(z), -1, tall - 0.03, f)
        )
        figure = band(abs(y), -1.0, max(0.0, (0.5 * tall - z) * 0.55), f)
        figure *= band(abs(z), -1.0, 0.5 * tall, f)
        colour = mixed(colour, white, figure)
    else:
        colour = mixed(
            (0.85, 0.85, 0.82), (0.90, 0.62, 0.03), band(abs(y) + abs(z), -1, radius * 0.95, f)
        )
    return colour[0], colour[1], colour[2], 0.04


@compiled
def _signal(look: Float64, y: float, z: float, front: bool, f: float) -> Paint:
    """Paint a traffic light's housing; y, z from its middle; detail: which lamp is lit."""
    colour, mirror = (0.022, 0.026, 0.024), 0.04
    if front:
        for lamp in range(3):
            r = math.hypot(y, z - 0.29 * (1 - lamp))
            on = abs(look[3] - lamp) < 0.5
            red, amber, green = (1.0, 0.05, 0.03), (1.0, 0.45, 0.02), (0.05, 1.0, 0.45)
            tint = red if lamp == 0 else (amber if lamp == 1 else green)
            tint = times(tint, 1.6 if on else 0.05)
            colour = mixed(colour, (0.008, 0.008, 0.008), smooth(0.13 + f, 0.13 - f, r))
            colour = mixed(colour, tint, smooth(0.105 + f, 0.105 - f, r))
    return colour[0], colour[1], colour[2], mirror


@compiled
def _tyre(s: Float64, x: float, y: float, z: float, ny: float, f: float) -> Paint:
    r = math.hypot(x - s[0], z - s[2]) / s[3]
    colour = (0.022, 0.022, 0.023)
    if abs(ny) > 0.5:
        angle = math.atan2(z - s[2], x - s[0])
        spoke = 0.5 + 0.5 * math.sin(5.0 * angle)
        rim = smooth(0.66 + f, 0.66 - f, r)
        metal = 0.10 + 0.30 * smooth(0.3, 0.6, spoke) + 0.2 * smooth(0.3, 0.2, r)
        colour = mixed(colour, (metal, metal, metal * 1.03), rim)
    return colour[0], colour[1], colour[2], 0.03


@compiled
def _fabric(tile: Float32, look: Float64, x: float, y: float, z: float, f: float) -> Paint:
    fold = noise(tile, x * 2.0 + y, z + look[7], 1.6, f) + 0.6 * noise(tile, x - y, z, 0.35, f)
    colour = times((look[0], look[1], look[2]), 1.0 + look[3] * 0.55 * fold)
    return colour[0], colour[1], colour[2], 0.01


@compiled
def _plain(
    tile: Float32, look: Float64, u: float, z: float, fu: float, fv: float, rough: float
) -> Paint:
    f = math.sqrt(fu * fv)
    grain = noise(tile, u, z + look[7], 1.4, f) + 0.7 * noise(tile, u + look[7], z, 6.0, f)
    colour = times((look[0], look[1], look[2]), 1.0 + rough * grain)
    return colour[0], colour[1], colour[2], look[3]


@compiled
def _bark(tile: Float32, look: Float64, x: float, y: float, z: float, f: float) -> Paint:
    around = math.atan2(y, x) * 0.25
    ridge = noise(tile, around * 3.0, z * 0.5, 0.7, f) + 0.6 * noise(tile, around, z, 0.25, f)
    colour = times((look[0], look[1], look[2]), 1.0 + 0.7 * ridge)
    moss = smooth(0.0, 0.6, noise(tile, around, z, 4.0, f))
    colour = mixed(colour, (0.09, 0.10, 0.05), 0.5 * moss)
    return colour[0], colour[1], colour[2], 0.0


@compiled
def _wood(tile: Float32, look: Float64, u: float, z: float, fu: float, fv: float) -> Paint:
    f = math.sqrt(fu * fv)
    plank_index = math.floor(u / 0.14)
    plank = draws_of(plank_index, plank_index, plank_index, look[7])
    tint = 1.0 + 0.35 * (plank[0] - 0.5) * smooth(0.3, 0.05, fu)
    tint *= 1.0 + 0.45 * noise(tile, u * 5.0, z * 0.5, 1.7, f)
    tint *= 1.0 - 0.75 * stripe(u, 0.14, 0.0, 0.014, fu)
    colour = times((look[0], look[1], look[2]), tint)
    return colour[0], colour[1], colour[2], 0.0


@compiled
def paint(
    tile: Float32,
    material: int,
    look: Float64,
    s: Float64,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    fx: float,
    fy: float,
    fz: float,
) -> Paint:
    """Return the paint of a part at a point of its surface.

    Args:
        tile: From `noise_tile`.
        material: Index into `street_parts.MATERIALS`.
        look: (8,) of the part.
        s: (8,) shape of the part.
        x: Point in the object's frame, metres.
        y: The same.
        z: The same.
        nx: Normal in the object's frame.
        ny: The same.
        nz: The same.
        fx: Footprint of the pixel along the object's x, metres.
        fy: Along y.
        fz: Along z.
    """
    side = abs(nx) > abs(ny)
    u, fu = (y, fy) if side else (x, fx)
    f = math.sqrt(fu * fz)
    if material == 1:
        if nz > 0.7:
            return _plain(tile, look, x, y, fx, fy, 0.2)
        shifted = u - s[1] if side else u
        return facade_paint(tile, look, shifted, z, (not side) and ny < 0.0, fu, fz)
    if material == 2:
        c = roof_paint(tile, look, x, (y if abs(ny) < 0.9 else z), fx, max(fy, fz))
        return c[0], c[1], c[2], 0.0
    if material == 5:
        return _bark(tile, look, x, y, z, f)
    if material == 7:
        return _car_body(tile, look, x, y, z, nx, ny, f)
    if material == 8:
        return _car_cabin(look, x, y, z, nx, ny, nz, f)
    if material == 9:
        return _tyre(s, x, y, z, ny, f)
    if material == 10:
        return _coach(tile, look, x, y, z, nx, ny, f)
    if material == 11:
        return _fabric(tile, look, x, y, z, f)
    if material == 12:
        return _signal(look, y - s[1], z - s[2], nx < -0.5, f)
    if material == 13:
        # A hull has no middle of its own; its look tells the height.
        hull = look[6] > 0.0
        return _sign(look, y if hull else y - s[1], z - (look[6] if hull else s[2]), nx < -0.5, f)
    if material == 14:
        return _wood(tile, look, u, z, fu, fz)
    if material == 15:
        c = brickwork(tile, (look[0], look[1], look[2]), u, z, fu, fz)
        return c[0], c[1], c[2], 0.0
    if nz > 0.7:
        return _plain(tile, look, x, y, fx, fy, 0.3)
    return _plain(tile, look, u, z, fu, fz, 0.3)
