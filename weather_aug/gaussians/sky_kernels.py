"""Compiled loops of `sky`: directions to texels of a cube map, bilinear both ways.

A map is read through a table of texels with a border of one texel around each face, which holds the
neighbours over the edge, so that colours do not jump from face to face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inlined
def face_of(x, y, z):
    """Face, and where on it: across and down in -1..1 (OpenGL 4.6, table 8.19)."""
    a, b, c = abs(x), abs(y), abs(z)
    if a >= b and a >= c:
        if x > ZERO:
            return 0, -z / a, -y / a
        return 1, z / a, -y / a
    if b >= c:
        if y > ZERO:
            return 2, x / b, z / b
        return 3, x / b, -z / b
    if z > ZERO:
        return 4, x / c, -y / c
    return 5, -x / c, -y / c


@inlined
def corner_of(x, y, z, size):
    """Flat index into the bordered table of the upper left of four texels, and two shares.

    The shares are those of the right and of the lower texels; of a direction without a length they
    are NaN, and so is its colour.
    """
    face, across, down = face_of(x, y, z)
    half = HALF * np.float32(size)
    # Texel centres are at halves; the border shifts them by one.
    column = half * (across + ONE) + HALF
    row = half * (down + ONE) + HALF
    # What NaN becomes as an integer must not be read.
    left, top = max(min(int(column), size), 0), max(min(int(row), size), 0)
    wide = size + 2
    return (face * wide + top) * wide + left, column - np.float32(left), row - np.float32(top)


@compiled
def sample(faces: Float32, table: NDArray[np.int32], directions: Float32, out: Float32) -> None:
    """Write the colours (N, 3) of directions (N, 3), of any length, from flat faces (T, 3)."""
    size = table.shape[1] - 2
    wide = np.uint64(size + 2)
    flat = table.reshape(-1)
    for place in range(len(directions)):
        x, y, z = directions[place, 0], directions[place, 1], directions[place, 2]
        corner, right, lower = corner_of(x, y, z, size)
        _mix(faces, flat, np.uint64(corner), wide, right, lower, out, np.uint64(place))


@compiled
def sample_picture(
    faces: Float32,
    table: NDArray[np.int32],
    world_from_pixel: Float32,
    needed: Bools,
    out: Float32,
) -> None:
    """Write the colours (H W, 3) of a picture; where `needed` (H, W) is false nothing is written.

    world_from_pixel (3, 3) maps (column, row, 1) to a direction.
    """
    size = table.shape[1] - 2
    wide = np.uint64(size + 2)
    flat = table.reshape(-1)
    height, width = needed.shape
    m = world_from_pixel
    for row in range(height):
        v = np.float32(row)
        x0, y0, z0 = (m[0, 1] * v + m[0, 2], m[1, 1] * v + m[1, 2], m[2, 1] * v + m[2, 2])
        for column in range(width):
            if not needed[row, column]:
                continue
            u = np.float32(column)
            x, y, z = m[0, 0] * u + x0, m[1, 0] * u + y0, m[2, 0] * u + z0
            corner, right, lower = corner_of(x, y, z, size)
            place = np.uint64(row * width + column)
            _mix(faces, flat, np.uint64(corner), wide, right, lower, out, place)


@inlined
def _mix(faces, flat, corner, wide, right, lower, out, place):
    a, b = np.uint64(flat[corner]), np.uint64(flat[corner + np.uint64(1)])
    c, d = np.uint64(flat[corner + wide]), np.uint64(flat[corner + wide + np.uint64(1)])
    left, upper = ONE - right, ONE - lower
    wa, wb, wc, wd = left * upper, right * upper, left * lower, right * lower
    for channel in range(3):
        out[place, channel] = (
            wa * faces[a, channel]
            + wb * faces[b, channel]
            + wc * faces[c, channel]
            + wd * faces[d, channel]
        )


@compiled
def scatter(
    grads: Float32, table: NDArray[np.int32], directions: Float32, to_faces: Float32
) -> None:
    """Add (N, C) values to the flat faces (T, C) by the shares with which `sample` reads them."""
    size = table.shape[1] - 2
    wide = np.uint64(size + 2)
    flat = table.reshape(-1)
    for place in range(len(directions)):
        x, y, z = directions[place, 0], directions[place, 1], directions[place, 2]
        corner, right, lower = corner_of(x, y, z, size)
        _spread(grads, flat, np.uint64(corner), wide, right, lower, to_faces, np.uint64(place))


@compiled
def scatter_picture(
    grads: Float32,
    table: NDArray[np.int32],
    world_from_pixel: Float32,
    needed: Bools,
    to_faces: Float32,
) -> None:
    """`scatter` of the pixels of a picture, as `sample_picture` sees them; grads are (H W, C)."""
    size = table.shape[1] - 2
    wide = np.uint64(size + 2)
    flat = table.reshape(-1)
    height, width = needed.shape
    m = world_from_pixel
    for row in range(height):
        v = np.float32(row)
        x0, y0, z0 = (m[0, 1] * v + m[0, 2], m[1, 1] * v + m[1, 2], m[2, 1] * v + m[2, 2])
        for column in range(width):
            if not needed[row, column]:
                continue
            u = np.float32(column)
            x, y, z = m[0, 0] * u + x0, m[1, 0] * u + y0, m[2, 0] * u + z0
            corner, right, lower = corner_of(x, y, z, size)
            place = np.uint64(row * width + column)
            _spread(grads, flat, np.uint64(corner), wide, right, lower, to_faces, place)


@inlined
def _spread(grads, flat, corner, wide, right, lower, to_faces, place):
    a, b = np.uint64(flat[corner]), np.uint64(flat[corner + np.uint64(1)])
    c, d = np.uint64(flat[corner + wide]), np.uint64(flat[corner + wide + np.uint64(1)])
    left, upper = ONE - right, ONE - lower
    wa, wb, wc, wd = left * upper, right * upper, left * lower, right * lower
    for channel in range(grads.shape[1]):
        grad = grads[place, channel]
        to_faces[a, channel] += wa * grad
        to_faces[b, channel] += wb * grad
        to_faces[c, channel] += wc * grad
        to_faces[d, channel] += wd * grad
