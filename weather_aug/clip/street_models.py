"""The things that stand still: houses, trees, lamps, signs, fences; each in its own frame.

A draw is a number in [0, 1) from the keyed stream of the place where the thing stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from weather_aug._keys import key_of, uniforms
from weather_aug.clip.street_parts import Builder, Look, Parts, Vector

STONE = Look("stone", (0.46, 0.44, 0.40))
STEEL = Look("metal", (0.16, 0.17, 0.175), (0.05, 0.0, 0.0, 0.0))
DARK_STEEL = Look("metal", (0.035, 0.045, 0.042), (0.05, 0.0, 0.0, 0.0))

_PLASTERS: tuple[Vector, ...] = (
    (0.62, 0.54, 0.40),
    (0.66, 0.60, 0.50),
    (0.58, 0.41, 0.24),
    (0.52, 0.30, 0.22),
    (0.56, 0.55, 0.52),
    (0.42, 0.47, 0.50),
    (0.55, 0.50, 0.30),
    (0.64, 0.62, 0.58),
    (0.46, 0.50, 0.40),
)
_BRICKS: tuple[Vector, ...] = (
    (0.30, 0.115, 0.075),
    (0.36, 0.19, 0.12),
    (0.24, 0.12, 0.09),
    (0.40, 0.31, 0.20),
)
_ROOFS: tuple[Vector, ...] = ((0.26, 0.105, 0.07), (0.10, 0.10, 0.11), (0.20, 0.14, 0.11))


@dataclass
class Draws:
    """Numbers in [0, 1) keyed by a domain and integers, taken one after the other."""

    numbers: Sequence[float]
    cursor: int = 0

    @staticmethod
    def keyed(domain: str, *fields: int, count: int = 256) -> Draws:
        """Return the stream of a key."""
        return Draws(uniforms(key_of(domain, *fields), count).tolist())

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return the next number, stretched to [low, high)."""
        self.cursor += 1
        return low + (high - low) * self.numbers[self.cursor - 1]

    def integer(self, count: int) -> int:
        """Return the next whole number in [0, count)."""
        return int(self.uniform() * count)

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return self.uniform() < probability

    def seed(self) -> int:
        """Return a small seed for patterns."""
        return self.integer(4096)


def house(draws: Draws, width: float, *, plain: bool = False) -> Parts:
    """A house whose front lies at y = 0 and looks along -y; `width` in metres."""
    b = Builder(draws.seed())
    height, depth = draws.uniform(8.5, 19.5), draws.uniform(10.0, 13.0)
    brick = draws.chance(0.38)
    colours = _BRICKS if brick else _PLASTERS
    albedo = colours[draws.integer(len(colours))]
    shop = draws.chance(0.42)
    pitched = draws.chance(0.6) and height < 17.0
    wall = Look("facade", albedo, (width, height, float(brick), float(shop)))
    b.box("building", wall, (0.0, depth / 2, height / 2), (width, depth, height))
    if plain:
        return b.built()
    for level, (out, tall) in enumerate(((0.34, 0.22), (0.20, 0.34))):
        z = height - 0.11 - 0.28 * level
        b.box("building", STONE, (0.0, depth / 2 - 0.02, z), (width, depth + 2 * out, tall))
    if pitched:
        _gable(b, draws, width, depth, height)
    else:
        b.box("building", STONE, (0.0, 0.12, height + 0.3), (width, 0.24, 0.6))
        if draws.chance(0.6):
            at = draws.uniform(-0.3, 0.3) * width
            b.box("building", wall, (at, depth * 0.6, height + 1.0), (3.0, 3.0, 2.4))
    if draws.chance(0.45) and height > 10.0:
        _balconies(b, draws, width, height)
    if shop and draws.chance(0.4):
        _awning(b, draws, width)
    x = width / 2 - 0.18
    pipe = Look("metal", (0.24, 0.23, 0.22), (0.03, 0.0, 0.0, 0.0))
    b.capsule("building", pipe, (x, -0.07, 0.1), (x, -0.07, height - 0.5), 0.055)
    return b.built()


