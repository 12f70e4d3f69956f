"""What each class's surfaces do with water and snow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.taxonomy import CLASSES, TRAIN_ID

Float32 = NDArray[np.float32]


class Material(NamedTuple):
    """Of one class, all in [0, 1] but the cap."""

    porosity: float
    """How much of the film's darkening it shows: metal and glass none."""
    mirror: float
    """How much of a water film's mirror it shows: grass none."""
    cover: float
    """Share of the snow cover that lies on its level surfaces."""
    cap_m: float
    """Height of the snow on its upper edge when the ground is all white, metres."""
    leaf: float
    """How far snow lies in its texture instead of on its surface."""
    level: float
    """How far its level parts (bonnets, roofs) hold snow."""
    buried: float
    """How far the snow on the ground lies over its foot: what moves stands on top of it."""


_GROUND = {
    "road": Material(1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0),
    "sidewalk": Material(1.0, 0.8, 0.97, 0.0, 0.0, 0.0, 0.0),
    "terrain": Material(0.7, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0),
}
_STANDING = {
    "building": Material(0.8, 0.0, 0.9, 0.25, 0.0, 1.0, 1.0),
    "wall": Material(1.0, 0.0, 0.7, 0.12, 0.0, 0.0, 1.0),
    "fence": Material(0.5, 0.0, 0.4, 0.07, 0.0, 0.0, 1.0),
    "pole": Material(0.3, 0.0, 0.2, 0.06, 0.0, 0.0, 1.0),
    "traffic light": Material(0.0, 0.0, 0.2, 0.07, 0.0, 0.0, 1.0),
    "traffic sign": Material(0.0, 0.0, 0.2, 0.05, 0.0, 0.0, 1.0),
    "vegetation": Material(0.35, 0.0, 0.75, 0.0, 1.0, 0.0, 1.0),
    "person": Material(0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "rider": Material(0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "car": Material(0.0, 0.0, 0.75, 0.11, 0.0, 1.0, 0.0),
    "truck": Material(0.0, 0.0, 0.75, 0.11, 0.0, 1.0, 0.0),
    "bus": Material(0.0, 0.0, 0.75, 0.11, 0.0, 1.0, 0.0),
    "train": Material(0.0, 0.0, 0.75, 0.11, 0.0, 1.0, 0.0),
    "motorcycle": Material(0.0, 0.0, 0.1, 0.04, 0.0, 0.0, 0.0),
    "bicycle": Material(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0),
}
MATERIALS = {**_GROUND, **_STANDING, "sky": Material(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}
POROSITY, MIRROR, COVER, CAP_M, LEAF, LEVEL, BURIED, GROUND, ROAD = range(9)
"""Columns of the table: the fields of Material, whether a class is ground, whether it is road."""


def material_table(*, labelled: bool) -> Float32:
    """The materials by train id, (256, 9) float32; what has no class does nothing.

    Where classes are guessed, what stands is of no known kind: snow lies on its edges only.
    """
    table = np.zeros((256, 9), np.float32)
    for name in CLASSES:
        row = table[TRAIN_ID[name]]
        row[: len(Material._fields)] = MATERIALS[name]
        row[GROUND] = name in _GROUND
        row[ROAD] = name == "road"
    if not labelled:
        table[:, LEVEL] = 0.0
    table.flags.writeable = False
    return table
