"""Which drops are on the glass at a moment, where they are, and what of them is drawn."""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug._keys import key_of
from weather_aug.clip.types import Camera
from weather_aug.particles.kernels import GOLDEN, mix64
from weather_aug.render import lens_refraction as columns
from weather_aug.render.lens_refraction import COLUMNS, DISCS, MERGE
from weather_aug.render.lens_wiper import GLASS_M, Wiper, confusion_px
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

CYCLE_S = 4.0
"""Each slot of the glass holds at most one drop in so long a time."""
SHORTEST_S, LONGEST_S = 0.5, 4.0
"""Life of a drop, evenly distributed."""
DRAWS = 24
"""Uniform numbers that make a drop."""
SLOTS = 4096
"""Places for drops; many, so that the count is nearly Poisson."""
MEDIAN_RADIUS, SPREAD = 0.008, 0.5
"""Median of the drops' radii over the picture's width, and standard deviation of its logarithm."""
MAIN_DISC = 0.75
"""Radius of a drop's main disc over the drop's: merged ones make up for the rest."""
STRETCH = 1.2
OPACITY_RANGE = (0.55, 0.9)
CONTACT_RAD = (0.35, 0.87)
"""Range of the angle between glass and drop at the rim."""
WATER_INDEX = 1.333
LEAST_MINIFICATION = 4.0
FASTEST_SLIDE_M_PER_S = 0.03
UPHILL_M_PER_S = 20.0
"""Speed of the car from which the airflow pushes drops upwards."""
GROWN_S, FADED_S = 0.25, 0.3
"""How long a drop takes to land and to go."""
BEADS = 6
"""Drops that a runner leaves behind, at most."""
_MARGIN = (0.05, 0.15)
"""How far beyond the picture's sides drops land, as shares of width and height."""


class Drops(NamedTuple):
    """The drops on a glass at one moment; N of them."""

    slots: NDArray[np.int64]
    """(N,) who is who from frame to frame, ascending."""
    ages_s: Float64
    """(N,)."""
    places_px: Float64
    """(N, 2) centres, (x, y) in the picture's pixels."""
    radii_px: Float64
    """(N,) of their main discs."""
    rows: Float32
    """(M, COLUMNS) what the kernel draws: the drops, and what runners leave behind."""


def drops_on(
    camera: Camera, weather: Weather, seed: int, time_s: float, glass: int, wiper: Wiper | None
) -> Drops:
    """The drops on the glass at a moment.

    Args:
        camera: Of the whole picture.
        weather: Its `lens_drops` is how many to expect in the picture.
        seed: Which.
        time_s: When.
        glass: Which one.
        wiper: What clears them; None for nothing.
    """
    key = np.uint64(key_of("lens-drops", seed, glass) % 2**64)
    share_alive = 0.5 * (SHORTEST_S + LONGEST_S) / CYCLE_S
    share_inside = 1 / ((1 + 2 * _MARGIN[0]) * (1 + 2 * _MARGIN[1]))
    chance = weather.lens_drops / (SLOTS * share_alive * share_inside)
    found = np.empty((SLOTS, 3 + DRAWS))
    found = found[: alive(key, time_s, chance, SLOTS, found)]
    motion = _motion_of(found, camera)
    if wiper is not None and len(found):
        here, there = motion.places_px, _landing_px(found, camera)
        gone = wiper.cleared(here[:, 0], here[:, 1], found[:, 1])
        gone |= wiper.cleared(there[:, 0], there[:, 1], found[:, 1])
        found, motion = found[~gone], _Motion(*(values[~gone] for values in motion))
    bodies = _bodies(found, motion, camera)
    radius = bodies[:, columns.RADIUS]
    ran = np.abs(motion.slid_px) > radius
    left = _left_behind(bodies[ran], motion.slid_px[ran], found[ran, 3:])
    # A runner's tail lies under it.
    rows = _finished(np.concatenate([left, bodies]), camera)
    return Drops(found[:, 0].astype(np.int64), found[:, 1], motion.places_px, radius, rows)


class _Motion(NamedTuple):
    """How drops slide."""

    ratios: Float64
    """(N,) radius over the median."""
    slants: Float64
    """(N,) pixels to the right per pixel down."""
    slid_px: Float64
    """(N,) since they landed, down if positive."""
    places_px: Float64
    """(N, 2) where they are."""