def _gable(b: Builder, draws: Draws, width: float, depth: float, height: float) -> None:
    rise = draws.uniform(2.4, 4.2)
    half = depth / 2 + 0.42
    roof = Look("roof", _ROOFS[draws.integer(len(_ROOFS))])
    planes = [
        ((0.0, side * rise, half), (0.0, depth / 2 + side * half, height)) for side in (-1.0, 1.0)
    ]
    box = (-width / 2, width / 2, -0.42, depth + 0.42, height, height + rise)
    b.hull("building", roof, planes, box)
    at = draws.uniform(-0.35, 0.35) * width
    chimney = Look("brick", (0.26, 0.12, 0.09))
    b.box("building", chimney, (at, depth * 0.55, height + rise), (0.7, 0.9, 2.0))
    if draws.chance(0.7):
        plaster = Look("stone", (0.5, 0.48, 0.44))
        glass = Look("metal", (0.03, 0.03, 0.035), (0.3, 0.0, 0.0, 0.0))
        for x in (-0.25 * width, 0.25 * width):
            b.box("building", plaster, (x, 1.9, height + 1.0), (1.5, 2.6, 2.0))
            b.box("building", glass, (x, 0.585, height + 1.1), (0.95, 0.03, 1.15))


def _balconies(b: Builder, draws: Draws, width: float, height: float) -> None:
    storeys = max(1, int((height - 4.7) / 3.05))
    storey = (height - 4.7) / storeys
    x = draws.uniform(-0.3, 0.3) * (width - 4.0)
    for level in range(1, storeys):
        z = 4.0 + level * storey
        b.box("building", STONE, (x, -0.5, z - 0.09), (2.6, 1.0, 0.18))
        for rail in (0.42, 0.72, 1.0):
            b.box("building", DARK_STEEL, (x, -0.96, z + rail), (2.6, 0.04, 0.05))
        for post in range(8):
            at = x - 1.27 + post * 0.363
            b.box("building", DARK_STEEL, (at, -0.96, z + 0.5), (0.03, 0.03, 1.0))


def _awning(b: Builder, draws: Draws, width: float) -> None:
    cloth = (
        (0.32, 0.06, 0.05),
        (0.06, 0.15, 0.10),
        (0.08, 0.11, 0.20),
        (0.48, 0.42, 0.30),
    )[draws.integer(4)]
    half = width / 2 - 0.5
    planes = [
        ((0.0, -0.62, 1.0), (0.0, -0.05, 3.08)),
        ((0.0, 0.62, -1.0), (0.0, -0.05, 3.02)),
    ]
    look = Look("cloth", cloth, (0.10, 0.0, 0.0, 0.0))
    b.hull("building", look, planes, (-half, half, -1.25, -0.02, 2.2, 3.1))


def tree(draws: Draws) -> Parts:
    """A broad-leaved tree of 6 to 10 m."""
    b = Builder(draws.seed())
    bark = Look("bark", (0.14, 0.11, 0.085))
    green = (
        draws.uniform(0.085, 0.14),
        draws.uniform(0.15, 0.21),
        draws.uniform(0.035, 0.055),
    )
    leaves = Look("leaves", green)
    fork, size = draws.uniform(2.3, 3.0), draws.uniform(0.85, 1.2)
    lean = (draws.uniform(-0.12, 0.12), draws.uniform(-0.12, 0.12))
    top = (lean[0], lean[1], fork)
    b.capsule("vegetation", bark, (0.0, 0.0, 0.0), top, 0.13 * size + 0.02)
    b.ellipsoid("vegetation", bark, (0.0, 0.0, 0.0), (0.30 * size, 0.28 * size, 0.45))
    b.leaves(leaves, (lean[0], lean[1], fork + 2.1 * size), (1.5 * size, 1.5 * size, 1.6 * size))
    turn = draws.uniform(0.0, 2 * math.pi)
    for limb in range(6):
        angle = turn + limb * 2 * math.pi / 6 * 1.05 + draws.uniform(-0.2, 0.2)
        reach = size * draws.uniform(0.9, 1.5)
        height = fork + size * draws.uniform(0.7, 2.7)
        at = (lean[0] + reach * math.cos(angle), lean[1] + reach * math.sin(angle), height)
        b.capsule("vegetation", bark, top, at, 0.055 * size)
        radius = size * draws.uniform(0.8, 1.2)
        b.leaves(leaves, at, (radius, radius * draws.uniform(0.8, 1.1), radius * 0.85))
    crown = (lean[0], lean[1], fork + size * 3.6)
    b.leaves(leaves, crown, (1.0 * size, 1.0 * size, 0.9 * size))
    b.contact(0.12, 0.12, 0.5)
    return b.built()


def bush(draws: Draws) -> Parts:
    """A shrub of about a metre."""
    b = Builder(draws.seed())
    leaves = Look("leaves", (draws.uniform(0.08, 0.12), draws.uniform(0.14, 0.19), 0.045))
    for _ in range(3):
        radius = draws.uniform(0.45, 0.75)
        at = (draws.uniform(-0.7, 0.7), draws.uniform(-0.3, 0.3), radius * 0.7)
        b.leaves(leaves, at, (radius, radius * 0.8, radius * draws.uniform(0.8, 1.2)))
    return b.built()


