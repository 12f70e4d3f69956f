"""What the ground is and how it is painted: road marks, kerbs, grass, slabs (numba)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.street_path import Section
from weather_aug.clip.street_shapes import draws_of
from weather_aug.clip.street_texture import band, grain, mixed, noise, smooth, stripe, times

Float32 = NDArray[np.float32]
Colour = tuple[float, float, float]


@compiled
def is_planted(section: Section, x: float, offset: float) -> bool:
    """Tell whether a point beside the road is grass: the strip with the trees, or a garden."""
    a = abs(offset)
    if a > section.facade_m:
        return True
    if not section.strip_inner_m < a < section.strip_outer_m:
        return False
    since = x - section.crossing_phase_m
    since -= section.crossing_period_m * math.floor(since / section.crossing_period_m)
    if since < section.crossing_width_m + 2.0 or since > section.crossing_period_m - 2.0:
        return False
    cell = math.floor(x / 6.0)
    paved = draws_of(cell, cell, 1 if offset > 0 else 2, 77.0)[0] < 0.22
    return not paved


@compiled
def _marks(section: Section, x: float, offset: float, fx: float, fd: float) -> float:
    """Return the share of the footprint that is white paint."""
    a = abs(offset)
    white = band(offset, -0.07, 0.07, fd) * stripe(x, 9.0, 0.0, 3.6, fx)
    edge = section.lane_edge_m
    white += band(a, edge - 0.09, edge + 0.09, fd)
    edge = section.cycle_edge_m
    white += band(a, edge - 0.06, edge + 0.06, fd) * stripe(x, 2.0, 0.0, 1.1, fx)
    since = x - section.crossing_phase_m
    since -= section.crossing_period_m * math.floor(since / section.crossing_period_m)
    if since < section.crossing_width_m + 0.5 or since > section.crossing_period_m - 3.0:
        white *= 0.0 if since < section.crossing_width_m + 0.5 else 1.0
        zebra = band(since, 0.0, section.crossing_width_m, fx) * stripe(offset, 1.0, 0.0, 0.5, fd)
        white += zebra * band(a, -1.0, section.kerb_m - 0.5, fd)
        stop = band(since, section.crossing_period_m - 1.6, section.crossing_period_m - 1.2, fx)
        lane = band(a, 0.1, section.lane_edge_m - 0.1, fd)
        # The stop line lies across the lane that drives towards the crossing.
        white += stop * lane * (1.0 if offset < 0.0 else 0.0)
    return min(white, 1.0)


@compiled
def _asphalt(
    tile: Float32, section: Section, x: float, offset: float, fx: float, fd: float
) -> Colour:
    f = math.sqrt(fx * fd)
    a = abs(offset)
    tone = 0.145 * (1.0 + 0.16 * noise(tile, x, offset, 37.0, f))
    tone *= 1.0 + 0.14 * noise(tile, x * 0.25, offset * 1.5, 11.0, f)
    # Aggregate: stones of one to two centimetres, no larger blobs.
    tone *= 1.0 + 0.32 * grain(tile, x, offset, 1.7, f) + 0.14 * noise(tile, x, offset, 3.1, f)
    lane = a - 1.7
    # Tyres polish two tracks a lane; oil drips between them.
    tone *= 1.0 + 0.09 * math.exp(-((abs(lane) - 0.75) ** 2) * 9.0)
    tone *= 1.0 - 0.12 * math.exp(-lane * lane * 10.0)
    cell = math.floor(x / 14.0)
    word = draws_of(cell, math.floor(offset / 3.5), cell, 5.0)
    if word[0] < 0.30:
        length = 2.0 + 6.0 * word[1]
        low = cell * 14.0 + 4.0 * word[2]
        base = math.floor(offset / 3.5) * 3.5 + 0.3 + 0.9 * word[3]
        patch = band(x, low, low + length, fx) * band(offset, base, base + 1.6, fd)
        seam = patch - band(x, low + 0.04, low + length - 0.04, fx) * band(
            offset, base + 0.04, base + 1.56, fd
        )
        tone *= 1.0 - 0.26 * patch - 0.35 * max(seam, 0.0)
    crack = abs(noise(tile, x + 3.0, offset * 1.3, 9.0, f))
    tone *= 1.0 - 0.30 * (1.0 - smooth(0.0, 0.03 + f * 0.3, crack)) * smooth(0.25, 0.0, f)
    colour = (tone * 1.0, tone * 0.985, tone * 0.97)
    gutter = band(a, section.kerb_m - 0.32, section.kerb_m, fd)
    stone = 0.24 * (1.0 + 0.35 * noise(tile, x, offset, 1.7, f))
    stone *= 1.0 - 0.4 * stripe(x, 0.5, 0.0, 0.02, fx)
    return mixed(colour, (stone, stone * 0.98, stone * 0.95), gutter)


@compiled
def _grass(tile: Float32, x: float, y: float, f: float) -> Colour:
    broad = noise(tile, x, y, 13.0, f)
    fine = 0.5 * noise(tile, x, y, 2.3, f) + 0.5 * grain(tile, x, y, 1.9, f)
    green = mixed((0.085, 0.135, 0.035), (0.150, 0.165, 0.055), 0.5 + 0.6 * broad)
    bare = smooth(0.30, 0.62, noise(tile, x + 5.0, y, 5.0, f) + 0.3 * fine)
    return times(mixed(green, (0.16, 0.125, 0.085), bare), 1.0 + 0.8 * fine)


@compiled
def _slabs(tile: Float32, x: float, offset: float, fx: float, fd: float) -> Colour:
    f = math.sqrt(fx * fd)
    row = math.floor(offset / 0.6)
    shifted = x + 0.3 * (row & 1)
    fade = smooth(1.2, 0.2, f)
    word = draws_of(math.floor(shifted / 0.6), row, row, 9.0)
    tone = 0.330 * (1.0 + fade * 0.22 * (word[0] - 0.5))
    tone *= 1.0 + 0.20 * noise(tile, x, offset, 9.0, f) + 0.20 * grain(tile, x, offset, 1.3, f)
    joint = max(stripe(shifted, 0.6, 0.0, 0.016, fx), stripe(offset, 0.6, 0.0, 0.016, fd))
    tone *= 1.0 - 0.55 * joint
    # Chewing gum and drips.
    spot = smooth(0.52, 0.66, noise(tile, x, offset, 3.1, f))
    tone *= 1.0 - 0.22 * spot
    warm = 0.03 * (word[1] - 0.5) * fade
    return tone * (1.02 + warm), tone * 0.985, tone * (0.93 - warm)


@compiled
def ground_paint(
    tile: Float32,
    section: Section,
    zone: int,
    x: float,
    offset: float,
    z: float,
    fx: float,
    fd: float,
) -> Colour:
    """Return the albedo of the ground.

    Args:
        tile: From `noise_tile`.
        section: The street across.
        zone: 1 road, 2 kerb face, 3 pavement, from `ground_hit`.
        x: Station, metres.
        offset: From the centre line, metres.
        z: Height, metres.
        fx: Footprint of the pixel along the street, metres.
        fd: Footprint across.
    """
    f = math.sqrt(fx * fd)
    a = abs(offset)
    if zone == 1:
        white = _marks(section, x, offset, fx, fd)
        base = _asphalt(tile, section, x, offset, fx, fd)
        if white <= 0.0:
            return base
        wear = 0.55 * smooth(0.18, 0.62, noise(tile, x, offset, 2.3, f) + 0.12)
        tone = 0.62 * (1.0 + 0.18 * noise(tile, x, offset, 0.7, f))
        return mixed(base, (tone, tone, tone * 0.96), white * (1.0 - wear))
    stone = 0.36 * (1.0 + 0.3 * noise(tile, x, offset + z, 1.3, f))
    stone *= 1.0 - 0.5 * stripe(x, 1.0, 0.0, 0.02, fx)
    kerb = (stone, stone * 0.98, stone * 0.94)
    if zone == 2:
        return times(kerb, 0.55 + 3.2 * z)
    if a > section.facade_m + 0.0:
        return _grass(tile, x, offset, f)
    slabs = _slabs(tile, x, offset, fx, fd)
    # Dirt gathers along the walls.
    slabs = times(slabs, 1.0 - 0.28 * smooth(0.7, 0.0, section.facade_m - a))
    if is_planted(section, x, offset):
        inside = band(a, section.strip_inner_m + 0.08, section.strip_outer_m - 0.08, fd)
        return mixed(kerb, _grass(tile, x, offset, f), inside)
    return mixed(slabs, kerb, band(a, section.kerb_m, section.kerb_m + 0.18, fd))
