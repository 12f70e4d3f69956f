"""Fewer points: cells of pixels and of space that hold one Gaussian each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms
from weather_aug.clip.types import Float64
from weather_aug.gaussians.points import View

DEPTH_BIN = math.log(1.15)
"""Pixels of one cell that differ more in the logarithm of their depth are surfaces of their own."""
MAX_SURPLUS = 0.05


def cells_of(
    views: Sequence[View], places: Sequence[tuple[NDArray[Any], ...]], count: int
) -> tuple[float, NDArray[np.int64]]:
    """Side of the cells in pixels, and the cell of each place (M,), numbered without gaps.

    There are at least `count` cells, if there are as many places, and hardly more.
    """
    numbers = np.concatenate([np.full(len(r), i) for i, (r, _) in enumerate(places)])
    rows, columns, bins = (
        np.concatenate(values)
        for values in zip(
            *(
                (
                    row * view.stride_px,
                    column * view.stride_px,
                    np.floor(np.log(view.depth_m[row, column]) / DEPTH_BIN).astype(np.int64),
                )
                for view, (row, column) in zip(views, places, strict=True)
            ),
            strict=True,
        )
    )

    def keys(side_px: float) -> NDArray[np.int64]:
        key: NDArray[np.int64] = numbers * 2**16 + (rows / side_px).astype(np.int64)
        return (key * 2**16 + (columns / side_px).astype(np.int64)) * 2**6 + bins + 8

    def size(side_px: float) -> int:
        # Sorted, because np.unique hashes where no order is asked for, thirty times slower.
        return 1 + int(np.count_nonzero(np.diff(np.sort(keys(side_px)))))

    low = float(views[0].stride_px)
    if len(rows) > count:
        low = _largest_with(size, low, count)
    _, cells = np.unique(keys(low), return_inverse=True)
    return low, cells


def voxels_of(points: Float64, smallest_m: float, count: int) -> tuple[float, NDArray[np.int64]]:
    """Side of voxels in metres, at least `smallest_m`, and the voxel of each point (M,).

    There are at most `count`.
    """
    # From a corner, so that in the end a single voxel holds them all.
    corner = points.min(axis=0)

    def numbered(side_m: float) -> NDArray[np.int64]:
        whole = np.floor((points - corner) / side_m).astype(np.int64)
        key = (whole[:, 0] * 2**21 + whole[:, 1]) * 2**21 + whole[:, 2]
        _, cells = np.unique(key, return_inverse=True)
        return cells

    side_m, cells = smallest_m, numbered(smallest_m)
    while int(cells.max()) + 1 > count:
        side_m *= max(1.02, math.sqrt((int(cells.max()) + 1) / count))
        cells = numbered(side_m)
    return side_m, cells


def some_of(total: int, count: int, seed: int) -> NDArray[np.bool_]:
    """(total,): `count` of them, drawn; all if there are no more."""
    kept = np.ones(total, np.bool_)
    surplus = total - count
    if surplus > 0:
        draws = uniforms(key_of("gs-cells", seed), total)
        kept[np.argsort(draws, kind="stable")[:surplus]] = False
    return kept


def means_of(values: Float64, cells: NDArray[np.int64]) -> Float64:
    """(C, …) mean of `values` (M, …) in each cell."""
    counts = np.bincount(cells)
    columns = [np.bincount(cells, column, len(counts)) / counts for column in values.T]
    return np.stack(columns, axis=-1) if len(counts) else np.zeros((0, values.shape[1]))


def _largest_with(size: Callable[[float], int], low: float, count: int) -> float:
    """About the largest x >= low with size(x) >= count; size falls as the square of x rises."""
    found, high = size(low), math.inf
    for _ in range(24):
        if found <= (1 + MAX_SURPLUS) * count:
            break
        guess = low * math.sqrt(found / ((1 + 0.5 * MAX_SURPLUS) * count))
        middle = guess if guess < high else 0.5 * (low + high)
        got = size(middle)
        if got >= count:
            low, found = middle, got
        else:
            high = middle
    return low
