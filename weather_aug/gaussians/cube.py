"""The layout of a cube map: which texel is where, in OpenGL's order of faces, rows and columns."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


def texel_directions(size: int) -> Float32:
    """(6, S, S, 3) directions of texel centres, their greatest component ±1."""
    places = (2 * np.arange(size) + 1) / size - 1
    across, down = np.meshgrid(places, places)
    return np.stack([on_face(face, across, down) for face in range(6)]).astype(np.float32)


def on_face(face: int, across: NDArray[Any], down: NDArray[Any]) -> NDArray[np.float64]:
    """Directions (..., 3) of places on a face, OpenGL 4.6 table 8.19 read backwards."""
    one = np.ones_like(across)
    axes = (
        (one, -down, -across),
        (-one, -down, across),
        (across, one, down),
        (across, -one, -down),
        (across, -down, one),
        (-across, -down, -one),
    )
    return np.stack(axes[face], axis=-1)


def places_of(directions: NDArray[Any]) -> tuple[NDArray[np.intp], Any, Any]:
    """Face, across and down in -1..1 of directions (..., 3): table 8.19, for whole arrays."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    a, b, c = abs(x), abs(y), abs(z)
    major = np.where((a >= b) & (a >= c), 0, np.where(b >= c, 1, 2))
    length = np.choose(major, (a, b, c))
    face = 2 * major + (np.choose(major, (x, y, z)) <= 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.choose(face, (-z, z, x, x, x, -x)) / length
        down = np.choose(face, (-y, -y, z, -z, -y, -y)) / length
    return face, across, down


def texels_of(directions: NDArray[Any], size: int) -> NDArray[np.intp]:
    """Flat index of the texel in which each of the directions (..., 3) is."""
    face, across, down = places_of(directions)
    column, row = (
        np.clip(np.nan_to_num((place + 1) * (0.5 * size)), 0, size - 1).astype(np.intp)
        for place in (across, down)
    )
    return (face * size + row) * size + column


@lru_cache(maxsize=16)
def table_of(size: int) -> NDArray[np.int32]:
    """(6, S + 2, S + 2) flat index of each texel, with the neighbours over the edges as a border.

    A place beyond an edge folds over it: what it is too far along the face it is down the next.
    """
    places = (2 * np.arange(-1, size + 1) + 1) / size - 1
    across, down = np.meshgrid(places, places)
    # Beyond a corner three faces meet; the one across the row's edge is taken.
    down = np.where(abs(across) > 1, np.clip(down, -1 + 1 / size, 1 - 1 / size), down)
    over = np.maximum(np.maximum(abs(across), abs(down)) - 1, 0)
    table = np.empty((6, size + 2, size + 2), np.int32)
    for face in range(6):
        points = np.clip(on_face(face, across, down), -1, 1)
        points[..., face // 2] *= 1 - over
        table[face] = texels_of(points, size)
    table.flags.writeable = False
    return table
