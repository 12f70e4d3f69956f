"""What stands where along the street: an endless row of chunks, each a pure function of its key."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

from weather_aug.clip.street_ground import is_planted
from weather_aug.clip.street_models import (
    Draws,
    bollard,
    bush,
    fence,
    house,
    lamp,
    sign,
    traffic_light,
    tree,
)
from weather_aug.clip.street_movers import Size, bicycle, car, truck
from weather_aug.clip.street_parts import Parts, joined, placed
from weather_aug.clip.street_path import Curve, Section, centre_slope, centre_y, curve_of

CHUNK_M = 30.0
SECTION = Section()


class Actor(NamedTuple):
    """A tracked object at one moment."""

    track_id: int
    class_name: str
    parts: Parts
    """In the world."""
    position_world: tuple[float, float, float]
    """On the ground, under the middle."""
    yaw_rad: float
    size_m: Size
    velocity_m_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World axes."""


class Chunk(NamedTuple):
    """A piece of the street of `CHUNK_M`."""

    scenery: Parts
    actors: tuple[Actor, ...]
    """Parked."""


class Place(NamedTuple):
    """A point of the street, and which way the street runs there."""

    x: float
    y: float
    yaw_rad: float


def place_at(curve: Curve, station: float, offset: float) -> Place:
    """Return the world place at a station and an offset from the centre line, metres."""
    y = centre_y(curve, station) + offset
    return Place(station, y, math.atan(centre_slope(curve, station)))


@functools.lru_cache(maxsize=128)
def chunk(seed: int, index: int) -> Chunk:
    """Return chunk `index`, which reaches from station index * CHUNK_M to the next."""
    curve = curve_of(seed)
    pieces: list[Parts] = []
    actors: list[Actor] = []
    for side in (1, -1):
        draws = Draws.keyed("street-chunk", seed, index, side, count=2048)
        pieces += _lots(curve, draws, index, side)
        pieces += _strip(curve, draws, index, side)
        actors += _parked(curve, draws, index, side)
    pieces += _crossing(curve, index)
    return Chunk(joined(pieces), tuple(actors))


def _lots(curve: Curve, draws: Draws, index: int, side: int) -> list[Parts]:
    start = index * CHUNK_M
    split = start + draws.uniform(12.0, 18.0)
    pieces = [_standing(curve, draws, (start - 1.0, start + CHUNK_M + 1.0), side, 38.0, plain=True)]
    garden = draws.chance(0.30)
    which = draws.integer(2)
    for number, stretch in enumerate(((start, split), (split, start + CHUNK_M))):
        if garden and number == which:
            pieces += _garden(curve, draws, stretch, side)
            continue
        setback = draws.uniform(1.6, 3.0) if draws.chance(0.22) else 0.0
        line = SECTION.facade_m + setback
        pieces.append(_standing(curve, draws, stretch, side, line, plain=False))
        if setback:
            for _ in range(4):
                at = draws.uniform(stretch[0] + 1.0, stretch[1] - 1.0)
                spot = place_at(curve, at, side * (SECTION.facade_m + draws.uniform(0.5, 0.9)))
                pieces.append(placed(bush(draws), (spot.x, spot.y, 0.12), spot.yaw_rad))
    return pieces


def _chord(
    curve: Curve, stretch: tuple[float, float], side: int, line: float
) -> tuple[Place, float]:
    """Return the middle of a front between two stations, turned to face the street; its width."""
    a, b = (place_at(curve, station, side * line) for station in stretch)
    yaw = math.atan2(b.y - a.y, b.x - a.x) + (0.0 if side > 0 else math.pi)
    return Place((a.x + b.x) / 2, (a.y + b.y) / 2, yaw), math.hypot(b.x - a.x, b.y - a.y)


def _standing(
    curve: Curve,
    draws: Draws,
    stretch: tuple[float, float],
    side: int,
    line: float,
    *,
    plain: bool,
) -> Parts:
    spot, width = _chord(curve, stretch, side, line)
    return placed(house(draws, width, plain=plain), (spot.x, spot.y, 0.1), spot.yaw_rad)


def _garden(curve: Curve, draws: Draws, stretch: tuple[float, float], side: int) -> list[Parts]:
    spot, width = _chord(curve, stretch, side, SECTION.facade_m + 0.05)
    barrier = fence(draws, width, draws.chance(0.45))
    pieces = [placed(barrier, (spot.x, spot.y, 0.1), spot.yaw_rad)]
    for _ in range(2):
        at = draws.uniform(stretch[0] + 2.5, stretch[1] - 2.5)
        spot = place_at(curve, at, side * (SECTION.facade_m + draws.uniform(4.0, 9.0)))
        pieces.append(placed(tree(draws), (spot.x, spot.y, 0.1), spot.yaw_rad))
    for _ in range(5):
        at = draws.uniform(stretch[0] + 1.0, stretch[1] - 1.0)
        spot = place_at(curve, at, side * (SECTION.facade_m + draws.uniform(1.2, 2.0)))
        pieces.append(placed(bush(draws), (spot.x, spot.y, 0.5), spot.yaw_rad))
    return pieces