def lamp() -> Parts:
    """A street lamp of 7 m whose arm reaches along -y."""
    b = Builder(7)
    b.capsule("pole", DARK_STEEL, (0.0, 0.0, 0.0), (0.0, 0.0, 1.1), 0.10)
    b.capsule("pole", DARK_STEEL, (0.0, 0.0, 0.0), (0.0, 0.0, 6.6), 0.062)
    b.capsule("pole", DARK_STEEL, (0.0, 0.0, 6.6), (0.0, -1.1, 7.1), 0.045)
    b.box("pole", STEEL, (0.0, -1.35, 7.12), (0.28, 0.75, 0.12))
    b.contact(0.08, 0.08, 0.5)
    return b.built()


def traffic_light(state: int) -> Parts:
    """A traffic light that looks along -x; `state` 0 red, 1 amber, 2 green."""
    b = Builder(3)
    b.capsule("pole", STEEL, (0.0, 0.0, 0.0), (0.0, 0.0, 3.5), 0.06)
    lit = Look("signal", detail=(float(state), 0.0, 0.0, 0.0))
    b.box("traffic light", lit, (-0.14, 0.0, 2.85), (0.20, 0.32, 0.96))
    for level in (-1, 0, 1):
        z = 2.85 + 0.29 * level + 0.115
        b.box(
            "traffic light", Look("stone", (0.02, 0.02, 0.02)), (-0.32, 0.0, z), (0.17, 0.22, 0.02)
        )
    walk = Look("signal", detail=(0.0 if state == 2 else 2.0, 0.0, 0.0, 0.0))
    b.box("traffic light", walk, (0.0, 0.15, 2.2), (0.24, 0.18, 0.62))
    b.contact(0.08, 0.08, 0.5)
    return b.built()


def sign(draws: Draws) -> Parts:
    """A traffic sign on a pole that looks along -x."""
    b = Builder(draws.seed())
    kind = draws.integer(4)
    height = draws.uniform(2.3, 2.6)
    b.capsule("pole", STEEL, (0.0, 0.0, 0.0), (0.0, 0.0, height + 0.3), 0.036)
    if kind in (0, 1):
        face = Look("sign", detail=(float(kind), 0.34, 0.34, 0.0))
        b.disc("traffic sign", face, (-0.05, 0.0, height), (0.34, 0.0), 0)
    elif kind == 2:
        face = Look("sign", detail=(2.0, 0.31, 0.31, 0.0))
        b.box("traffic sign", face, (-0.05, 0.0, height), (0.02, 0.62, 0.62))
    else:
        planes = [
            ((0.0, float(sy), float(sz)), (0.0, 0.40 * sy, height))
            for sy in (-1, 1)
            for sz in (-1, 1)
        ]
        # A diamond: its own origin carries the pattern's middle.
        look = Look("sign", detail=(3.0, 0.40, 0.40, height))
        b.hull("traffic sign", look, planes, (-0.06, -0.04, -0.4, 0.4, height - 0.4, height + 0.4))
    return b.built()


def fence(draws: Draws, width: float, wall: bool) -> Parts:
    """A garden fence of planks, or a brick wall, along x at y = 0."""
    b = Builder(draws.seed())
    if wall:
        brick = Look("brick", _BRICKS[draws.integer(len(_BRICKS))])
        b.box("wall", brick, (0.0, 0.12, 0.85), (width, 0.24, 1.7))
        b.box("wall", STONE, (0.0, 0.12, 1.75), (width, 0.34, 0.12))
        return b.built()
    tone = draws.uniform(0.14, 0.26)
    wood = Look("wood", (tone * 1.15, tone * 0.85, tone * 0.6))
    b.box("fence", wood, (0.0, 0.05, 0.75), (width, 0.03, 1.5))
    for rail in (0.35, 1.2):
        b.box("fence", wood, (0.0, 0.02, rail), (width, 0.06, 0.10))
    posts = max(2, round(width / 2.4))
    for post in range(posts + 1):
        x = -width / 2 + 0.06 + post * (width - 0.12) / posts
        b.box("fence", wood, (x, 0.0, 0.82), (0.12, 0.12, 1.64))
    return b.built()


def bollard() -> Parts:
    """A low post at the kerb."""
    b = Builder(5)
    b.capsule("pole", DARK_STEEL, (0.0, 0.0, 0.0), (0.0, 0.0, 0.85), 0.07)
    b.contact(0.07, 0.07, 0.5)
    return b.built()
