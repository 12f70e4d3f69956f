"""The things that move or could: cars, buses, lorries, bicycles, people; each in its own frame.

All look along +x and stand on z = 0 with their middle over the origin.
"""

from __future__ import annotations

import functools
import math

from weather_aug.clip.street_models import Draws
from weather_aug.clip.street_parts import Builder, Look, Parts, Vector

Size = tuple[float, float, float]

_PAINTS: tuple[Vector, ...] = (
    (0.55, 0.56, 0.57),
    (0.70, 0.70, 0.69),
    (0.03, 0.03, 0.033),
    (0.16, 0.17, 0.18),
    (0.24, 0.020, 0.020),
    (0.38, 0.38, 0.37),
    (0.09, 0.09, 0.095),
    (0.03, 0.075, 0.26),
    (0.10, 0.14, 0.19),
    (0.25, 0.24, 0.21),
    (0.04, 0.14, 0.10),
)
_CLOTHES: tuple[Vector, ...] = (
    (0.03, 0.04, 0.09),
    (0.30, 0.05, 0.05),
    (0.45, 0.44, 0.42),
    (0.06, 0.13, 0.08),
    (0.50, 0.36, 0.10),
    (0.04, 0.04, 0.042),
    (0.12, 0.19, 0.34),
    (0.35, 0.22, 0.30),
)
_SKINS: tuple[Vector, ...] = ((0.52, 0.33, 0.24), (0.36, 0.21, 0.14), (0.15, 0.08, 0.055))


@functools.lru_cache(maxsize=256)
def car(seed: int) -> tuple[Parts, Size]:
    """A saloon, an estate or a small car, and its size in metres."""
    draws = Draws.keyed("street-car", seed, count=16)
    b = Builder(draws.seed())
    albedo = _PAINTS[draws.integer(len(_PAINTS))]
    style = draws.integer(3)
    length = (4.6, 4.5, 3.9)[style] + draws.uniform(-0.1, 0.1)
    width, height = 1.80, (1.44, 1.50, 1.52)[style] + draws.uniform(-0.03, 0.05)
    half, side = length / 2, width / 2
    axle, radius = half - 0.80, 0.325
    _car_lower(b, albedo, half, side, axle, radius)
    front = half - 1.05 - 0.05 * style
    rear = (-half + 0.62, -half + 0.12, -half + 0.14)[style]
    run = (0.55, 0.28, 0.30)[style]
    look = Look("cabin", albedo, (front, rear, run, height))
    rise = height - 0.90
    planes: list[tuple[Vector, Vector]] = [
        ((rise, 0.0, 0.75), (front, 0.0, 0.90)),
        ((-rise, 0.0, run), (rear, 0.0, 0.90)),
        ((0.10, 0.0, 1.0), (0.25, 0.0, height)),
        ((-0.09, 0.0, 1.0), (-0.30, 0.0, height)),
    ]
    for s in (-1.0, 1.0):
        planes.append(((0.0, s, 0.40), (0.0, s * (side - 0.08), 0.90)))
        planes.append(((0.0, s, 2.2), (0.0, s * (side - 0.40), height)))
        planes.append(((0.9, s * 0.8, 0.75), (front - 0.10, s * (side - 0.22), 0.90)))
    b.hull("car", look, planes, (rear, front, -side, side, 0.86, height))
    for s in (-1.0, 1.0):
        mirror = Look("paint", albedo, (half, side, axle, radius))
        b.ellipsoid("car", mirror, (front - 0.42, s * (side + 0.06), 0.98), (0.08, 0.12, 0.075))
    return b.built(), (length, width, height)