def _strip(curve: Curve, draws: Draws, index: int, side: int) -> list[Parts]:
    start, pieces = index * CHUNK_M, []
    middle = side * 0.5 * (SECTION.strip_inner_m + SECTION.strip_outer_m)
    for base in (2.5, 11.0, 20.5):
        station = start + base + draws.uniform(-1.5, 2.5)
        grown = draws.chance(0.85)
        shape = tree(draws)
        # The lamp of this side stands at 17.
        if grown and is_planted(SECTION, station, middle):
            spot = place_at(curve, station, middle)
            pieces.append(placed(shape, (spot.x, spot.y, 0.1), spot.yaw_rad))
    if (index + (side > 0)) % 2 == 0:
        spot = place_at(curve, start + 17.0, side * (SECTION.kerb_m + 0.35))
        turn = 0.0 if side > 0 else math.pi
        pieces.append(placed(lamp(), (spot.x, spot.y, 0.12), spot.yaw_rad + turn))
    post = sign(draws)
    if draws.chance(0.65):
        station = start + draws.uniform(26.5, 29.0)
        spot = place_at(curve, station, side * (SECTION.kerb_m + 0.40))
        turn = 0.0 if side < 0 else math.pi
        pieces.append(placed(post, (spot.x, spot.y, 0.12), spot.yaw_rad + turn))
    return pieces


def _parked(curve: Curve, draws: Draws, index: int, side: int) -> list[Actor]:
    actors = []
    offset = side * 0.5 * (SECTION.cycle_edge_m + SECTION.kerb_m)
    lorry = draws.chance(0.14)
    for slot in range(5):
        station = index * CHUNK_M + 3.0 + 6.0 * slot + draws.uniform(-0.4, 0.4)
        taken, model = draws.chance(0.58), draws.integer(40)
        wobble = draws.uniform(-0.08, 0.08)
        # A lorry is longer than its slot: the slots next to it stay empty.
        free = slot in (1, 3) or (slot != 2 and not taken) if lorry else not taken
        if free or _near_crossing(station):
            continue
        track = 10_000_000 + (2 * index + (side > 0)) * 16 + slot
        spot = place_at(curve, station, offset + wobble)
        turn = 0.0 if side < 0 else math.pi
        yaw = spot.yaw_rad + turn + 0.2 * wobble
        class_name = "truck" if lorry and slot == 2 else "car"
        parts, size = truck(model % 16) if class_name == "truck" else car(model)
        actors.append(_actor(track, class_name, parts, size, (spot.x, spot.y, 0.0), yaw))
    for number in range(3):
        station = index * CHUNK_M + draws.uniform(13.5, 16.0) + 0.9 * number
        if draws.chance(0.25):
            model = draws.integer(40)
            parts, size = bicycle(model, draws.uniform(0.0, 6.0), ridden=False)
            spot = place_at(curve, station, side * (SECTION.strip_outer_m + 0.30))
            track = 10_000_000 + (2 * index + (side > 0)) * 16 + 8 + number
            position = (spot.x, spot.y, 0.12)
            yaw = spot.yaw_rad + 0.9
            actors.append(_actor(track, "bicycle", parts, size, position, yaw))
    return actors


def _actor(
    track: int,
    class_name: str,
    parts: Parts,
    size: Size,
    position: tuple[float, float, float],
    yaw_rad: float,
) -> Actor:
    return Actor(track, class_name, placed(parts, position, yaw_rad), position, yaw_rad, size)


def _near_crossing(station: float) -> bool:
    since = (station - SECTION.crossing_phase_m) % SECTION.crossing_period_m
    return since < SECTION.crossing_width_m + 5.0 or since > SECTION.crossing_period_m - 7.0


def _crossing(curve: Curve, index: int) -> list[Parts]:
    pieces = []
    start = index * CHUNK_M
    first = SECTION.crossing_phase_m + SECTION.crossing_period_m * math.floor(
        (start - SECTION.crossing_phase_m) / SECTION.crossing_period_m
    )
    for crossing in (first, first + SECTION.crossing_period_m):
        if not start <= crossing < start + CHUNK_M:
            continue
        for side in (-1, 1):
            beside = SECTION.kerb_m + 0.32
            light = crossing - 0.7 if side < 0 else crossing + SECTION.crossing_width_m + 0.7
            spot = place_at(curve, light, side * beside)
            turn = 0.0 if side < 0 else math.pi
            pieces.append(placed(traffic_light(2), (spot.x, spot.y, 0.12), spot.yaw_rad + turn))
            for post in (-4.0, -2.4, 6.4, 8.0):
                spot = place_at(curve, crossing + post, side * (SECTION.kerb_m + 0.3))
                pieces.append(placed(bollard(), (spot.x, spot.y, 0.12), spot.yaw_rad))
    return pieces