def _motion_of(found: Float64, camera: Camera) -> _Motion:
    draws = found[:, 3:]
    ratio = np.interp(draws[:, 2], *_radius_quantiles())
    # The rim of a small drop holds it: only large ones run.
    loose = np.clip((ratio - 0.8) / 0.8, 0.0, 1.0)
    slide_m_per_s = FASTEST_SLIDE_M_PER_S * draws[:, 3] ** 3 * loose
    speed = float(np.linalg.norm(camera.velocity_m_per_s))
    down = float(np.clip((UPHILL_M_PER_S - speed) / 2.0, -1.0, 1.0))
    slid = slide_m_per_s * found[:, 1] * down * camera.focal_px[1] / GLASS_M
    slant = 0.3 * (draws[:, 7] - 0.5)
    place = _landing_px(found, camera)
    start, span = _MARGIN[1] * camera.height, (1 + 2 * _MARGIN[1]) * camera.height
    # What runs out of the glass comes in again at its other end: the mean number stays.
    place[:, 1] = np.mod(place[:, 1] + 0.5 + slid + start, span) - start - 0.5
    place[:, 0] += slant * slid
    return _Motion(ratio, slant, slid, place)


def _landing_px(found: Float64, camera: Camera) -> Float64:
    """(N, 2) where drops have landed."""
    size = np.array([camera.width, camera.height])
    margin = np.array(_MARGIN)
    return ((1 + 2 * margin) * found[:, 3:5] - margin) * size - 0.5


def _bodies(found: Float64, motion: _Motion, camera: Camera) -> Float64:
    """(N, COLUMNS) the drops themselves, but for what `_finished` fills in."""
    age_s, life_s, draws = found[:, 1], found[:, 2], found[:, 3:]
    grown = _smooth((age_s + 0.05) / GROWN_S)
    presence = grown * _smooth((life_s - age_s) / FADED_S)
    radius = MAIN_DISC * MEDIAN_RADIUS * camera.width * motion.ratios * (0.55 + 0.45 * grown)
    bodies = np.zeros((len(found), COLUMNS))
    bodies[:, columns.X], bodies[:, columns.Y] = motion.places_px.T
    bodies[:, columns.RADIUS], bodies[:, columns.STRETCH] = radius, STRETCH
    bodies[:, columns.SLANT] = motion.slants
    low, high = OPACITY_RANGE
    bodies[:, columns.OPACITY] = (low + (high - low) * draws[:, 4]) * presence
    bodies[:, columns.GAIN] = 0.9 + 0.2 * draws[:, 6]
    low, high = CONTACT_RAD
    bend_rad = (WATER_INDEX - 1) * (low + (high - low) * draws[:, 5])
    bodies[:, columns.REACH] = bend_rad * camera.focal_px[0]
    _merge(bodies, radius, draws)
    return bodies


def _merge(bodies: Float64, radius: Float64, draws: Float64) -> None:
    """Write one to three discs that have merged with each main one."""
    count = 1 + np.floor(draws[:, 8] * DISCS)
    for k in range(DISCS):
        angle, away, size = (draws[:, 9 + 3 * k + i] for i in range(3))
        start = columns.SIZE + 1 + 3 * k
        reach = (0.45 + 0.55 * away) * radius
        bodies[:, start] = np.cos(2 * np.pi * angle) * reach
        bodies[:, start + 1] = np.sin(2 * np.pi * angle) * reach
        bodies[:, start + 2] = np.where(k < count, (0.5 + 0.45 * size) * radius, 0.0)


def _left_behind(runners: Float64, slid: Float64, draws: Float64) -> Float64:
    """The film and the beads behind drops that have slid by (N,) pixels, down if positive."""
    radius, sign = runners[:, columns.RADIUS], np.sign(slid)
    length = np.minimum(np.abs(slid), 9 * radius)
    film = _single(runners, 0.42 * radius, -sign * (0.5 * length + 0.3 * radius), 0.45)
    film[:, columns.STRETCH] = (0.5 * length + radius) / film[:, columns.RADIUS]
    rows = [film]
    spacing = (1.8 + 1.2 * draws[:, 18]) * radius
    for k in range(BEADS):
        number = np.floor(np.abs(slid) / spacing) - k
        behind = np.abs(slid) - number * spacing
        jitter = np.mod(number * 0.754877666 + draws[:, 19], 1.0)
        fading = np.clip(1.0 - behind / (BEADS * spacing), 0.0, 1.0)
        bead = _single(runners, (0.18 + 0.2 * jitter) * radius, -sign * behind, 0.9 * fading)
        bead[:, columns.X] += (jitter - 0.5) * 0.3 * radius
        rows.append(bead[number >= 1])
    return np.concatenate(rows)


