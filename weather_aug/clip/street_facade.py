"""How houses are painted: storeys, windows, doors, shops, brick, roofs (numba)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.street_shapes import draws_of
from weather_aug.clip.street_texture import band, grain, mixed, noise, smooth, stripe, times

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Colour = tuple[float, float, float]
Draws = tuple[float, float, float, float, float, float]
Paint = tuple[float, float, float, float]


@compiled
def brickwork(tile: Float32, albedo: Colour, u: float, z: float, fu: float, fv: float) -> Colour:
    """Return the albedo of a brick wall: rows of 7.5 cm, bricks of 25 cm, mortar of 1 cm."""
    row = math.floor(z / 0.075)
    shifted = u + 0.125 * (row & 1)
    fade = smooth(0.25, 0.03, math.sqrt(fu * fv))
    word = draws_of(math.floor(shifted / 0.25), row, row, 11.0)
    tint = 1.0 + fade * 0.55 * (word[0] - 0.5)
    f = math.sqrt(fu * fv)
    tint *= 1.0 + 0.25 * noise(tile, u, z, 5.0, f) + 0.2 * noise(tile, u, z, 0.6, f)
    mortar = max(stripe(z, 0.075, 0.0, 0.011, fv), stripe(shifted, 0.25, 0.0, 0.011, fu))
    grey = 0.34 * (1.0 + 0.2 * noise(tile, u, z, 1.3, f))
    return mixed(times(albedo, tint), (grey, grey * 0.96, grey * 0.9), mortar * 0.8)


@compiled
def _wall(
    tile: Float32, look: Float64, u: float, z: float, height: float, fu: float, fv: float
) -> Colour:
    f = math.sqrt(fu * fv)
    shift = look[7] * 3.7
    albedo = (look[0], look[1], look[2])
    if look[5] > 0.5:
        colour = brickwork(tile, albedo, u, z, fu, fv)
    else:
        fine = 0.09 * grain(tile, u, z + shift, 1.6, f)
        blotch = 0.13 * noise(tile, u + shift, z, 7.0, f)
        colour = times(albedo, 1.0 + fine + blotch)
    # Rain draws vertical streaks below the eaves, splashes dirty the foot.
    streak = smooth(-0.1, 0.8, noise(tile, u + shift, z * 0.08, 3.0, fu))
    damp = smooth(3.5, 0.0, height - z) * 0.35 + 0.10
    splash = smooth(1.3, 0.0, z + 0.5 * noise(tile, u, shift, 2.0, f))
    return times(colour, (1.0 - streak * damp) * (1.0 - 0.32 * splash))


@compiled
def _goods(tile: Float32, key: float, x: float, y: float, fu: float, fv: float) -> Colour:
    """Return what stands in a shop window: shelves of coloured things under warm lamps."""
    f = math.sqrt(fu * fv)
    shelf = math.floor(y / 0.62)
    width = 0.18 + 0.25 * draws_of(shelf, shelf, shelf, key)[0]
    thing = draws_of(math.floor(x / width), shelf, shelf, key)
    high = 0.15 + 0.4 * thing[0]
    hue = (thing[1], thing[2], thing[3])
    colour = (0.05 + 0.22 * hue[0], 0.05 + 0.17 * hue[1], 0.04 + 0.16 * hue[2])
    room = 0.035 + 0.03 * noise(tile, x, y, 5.0, f)
    back = mixed((room, room, room), (0.20, 0.17, 0.12), smooth(1.2, 2.4, y))
    at = y - 0.62 * shelf
    shown = band(at, 0.0, high, fv) * stripe(x, width, 0.02, width - 0.03, fu)
    shown *= smooth(1.9, 1.2, y) * smooth(0.25, 0.06, fu)
    return mixed(back, colour, shown * (1.0 if thing[4] < 0.75 else 0.0))


@compiled
def _window(
    tile: Float32,
    word: Draws,
    base: Colour,
    frame: Colour,
    x: float,
    y: float,
    half: float,
    height: float,
    panes: float,
    fu: float,
    fv: float,
) -> Paint:
    """Lay a window over the wall; x from its middle, y from its sill, metres."""
    surround = band(x, -half - 0.14, half + 0.14, fu) * band(y, -0.02, height + 0.18, fv)
    colour = mixed(base, mixed(base, (0.62, 0.60, 0.55), 0.75), surround)
    sill = band(x, -half - 0.2, half + 0.2, fu) * band(y, -0.12, 0.0, fv)
    below = band(x, -half - 0.2, half + 0.2, fu) * band(y, -0.26, -0.12, fv)
    colour = times(mixed(colour, (0.55, 0.53, 0.50), sill), 1.0 - 0.45 * below)
    opening = band(x, -half, half, fu) * band(y, 0.0, height, fv)
    if opening <= 0.0:
        return colour[0], colour[1], colour[2], 0.0
    width = 2.0 * half
    pane_w, pane_h = width / max(1.0, math.floor(width / 0.62)), height / panes
    glass = 1.0 - stripe(x + half + 0.035, pane_w, 0.0, 0.07, fu)
    glass *= 1.0 - stripe(y + 0.03, pane_h, 0.0, 0.06, fv)
    glass *= band(x, -half + 0.07, half - 0.07, fu) * band(y, 0.07, height - 0.07, fv)
    room = 0.018 + 0.035 * word[2]
    dark = (room, room * 1.02, room * 1.1)
    # Curtains at the sides or a blind from above.
    kind = word[3]
    drop = height * word[4]
    if half > 1.0:
        dark = _goods(tile, 1024.0 * word[1], x, y, fu, fv)
    elif kind < 0.30:
        dark = mixed(dark, (0.42, 0.40, 0.36), band(y, height - 0.6 * drop, height, fv))
    elif kind < 0.70:
        reach = half * (0.35 + 0.4 * word[5])
        fold = 0.30 * (1.0 + 0.25 * math.sin(x * 55.0) * smooth(0.1, 0.02, fu))
        veil = band(abs(x), reach, half, fu)
        dark = mixed(dark, (fold, fold * 0.97, fold * 0.9), veil * 0.8)
    # The reveal throws its shade on the upper and one side edge.
    shade = max(band(y, height - 0.16, height, fv), band(x, -half, -half + 0.10, fu))
    inner = mixed(frame, dark, glass)
    inner = times(inner, 1.0 - 0.6 * shade)
    colour = mixed(colour, inner, opening)
    return colour[0], colour[1], colour[2], 0.30 * glass * opening * (1.0 - 0.5 * shade)


@compiled
def _street_level(
    tile: Float32,
    look: Float64,
    base: Colour,
    frame: Colour,
    u: float,
    z: float,
    bay: int,
    x: float,
    bay_width: float,
    fu: float,
    fv: float,
) -> Paint:
    """Paint the lowest storey of a front: a shop, or flats with a door."""
    seed = look[7]
    word = draws_of(bay, bay, bay, seed)
    own = draws_of(int(seed), int(seed), int(seed), 5.0)
    accent = mixed((0.05, 0.10, 0.08), (0.20, 0.06, 0.05), own[0])
    accent = mixed(accent, (0.06, 0.09, 0.17), own[1])
    accent = mixed(accent, (0.34, 0.32, 0.27), own[2] ** 2)
    f = math.sqrt(fu * fv)
    accent = times(accent, 1.0 + 0.2 * noise(tile, u, z, 1.9, f))
    if look[6] > 0.5:
        half = 0.5 * bay_width - 0.16
        sign = band(z, 3.05, 3.75, fv)
        colour = mixed(base, accent, band(z, 0.0, 3.05, fv))
        r, g, b, mirror = _window(
            tile, word, colour, times(accent, 0.5), x, z - 0.55, half, 2.4, 1.0, fu, fv
        )
        colour = mixed((r, g, b), times(accent, 1.4), sign)
        # Letters, as far as they can be told apart.
        letter = math.floor(u / 0.16)
        glyph = draws_of(letter, letter, letter, seed)
        stroke = stripe(u, 0.32, 0.03, 0.17 + 0.1 * glyph[0], fu)
        text = band(z, 3.24, 3.58, fv) * stroke * (1.0 if own[3] < 0.9 else 0.0)
        gap = 0.0 if glyph[1] < 0.25 else 1.0
        colour = mixed(colour, (0.65, 0.63, 0.55), text * gap * band(x, -half, half, fu) * 0.9)
        colour = times(colour, 1.0 - 0.5 * band(z, 2.9, 3.05, fv))
        return colour[0], colour[1], colour[2], mirror * (1.0 - sign)
    door_bay = int(own[4] * 3.0)
    if bay == door_bay:
        way = band(x, -0.62, 0.62, fu) * band(z, 0.0, 2.7, fv)
        surround = band(x, -0.82, 0.82, fu) * band(z, 0.0, 2.92, fv)
        panel = stripe(x + 0.62, 0.62, 0.09, 0.53, fu) * stripe(z, 1.0, 0.12, 0.88, fv)
        colour = mixed(base, (0.50, 0.48, 0.44), surround)
        leaf = times(accent, 0.55 + 0.25 * panel)
        light = band(z, 2.15, 2.6, fv) * band(x, -0.52, 0.52, fu)
        colour = mixed(colour, mixed(leaf, (0.03, 0.03, 0.035), light), way)
        step = band(z, 0.0, 0.26, fv) * band(x, -0.9, 0.9, fu)
        colour = mixed(colour, (0.42, 0.41, 0.39), step)
        return colour[0], colour[1], colour[2], 0.25 * light * way
    return _window(tile, word, base, frame, x, z - 1.15, 0.29 * bay_width, 1.75, 2.0, fu, fv)


@compiled
def facade_paint(
    tile: Float32, look: Float64, u: float, z: float, front: bool, fu: float, fv: float
) -> Paint:
    """Return albedo and mirror share of a house wall.

    Args:
        tile: From `noise_tile`.
        look: (8,) albedo, width m, height m, brick, shop, seed.
        u: Along the wall from its middle, metres.
        z: Above the ground, metres.
        front: Whether the wall faces the street.
        fu: Footprint along the wall, metres.
        fv: Footprint up the wall, metres.
    """
    width, height, seed = look[3], look[4], look[7]
    own = draws_of(int(seed), int(seed), int(seed), 3.0)
    colour = _wall(tile, look, u, z, height, fu, fv)
    if not front:
        if own[0] < 0.5:
            return colour[0], colour[1], colour[2], 0.0
    plinth = band(z, -1.0, 0.6, fv)
    f = math.sqrt(fu * fv)
    colour = mixed(colour, times((0.22, 0.21, 0.20), 1.0 + 0.3 * noise(tile, u, z, 2.0, f)), plinth)
    bays = max(2.0, math.floor(width / (2.3 + 0.9 * own[1]) + 0.5))
    bay_width = width / bays
    at = (u + 0.5 * width) / bay_width
    bay = math.floor(at)
    x = (at - bay - 0.5) * bay_width
    light_frame = own[2] < 0.7
    frame = (0.62, 0.61, 0.58) if light_frame else (0.10, 0.085, 0.07)
    upper = height - 4.0 - 0.7
    storeys = max(1.0, math.floor(upper / 3.05))
    storey = upper / storeys
    course = band(z, 3.78, 4.0, fv)
    shadow = band(z, 3.62, 3.78, fv)
    if z < 3.62:
        if front:
            return _street_level(tile, look, colour, frame, u, z, bay, x, bay_width, fu, fv)
        return colour[0], colour[1], colour[2], 0.0
    colour = times(mixed(colour, (0.52, 0.50, 0.46), course * 0.8), 1.0 - 0.4 * shadow)
    level = math.floor((z - 4.0) / storey)
    y = z - 4.0 - level * storey
    if level < 0.0 or level >= storeys:
        return colour[0], colour[1], colour[2], 0.0
    half = (0.21 + 0.08 * own[3]) * bay_width
    tall = (0.50 + 0.14 * own[4]) * storey
    panes = 2.0 if own[5] < 0.7 else 1.0
    word = draws_of(bay, level, 1 if front else 2, seed)
    return _window(tile, word, colour, frame, x, y - 0.24 * storey, half, tall, panes, fu, fv)


@compiled
def roof_paint(tile: Float32, look: Float64, u: float, v: float, fu: float, fv: float) -> Colour:
    """Return the albedo of roof tiles; v runs down the slope, metres."""
    f = math.sqrt(fu * fv)
    row = math.floor(v / 0.3)
    word = draws_of(math.floor(u / 0.22), row, row, look[7])
    fade = smooth(0.5, 0.08, f)
    tint = 1.0 + fade * 0.35 * (word[0] - 0.5) + 0.3 * noise(tile, u, v, 8.0, f)
    tint *= 1.0 - 0.45 * stripe(v, 0.3, 0.0, 0.05, fv) - 0.2 * stripe(u, 0.22, 0.0, 0.03, fu)
    return times((look[0], look[1], look[2]), tint)