def _car_lower(
    b: Builder, albedo: Vector, half: float, side: float, axle: float, radius: float
) -> None:
    look = Look("paint", albedo, (half, side, axle, radius))
    planes: list[tuple[Vector, Vector]] = [
        ((0.17, 0.0, 1.0), (half - 1.05, 0.0, 0.93)),
        ((0.62, 0.0, 1.0), (half - 0.22, 0.0, 0.79)),
        ((1.0, 0.0, 0.22), (half, 0.0, 0.50)),
        ((1.0, 0.0, -0.55), (half, 0.0, 0.42)),
        ((-1.0, 0.0, 0.16), (-half, 0.0, 0.60)),
        ((-1.0, 0.0, -0.5), (-half, 0.0, 0.45)),
        ((-0.7, 0.0, 1.0), (-half + 0.10, 0.0, 0.92)),
    ]
    for s in (-1.0, 1.0):
        planes += [
            ((0.0, s, 0.16), (0.0, s * side, 0.62)),
            ((0.0, s, -0.22), (0.0, s * side, 0.50)),
            ((0.0, s, 1.1), (0.0, s * (side - 0.075), 0.90)),
            ((1.0, s * 0.22, 0.0), (half, s * (side - 0.62), 0.0)),
            ((1.0, s * 0.85, 0.0), (half - 0.10, s * (side - 0.17), 0.0)),
            ((-1.0, s * 0.20, 0.0), (-half, s * (side - 0.55), 0.0)),
            ((-1.0, s * 0.95, 0.0), (-half + 0.08, s * (side - 0.15), 0.0)),
        ]
    b.hull("car", look, planes, (-half, half, -side, side, 0.20, 0.93))
    for x in (-axle, axle):
        for s in (-1.0, 1.0):
            at = (x, s * (side - 0.105), radius)
            b.wheel("car", Look("tyre"), at, radius, 0.112)
    b.contact(half - 0.12, side - 0.08)


@functools.lru_cache(maxsize=64)
def bus(seed: int) -> tuple[Parts, Size]:
    """A city bus, and its size."""
    draws = Draws.keyed("street-bus", seed, count=8)
    b = Builder(draws.seed())
    albedo = ((0.42, 0.05, 0.03), (0.60, 0.48, 0.10), (0.05, 0.16, 0.36))[draws.integer(3)]
    size = (11.2, 2.5, 3.05)
    _coach_body(b, "bus", Look("coach", albedo, (5.6, 1.25, 1.35, 2.5)), size, 0.0)
    b.box("bus", Look("stone", (0.5, 0.5, 0.5)), (-1.5, 0.0, 3.1), (3.0, 1.6, 0.25))
    return b.built(), size


@functools.lru_cache(maxsize=64)
def truck(seed: int) -> tuple[Parts, Size]:
    """A delivery lorry, and its size."""
    draws = Draws.keyed("street-truck", seed, count=8)
    b = Builder(draws.seed())
    cab = _PAINTS[draws.integer(len(_PAINTS))]
    load = ((0.66, 0.66, 0.64), (0.50, 0.42, 0.10), (0.30, 0.36, 0.42))[draws.integer(3)]
    size = (7.2, 2.35, 3.2)
    b.box(
        "truck", Look("coach", load, (3.6, 1.17, 0.0, 0.0)), (-0.95, 0.0, 1.98), (5.3, 2.35, 2.44)
    )
    glass = Look("coach", cab, (3.6, 1.07, 1.45, 2.15))
    planes: list[tuple[Vector, Vector]] = [
        ((1.0, 0.0, 0.45), (3.6, 0.0, 1.35)),
        ((1.0, 0.45, 0.0), (3.6, 0.75, 0.0)),
        ((1.0, -0.45, 0.0), (3.6, -0.75, 0.0)),
    ]
    b.hull("truck", glass, planes, (1.75, 3.6, -1.08, 1.08, 0.42, 2.55))
    b.box("truck", Look("stone", (0.03, 0.03, 0.03)), (-0.6, 0.0, 0.66), (5.8, 1.0, 0.3))
    _coach_wheels(b, "truck", 2.55, -2.1, 1.0)
    b.contact(3.5, 1.1)
    return b.built(), size


def _coach_body(b: Builder, label: str, look: Look, size: Size, base: float) -> None:
    half, side, height = size[0] / 2, size[1] / 2, size[2]
    planes: list[tuple[Vector, Vector]] = [
        ((1.0, 0.0, 0.10), (half, 0.0, 1.2)),
        ((1.0, 0.0, 1.0), (half - 0.2, 0.0, height - 0.1)),
    ]
    for s in (-1.0, 1.0):
        planes += [
            ((1.0, s, 0.0), (half - 0.12, s * (side - 0.12), 0.0)),
            ((-1.0, s, 0.0), (-half + 0.1, s * (side - 0.1), 0.0)),
            ((0.0, s, 1.0), (0.0, s * (side - 0.12), height - 0.12)),
        ]
    b.hull(label, look, planes, (-half, half, -side, side, base + 0.30, height))
    _coach_wheels(b, label, 0.62 * half, -0.58 * half, side - 0.14)
    b.contact(half - 0.1, side - 0.05)


