"""The shapes that stand in the street, as tables: what the ray caster reads.

Convention:
    A part is one convex shape in the frame of its object: x ahead, y left, z up, turned about z
    only. `shape` holds, by kind:
        BOX        centre (3), half extent (3)
        ELLIPSOID  centre (3), radii (3)
        CAPSULE    one end (3), other end (3), radius
        WHEEL      a solid cylinder about y: centre (3), radius, half width
        DISC       a flat ring: centre (3), outer radius, inner radius, axis (0 for x, 1 for y)
        HULL       first row and number of rows in `planes`: all p with p . (a, b, c) <= d
        LEAVES     a cloud of leaves in an ellipsoid: centre (3), radii (3)
        CONTACT    hit by no ray, darkens the ground: centre (3), half extent (2), strength
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.taxonomy import TRAIN_ID

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Vector = tuple[float, float, float]

BOX, ELLIPSOID, CAPSULE, WHEEL, DISC, HULL, LEAVES, CONTACT = range(8)

MATERIALS = (
    "ground",
    "facade",
    "roof",
    "stone",
    "leaves",
    "bark",
    "metal",
    "paint",
    "cabin",
    "tyre",
    "coach",
    "cloth",
    "signal",
    "sign",
    "wood",
    "brick",
)
MATERIAL = {name: index for index, name in enumerate(MATERIALS)}


class Parts(NamedTuple):
    """N parts; see the module's Convention."""

    kind: Int64
    """(N,)"""
    material: Int64
    """(N,) index into `MATERIALS`."""
    label: Int64
    """(N,) train ids."""
    frame: Float64
    """(N, 5): origin of the object in the world, cosine and sine of its yaw."""
    shape: Float64
    """(N, 8)"""
    bounds: Float64
    """(N, 6): centre and half extent in the object's frame, metres."""
    look: Float64
    """(N, 8): linear albedo (3), four numbers that the material reads, seed."""
    planes: Float64
    """(M, 4)"""