def _single(runners: Float64, radius: Float64, below: Float64, share: Float64 | float) -> Float64:
    """Single discs in the wake of runners, so far below them, of a share of their opacity."""
    rows = runners.copy()
    rows[:, columns.Y] += below
    rows[:, columns.X] += rows[:, columns.SLANT] * below
    rows[:, columns.RADIUS] = radius
    rows[:, columns.OPACITY] *= share
    rows[:, columns.SIZE + 1 :] = 0.0
    return rows


def _finished(rows: Float64, camera: Camera) -> Float32:
    """Fill in what follows from a drop's size and the camera, and leave out what cannot be seen."""
    radius = rows[:, columns.RADIUS]
    confusion = confusion_px(camera)
    # The rim is thin, and the grid of pixels must not show.
    soft = np.sqrt(confusion**2 + (0.35 * radius) ** 2 + 1.5**2)
    rows[:, columns.SOFT] = soft
    # Blur keeps the light: what is smaller than the blur becomes fainter.
    rows[:, columns.OPACITY] *= radius**2 / (radius**2 + (0.25 * soft) ** 2)
    rows[:, columns.REACH] = np.maximum(rows[:, columns.REACH], LEAST_MINIFICATION * radius)
    blur = np.maximum(0.5 * radius, 0.5 * confusion * rows[:, columns.REACH] / radius)
    rows[:, columns.BLUR] = blur
    discs = rows[:, columns.SIZE + 1 :].reshape(len(rows), DISCS, 3)
    outline = np.hypot(discs[..., 0], discs[..., 1]) + discs[..., 2]
    outline = np.maximum(outline.max(axis=1, initial=0.0), radius)
    bulge = 0.25 * MERGE * radius * (discs[..., 2] > 0).sum(axis=1)
    rows[:, columns.SIZE] = outline + 0.5 * soft + bulge + 1.0
    tall = rows[:, columns.SIZE] * rows[:, columns.STRETCH]
    wide = rows[:, columns.SIZE] + np.abs(rows[:, columns.SLANT]) * tall
    x, y = rows[:, columns.X], rows[:, columns.Y]
    seen = (x + wide >= 0) & (x - wide < camera.width) & (y + tall >= 0)
    seen &= (y - tall < camera.height) & (rows[:, columns.OPACITY] > 1 / 255)
    return rows[seen].astype(np.float32)


@compiled
def alive(key: np.uint64, time_s: float, chance: float, slots: int, out: Float64) -> int:
    """Enumerate the drops that are on the glass at a time.

    A slot's time is cut into cycles of `CYCLE_S` that start at a moment of its own; each cycle
    holds a drop, from the cycle's start, if a hash of slot and cycle is below `chance`. So any
    moment can be looked up alone, and a higher chance adds drops to those already there.

    Args:
        key: uint64 of the glass.
        time_s: Moment.
        chance: In [0, 1], of a cycle to hold a drop.
        slots: How many there are.
        out: (N, 3 + DRAWS) float64: slot, age in s, life in s, uniform numbers in [0, 1).

    Returns:
        Number of drops; those beyond N are counted, not written.
    """
    found = 0
    unit = 2.0**-53
    for slot in range(slots):
        base = mix64(key + np.uint64(slot + 1) * GOLDEN)
        turns = time_s / CYCLE_S + np.float64(base >> np.uint64(11)) * unit
        cycle = np.floor(turns)
        word = mix64(base ^ mix64(np.uint64(np.int64(cycle)) + GOLDEN))
        if np.float64(word >> np.uint64(11)) * unit >= chance:
            continue
        age_s = (turns - cycle) * CYCLE_S
        share = np.float64(mix64(word + GOLDEN) >> np.uint64(11)) * unit
        life_s = SHORTEST_S + (LONGEST_S - SHORTEST_S) * share
        if age_s >= life_s:
            continue
        if found < out.shape[0]:
            out[found, 0], out[found, 1], out[found, 2] = slot, age_s, life_s
            for k in range(DRAWS):
                draw = mix64(word + np.uint64(k + 2) * GOLDEN)
                out[found, 3 + k] = np.float64(draw >> np.uint64(11)) * unit
        found += 1
    return found


def _smooth(t: Float64) -> Float64:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@lru_cache(maxsize=1)
def _radius_quantiles() -> tuple[Float64, Float64]:
    """Shares of the drops, and radius over the median below which they are; cut at 2.9 sigma."""
    shares = (np.arange(257) + 0.5) / 257
    normal = NormalDist()
    return shares, np.exp([SPREAD * normal.inv_cdf(share) for share in shares])
