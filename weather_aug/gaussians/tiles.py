"""Which splats touch which tiles of a picture, front to back. Compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined
from weather_aug.gaussians.projection import LEAST_ALPHA

TILE_PX = 8


class Tiles(NamedTuple):
    """Lists of splats by tile."""

    order: NDArray[np.uint32]
    """(V,) which Gaussians are drawn, nearest first."""
    starts: NDArray[np.int64]
    """(tiles + 1,) where each tile's list begins, row by row."""
    ranks: NDArray[np.int32]
    """Places in `order`, ascending within each tile."""


def tiles_of(
    parts: NDArray[np.float32],
    depths_m: NDArray[np.float32],
    radii_px: NDArray[np.float32],
    width: int,
    height: int,
) -> Tiles:
    """Sort splats by depth (equals by their index) and list them for each tile that they touch.

    Args:
        parts: (N, 6), see `projection.project`.
        depths_m: (N,) z, positive where drawn.
        radii_px: (N,), 0 for what is not drawn.
        width: Of the picture.
        height: Of the picture.
    """
    drawn = np.flatnonzero(radii_px > 0).astype(np.uint64)
    # Positive floats sort as their bits; one key of both needs no stable sort.
    keys = depths_m[drawn].view(np.uint32).astype(np.uint64) << np.uint64(32) | drawn
    keys.sort()
    order = (keys & np.uint64(0xFFFFFFFF)).astype(np.uint32)
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    firsts = np.empty(len(order), np.int32)
    spans = np.empty(len(order) + 1, np.int64)
    touched = np.empty((_spans(parts, order, rows, firsts, spans), 2), np.int32)
    counts = np.zeros(columns * rows + 1, np.int64)
    _count(parts, order, columns, firsts, spans, touched, counts)
    starts = np.cumsum(counts)
    ranks = np.empty(int(starts[-1]), np.int32)
    _fill(columns, firsts, spans, touched, starts[:-1].copy(), ranks)
    return Tiles(order, starts, ranks)


@compiled
def _spans(parts, order, rows, firsts, spans):
    """The first row of tiles of each splat, and where its spans begin: one for each row of tiles.

    Returns:
        How many spans there are.
    """
    total = 0
    for i in range(order.shape[0]):
        part = parts[order[i]]
        a, b, c = float(part[2]), float(part[3]), float(part[4])
        high = math.sqrt(_reach(part) * a / _determinant(a, b, c))
        first = max(math.floor((float(part[1]) - high) / TILE_PX), 0)
        last = min(math.floor((float(part[1]) + high) / TILE_PX), rows - 1)
        firsts[i] = first
        spans[i] = total
        total += max(int(last - first) + 1, 0)
    spans[order.shape[0]] = total
    return total


@inlined
def _determinant(a, b, c):
    """Of a conic; single precision leaves nothing, or less, of a very long needle's."""
    return max(a * c - b * b, 1e-7 * a * c)


@inlined
def _reach(part):
    """Twice the σ at which a splat falls to the cut."""
    return max(2.0 * math.log(float(part[5]) / LEAST_ALPHA), 0.0)


@compiled
def _count(parts, order, columns, firsts, spans, touched, counts):
    """The tiles from and to which each span goes; counts[tile + 1] how many touch a tile."""
    for i in range(order.shape[0]):
        part = parts[order[i]]
        u, v = float(part[0]), float(part[1])
        a, b, c = float(part[2]), float(part[3]), float(part[4])
        area = _determinant(a, b, c)
        reach = _reach(part)
        wide = math.sqrt(reach * c / area)
        # Half a pixel of margin: the kernel decides on each pixel by itself.
        leftmost = max(math.floor((u - wide - 0.5) / TILE_PX), 0)
        rightmost = min(math.floor((u + wide + 0.5) / TILE_PX), columns - 1)
        # The ellipse is widest to its right at `slant` below the centre, to its left above it.
        slant = -b / c * wide
        a_inverse = 1.0 / a
        for s in range(spans[i], spans[i + 1]):
            row = firsts[i] + s - spans[i]
            low, high = leftmost, rightmost
            if high > low:
                top = row * TILE_PX - v
                bottom = top + (TILE_PX - 1)
                at = min(max(slant, top), bottom)
                right = (math.sqrt(max(a * reach - area * at * at, 0.0)) - b * at) * a_inverse
                at = min(max(-slant, top), bottom)
                left = (-math.sqrt(max(a * reach - area * at * at, 0.0)) - b * at) * a_inverse
                low = max(math.floor((u + left - 0.5) / TILE_PX), low)
                high = min(math.floor((u + right + 0.5) / TILE_PX), high)
            touched[s, 0] = low
            touched[s, 1] = high + 1
            for x in range(low, high + 1):
                counts[row * columns + x + 1] += 1


@compiled
def _fill(columns, firsts, spans, touched, places, ranks):
    """Write the lists; `places` is where the next entry of each tile goes."""
    for i in range(firsts.shape[0]):
        for s in range(spans[i], spans[i + 1]):
            tile = (firsts[i] + s - spans[i]) * columns
            for x in range(touched[s, 0], touched[s, 1]):
                ranks[places[tile + x]] = i
                places[tile + x] += 1