@dataclass
class Builder:
    """Collects the parts of one object in its own frame."""

    seed: int = 0
    """Small non-negative integer that the materials' patterns depend on."""
    codes: list[tuple[int, int, int]] = field(default_factory=list)
    shapes: list[tuple[float, ...]] = field(default_factory=list)
    bounds: list[tuple[float, ...]] = field(default_factory=list)
    looks: list[tuple[float, ...]] = field(default_factory=list)
    planes: list[tuple[float, float, float, float]] = field(default_factory=list)

    def box(self, label: str, look: Look, centre: Vector, size: Vector) -> None:
        """Add a box of full `size`, metres."""
        half = (size[0] / 2, size[1] / 2, size[2] / 2)
        self._add(BOX, label, look, (*centre, *half), (*centre, *half))

    def ellipsoid(self, label: str, look: Look, centre: Vector, radii: Vector) -> None:
        """Add an ellipsoid."""
        self._add(ELLIPSOID, label, look, (*centre, *radii), (*centre, *radii))

    def leaves(self, look: Look, centre: Vector, radii: Vector) -> None:
        """Add a cloud of leaves."""
        self._add(LEAVES, "vegetation", look, (*centre, *radii), (*centre, *radii))

    def capsule(self, label: str, look: Look, a: Vector, b: Vector, radius: float) -> None:
        """Add a rod from `a` to `b` with round ends."""
        middle = [(p + q) / 2 for p, q in zip(a, b, strict=True)]
        half = [abs(p - q) / 2 + radius for p, q in zip(a, b, strict=True)]
        self._add(CAPSULE, label, look, (*a, *b, radius), (*middle, *half))

    def wheel(
        self, label: str, look: Look, centre: Vector, radius: float, half_width: float
    ) -> None:
        """Add a solid wheel that rolls along x."""
        bounds = (*centre, radius, half_width, radius)
        self._add(WHEEL, label, look, (*centre, radius, half_width), bounds)

    def disc(
        self, label: str, look: Look, centre: Vector, radii: tuple[float, float], axis: int
    ) -> None:
        """Add a flat ring with (outer, inner) `radii` that faces along x (0) or y (1)."""
        half = (0.01, radii[0], radii[0]) if axis == 0 else (radii[0], 0.01, radii[0])
        self._add(DISC, label, look, (*centre, *radii, float(axis)), (*centre, *half))

    def hull(
        self, label: str, look: Look, planes: Sequence[tuple[Vector, Vector]], box: Sequence[float]
    ) -> None:
        """Add a convex solid: pairs of (outward normal, point on the face) inside `box`.

        Args:
            label: Class name.
            look: Material.
            planes: The faces, besides those of the box.
            box: x, y, z from and to: (x0, x1, y0, y1, z0, z1).
        """
        first = len(self.planes)
        x0, x1, y0, y1, z0, z1 = box
        sides: list[tuple[Vector, Vector]] = [
            ((-1, 0, 0), (x0, 0, 0)),
            ((1, 0, 0), (x1, 0, 0)),
            ((0, -1, 0), (0, y0, 0)),
            ((0, 1, 0), (0, y1, 0)),
            ((0, 0, -1), (0, 0, z0)),
            ((0, 0, 1), (0, 0, z1)),
        ]
        for normal, point in [*sides, *planes]:
            length = math.sqrt(sum(n * n for n in normal))
            unit = [n / length for n in normal]
            offset = sum(n * p for n, p in zip(unit, point, strict=True))
            self.planes.append((unit[0], unit[1], unit[2], offset))
        middle = ((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2)
        half = ((x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2)
        count = len(self.planes) - first
        self._add(HULL, label, look, (float(first), float(count)), (*middle, *half))

    def contact(self, half_x: float, half_y: float, strength: float = 0.75) -> None:
        """Darken the ground under and around the object."""
        reach = 0.9
        bounds = (0.0, 0.0, 0.0, half_x + reach, half_y + reach, 0.05)
        shape = (0.0, 0.0, 0.0, half_x, half_y, strength)
        self._add(CONTACT, "road", Look("ground"), shape, bounds)

    def _add(
        self, kind: int, label: str, look: Look, shape: Sequence[float], bounds: Sequence[float]
    ) -> None:
        self.codes.append((kind, MATERIAL[look.material], TRAIN_ID[label]))
        self.shapes.append((*shape, *(0.0,) * (8 - len(shape))))
        self.bounds.append(tuple(bounds))
        self.looks.append((*look.albedo, *look.detail, float(self.seed)))

    def built(self) -> Parts:
        """Return the parts at the origin."""
        count = len(self.codes)
        codes = np.array(self.codes, np.int64).reshape(count, 3)
        return Parts(
            kind=codes[:, 0],
            material=codes[:, 1],
            label=codes[:, 2],
            frame=np.tile([0.0, 0.0, 0.0, 1.0, 0.0], (count, 1)),
            shape=np.array(self.shapes, np.float64).reshape(count, 8),
            bounds=np.array(self.bounds, np.float64).reshape(count, 6),
            look=np.array(self.looks, np.float64).reshape(count, 8),
            planes=np.array(self.planes, np.float64).reshape(-1, 4),
        )


class Look(NamedTuple):
    """What a part looks like."""

    material: str
    albedo: Vector = (0.5, 0.5, 0.5)
    """Linear, 0..1."""
    detail: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Read by the material."""


def placed(parts: Parts, origin_world: Vector, yaw_rad: float) -> Parts:
    """Return the parts of one object at a place in the world."""
    frame = (*origin_world, math.cos(yaw_rad), math.sin(yaw_rad))
    return parts._replace(frame=np.tile(frame, (len(parts.kind), 1)))


def joined(groups: Iterable[Parts]) -> Parts:
    """Return all parts in one table."""
    tables = list(groups)
    shapes, first = [], 0
    for table in tables:
        shape = table.shape.copy()
        shape[table.kind == HULL, 0] += first
        first += len(table.planes)
        shapes.append(shape)
    return Parts(
        kind=np.concatenate([t.kind for t in tables]),
        material=np.concatenate([t.material for t in tables]),
        label=np.concatenate([t.label for t in tables]),
        frame=np.concatenate([t.frame for t in tables]),
        shape=np.concatenate(shapes),
        bounds=np.concatenate([t.bounds for t in tables]),
        look=np.concatenate([t.look for t in tables]),
        planes=np.concatenate([t.planes for t in tables]),
    )