def _coach_wheels(b: Builder, label: str, front: float, rear: float, y: float) -> None:
    for x in (front, rear):
        for s in (-1.0, 1.0):
            b.wheel(label, Look("tyre"), (x, s * y, 0.48), 0.48, 0.15)


def _person_looks(draws: Draws) -> tuple[Look, Look, Look, Look]:
    skin = _SKINS[draws.integer(len(_SKINS))]
    top = _CLOTHES[draws.integer(len(_CLOTHES))]
    legs = ((0.03, 0.045, 0.09), (0.03, 0.03, 0.03), (0.22, 0.19, 0.14))[draws.integer(3)]
    hair = ((0.02, 0.015, 0.01), (0.10, 0.06, 0.03), (0.24, 0.18, 0.09))[draws.integer(3)]
    return (
        Look("cloth", skin, (0.15, 0.0, 0.0, 0.0)),
        Look("cloth", top, (0.8, 0.0, 0.0, 0.0)),
        Look("cloth", legs, (0.7, 0.0, 0.0, 0.0)),
        Look("cloth", hair, (0.6, 0.0, 0.0, 0.0)),
    )


def person(seed: int, phase_rad: float) -> tuple[Parts, Size]:
    """A walker at a phase of the step, and the size."""
    draws = Draws.keyed("street-person", seed, count=16)
    skin, top, legs, hair = _person_looks(draws)
    k = draws.uniform(0.92, 1.05)
    b = Builder(draws.seed())
    for s in (-1.0, 1.0):
        swing = 0.42 * math.sin(phase_rad) * s
        bend = 0.25 + 0.35 * max(0.0, math.cos(phase_rad) * s)
        hip = (0.0, s * 0.09 * k, 0.92 * k)
        knee = _along(hip, swing + 0.5 * bend * 0.4, 0.42 * k)
        foot = _along(knee, swing - bend * 0.7, 0.40 * k)
        b.capsule("person", legs, hip, knee, 0.085 * k)
        b.capsule("person", legs, knee, foot, 0.060 * k)
        toe = (foot[0] + 0.15 * k, foot[1], foot[2] - 0.02)
        b.capsule("person", Look("cloth", (0.03, 0.025, 0.02)), foot, toe, 0.048 * k)
        shoulder = (0.0, s * 0.205 * k, 1.42 * k)
        elbow = _along(shoulder, -swing * 0.8, 0.29 * k)
        hand = _along(elbow, -swing * 0.8 + 0.35, 0.25 * k)
        b.capsule("person", top, shoulder, elbow, 0.055 * k)
        b.capsule("person", top, elbow, hand, 0.046 * k)
        b.ellipsoid("person", skin, hand, (0.05, 0.04, 0.06))
    b.ellipsoid("person", top, (0.0, 0.0, 1.24 * k), (0.135 * k, 0.20 * k, 0.33 * k))
    b.capsule("person", top, (0.0, -0.13 * k, 1.43 * k), (0.0, 0.13 * k, 1.43 * k), 0.075 * k)
    b.ellipsoid("person", legs, (0.0, 0.0, 0.96 * k), (0.125 * k, 0.165 * k, 0.15 * k))
    b.capsule("person", skin, (0.0, 0.0, 1.45 * k), (0.02, 0.0, 1.58 * k), 0.052 * k)
    b.ellipsoid("person", skin, (0.025, 0.0, 1.655 * k), (0.095 * k, 0.078 * k, 0.118 * k))
    b.ellipsoid("person", hair, (-0.02, 0.0, 1.69 * k), (0.098 * k, 0.088 * k, 0.105 * k))
    if draws.chance(0.4):
        pack = Look("cloth", _CLOTHES[draws.integer(len(_CLOTHES))], (0.5, 0.0, 0.0, 0.0))
        b.ellipsoid("person", pack, (-0.19 * k, 0.0, 1.27 * k), (0.11, 0.15, 0.23))
    b.contact(0.16, 0.16, 0.6)
    return b.built(), (0.75, 0.60, 1.78 * k)


def _along(start: Vector, angle_rad: float, length: float) -> Vector:
    """Return the end of a limb that hangs from `start`, swung forward by an angle."""
    x = start[0] + length * math.sin(angle_rad)
    return x, start[1], start[2] - length * math.cos(angle_rad)


