"""Which splats touch which tiles of a picture, front to back. Compiled."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

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
    spans: Any = np.empty(len(order) + 1, np.int64)
    counts = np.zeros(columns * rows + 1, np.int64)
    touched = np.empty((_spans(parts, order, columns, rows, spans), 2), np.int32)
    _count(parts, order, columns, spans, touched, counts)
    starts = np.cumsum(counts)
    ranks = np.empty(int(starts[-1]), np.int32)
    _fill(parts, order, columns, spans, touched, starts[:-1].copy(), ranks)
    return Tiles(order, starts, ranks)


@inlined
def _tile_rows(part, rows):
    """First row of tiles that a splat may touch, and the one after the last."""
    reach = 2.0 * math.log(float(part[5]) / LEAST_ALPHA)
    a, b, c = float(part[2]), float(part[3]), float(part[4])
    high = math.sqrt(max(reach, 0.0) * a / (a * c - b * b))
    first = math.floor((float(part[1]) - high) / TILE_PX)
    last = math.floor((float(part[1]) + high) / TILE_PX)
    return max(int(first), 0), min(int(last) + 1, rows)


@compiled
def _spans(parts, order, columns, rows, spans):
    """Where each splat's spans begin, one for each row of tiles; returns how many there are."""
    total = 0
    for i in range(order.shape[0]):
        spans[i] = total
        first, last = _tile_rows(parts[order[i]], rows)
        total += max(last - first, 0)
    spans[order.shape[0]] = total
    return total


@compiled
def _count(parts, order, columns, spans, touched, counts):
    """The tiles from and to which each span goes; counts[tile + 1] how many touch a tile."""
    for i in range(order.shape[0]):
        part = parts[order[i]]
        u, v = float(part[0]), float(part[1])
        a, b, c = float(part[2]), float(part[3]), float(part[4])
        reach = max(2.0 * math.log(float(part[5]) / LEAST_ALPHA), 0.0)
        area = a * c - b * b
        wide = math.sqrt(reach * c / area)
        # Where the ellipse is widest: to its right at `slant` below the centre, to its left above.
        slant = -b / c * wide
        first, _ = _tile_rows(part, 1 << 30)
        for s in range(spans[i], spans[i + 1]):
            row = first + s - spans[i]
            top = row * TILE_PX - v
            bottom = top + (TILE_PX - 1)
            at = min(max(slant, top), bottom)
            right = (-b * at + math.sqrt(max(b * b * at * at - a * (c * at * at - reach), 0.0))) / a
            at = min(max(-slant, top), bottom)
            left = (-b * at - math.sqrt(max(b * b * at * at - a * (c * at * at - reach), 0.0))) / a
            # Half a pixel of margin: the kernel decides on each pixel by itself.
            low = max(int(math.floor((u + left - 0.5) / TILE_PX)), 0)
            high = min(int(math.floor((u + right + 0.5) / TILE_PX)) + 1, columns)
            touched[s, 0] = low
            touched[s, 1] = high
            for x in range(low, high):
                counts[row * columns + x + 1] += 1


@compiled
def _fill(parts, order, columns, spans, touched, places, ranks):
    """Write the lists; `places` is where the next entry of each tile goes."""
    for i in range(order.shape[0]):
        first, _ = _tile_rows(parts[order[i]], 1 << 30)
        for s in range(spans[i], spans[i + 1]):
            tile = (first + s - spans[i]) * columns
            for x in range(touched[s, 0], touched[s, 1]):
                ranks[places[tile + x]] = i
                places[tile + x] += 1
