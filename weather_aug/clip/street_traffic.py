"""Who moves along the street: endless columns of cars, cyclists and walkers.

All members of a column keep one speed, so that none runs into another at any time, and the place
of each is a closed form of time. The street bends, so they are constant in dx/dt and follow it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from weather_aug.clip.street_layout import SECTION, Actor, place_at
from weather_aug.clip.street_models import Draws
from weather_aug.clip.street_movers import Size, bicycle, bus, car, person, truck
from weather_aug.clip.street_parts import Parts, placed
from weather_aug.clip.street_path import EGO_SPEED_M_PER_S, Curve, centre_slope


class Column(NamedTuple):
    """A row of movers, one in each slot that is taken."""

    kind: str
    offset_m: float
    speed_m_per_s: float
    """Along x; the sign is the direction."""
    spacing_m: float
    jitter_m: float
    share: float
    """Of the slots that are taken."""


COLUMNS = (
    Column("own", -1.7, EGO_SPEED_M_PER_S, 36.0, 6.0, 0.6),
    Column("oncoming", 1.75, -8.4, 30.0, 6.0, 0.65),
    Column("rider", -4.1, 4.9, 38.0, 14.0, 0.6),
    Column("rider", 4.1, -4.5, 38.0, 14.0, 0.6),
    Column("person", 9.55, 1.30, 6.5, 2.0, 0.35),
    Column("person", 10.5, -1.15, 6.5, 2.0, 0.35),
    Column("person", -9.55, -1.25, 6.5, 2.0, 0.35),
    Column("person", -10.5, 1.20, 6.5, 2.0, 0.35),
)


def movers(seed: int, curve: Curve, time_s: float, stations: tuple[float, float]) -> list[Actor]:
    """Return everything that moves between two stations at a time."""
    return [
        actor
        for number in range(len(COLUMNS))
        for actor in _members(seed, number, curve, time_s, stations)
    ]


def _members(
    seed: int, number: int, curve: Curve, time_s: float, stations: tuple[float, float]
) -> list[Actor]:
    column = COLUMNS[number]
    travelled = column.speed_m_per_s * time_s
    low, high = (math.floor((s - travelled) / column.spacing_m) for s in stations)
    actors = []
    for slot in range(low, high + 1):
        if column.kind == "own" and slot == 0:
            continue
        draws = Draws.keyed("street-column", seed, number, slot, count=8)
        ahead = column.kind == "own" and slot == 1
        if not (draws.chance(column.share) or ahead):
            continue
        drift = column.jitter_m * (draws.uniform() - 0.5) - (12.0 if ahead else 0.0)
        station = slot * column.spacing_m + drift + travelled
        sideways = column.offset_m + 0.3 * (draws.uniform() - 0.5)
        class_name, parts, size = _model(column, draws, station, ahead)
        spot = place_at(curve, station, sideways)
        height = SECTION.kerb_height_m if abs(sideways) > SECTION.kerb_m else 0.0
        yaw = spot.yaw_rad + (0.0 if column.speed_m_per_s > 0 else math.pi)
        position = (spot.x, spot.y, height)
        # Slots stay below 2**20 either way for a day's drive.
        track = (number << 22) + (1 << 21) + slot + (1 << 30)
        world = placed(parts, position, yaw)
        # The columns are constant in dx/dt and keep their offset from the centre line.
        along = column.speed_m_per_s
        velocity = (along, centre_slope(curve, station) * along, 0.0)
        actors.append(Actor(track, class_name, world, position, yaw, size, velocity))
    return actors


def _model(column: Column, draws: Draws, station: float, ahead: bool) -> tuple[str, Parts, Size]:
    """Return class, shape and size of a member at its station."""
    kind, model = draws.uniform(), draws.integer(1 << 20)
    if column.kind == "person":
        return "person", *person(model, 2 * math.pi * (station / 1.45 + kind))
    if column.kind == "rider":
        turn = -math.copysign(1.0, column.speed_m_per_s) * station / 0.9
        return "rider", *bicycle(model, turn, ridden=True)
    if not ahead and kind < 0.12:
        return "truck", *truck(model % 16)
    if not ahead and kind < 0.22:
        return "bus", *bus(model % 16)
    return "car", *car(model % 40)