def bicycle(seed: int, turn_rad: float, *, ridden: bool) -> tuple[Parts, Size]:
    """A bicycle with or without its rider, the cranks at an angle, and its size."""
    draws = Draws.keyed("street-bicycle", seed, count=16)
    b = Builder(draws.seed())
    tube = Look("metal", _PAINTS[3 + draws.integer(6)], (0.05, 0.0, 0.0, 0.0))
    rubber = Look("stone", (0.02, 0.02, 0.02))
    for x in (-0.52, 0.52):
        b.disc("bicycle", rubber, (x, 0.0, 0.34), (0.345, 0.295), 1)
        for spoke in range(3):
            angle = turn_rad * 2.4 + spoke * math.pi / 3
            c, s = 0.30 * math.cos(angle), 0.30 * math.sin(angle)
            a, e = (x - c, 0.0, 0.34 - s), (x + c, 0.0, 0.34 + s)
            b.capsule("bicycle", STEEL_WIRE, a, e, 0.004)
    crank, seat, head = (-0.08, 0.0, 0.30), (-0.20, 0.0, 0.86), (0.36, 0.0, 0.86)
    rods = [
        (crank, seat),
        (crank, (0.38, 0.0, 0.70)),
        ((-0.18, 0.0, 0.76), (0.37, 0.0, 0.80)),
        ((-0.52, 0.0, 0.34), crank),
        ((-0.52, 0.0, 0.34), (-0.18, 0.0, 0.74)),
        ((0.52, 0.0, 0.34), head),
        (head, (0.34, 0.0, 1.02)),
        ((0.34, -0.26, 1.03), (0.34, 0.26, 1.03)),
    ]
    for start, end in rods:
        b.capsule("bicycle", tube, start, end, 0.019)
    b.ellipsoid("bicycle", rubber, (-0.22, 0.0, 0.90), (0.14, 0.08, 0.04))
    b.contact(0.7, 0.06, 0.45)
    if not ridden:
        return b.built(), (1.75, 0.55, 1.08)
    skin, top, legs, hair = _person_looks(draws)
    for s in (-1.0, 1.0):
        angle = turn_rad + (math.pi if s > 0 else 0.0)
        pedal = (crank[0] + 0.17 * math.cos(angle), s * 0.13, crank[2] + 0.17 * math.sin(angle))
        hip = (-0.20, s * 0.09, 0.97)
        knee = _knee(hip, pedal, 0.44, 0.43)
        b.capsule("rider", legs, hip, knee, 0.075)
        b.capsule("rider", legs, knee, (pedal[0], pedal[1], pedal[2] + 0.06), 0.055)
        b.capsule("rider", rubber, pedal, (pedal[0] + 0.14, pedal[1], pedal[2]), 0.042)
        b.capsule("rider", top, (0.12, s * 0.19, 1.46), (0.26, s * 0.25, 1.22), 0.05)
        b.capsule("rider", skin, (0.26, s * 0.25, 1.22), (0.34, s * 0.24, 1.06), 0.038)
    b.capsule("rider", top, (-0.16, 0.0, 1.02), (0.09, 0.0, 1.42), 0.145)
    b.capsule("rider", top, (0.10, -0.12, 1.46), (0.10, 0.12, 1.46), 0.07)
    b.ellipsoid("rider", skin, (0.20, 0.0, 1.66), (0.095, 0.078, 0.115))
    helmet = hair if draws.chance(0.4) else Look("metal", (0.55, 0.1, 0.05), (0.06, 0, 0, 0))
    b.ellipsoid("rider", helmet, (0.18, 0.0, 1.70), (0.125, 0.095, 0.10))
    return b.built(), (1.75, 0.60, 1.82)


STEEL_WIRE = Look("metal", (0.35, 0.35, 0.35), (0.1, 0.0, 0.0, 0.0))


def _knee(hip: Vector, foot: Vector, upper: float, lower: float) -> Vector:
    """Return where the knee is: two circles in the plane of the leg, on the forward side."""
    dx, dz = foot[0] - hip[0], foot[2] - hip[2]
    reach = min(math.hypot(dx, dz), upper + lower - 1e-3)
    cosine = (upper * upper + reach * reach - lower * lower) / (2 * upper * reach)
    angle = math.atan2(dx, -dz) + math.acos(max(-1.0, min(1.0, cosine)))
    x, _, z = _along(hip, angle, upper)
    return x, 0.5 * (hip[1] + foot[1]), z
