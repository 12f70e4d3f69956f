"""A coarse volume over the view that says how much fog a ray has met, against even fog.

A froxel node belongs to a ray of the whole picture (a point of a coarse grid that starts at pixel
(0, 0)) and to a depth. It holds the share G: the optical depth of the uneven fog from the camera to
that depth over the optical depth of even fog to the same depth. A pixel looks G up at its own depth
and multiplies its own, exact optical depth by it: nothing bleeds over depth edges. Between two
depths G is linear in 1 / depth, that is, the fog of a slice is spread evenly over it, so that the
optical depth never falls with depth (where fog thins with height, to 0.001).

Compiled; per-pixel numbers are float32.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

NEAR_SLICES = 32
FAR_SLICES = 12
SLICES = 1 + NEAR_SLICES + FAR_SLICES
"""One at the camera, those up to `Z_FAR_M` ever wider, those beyond even in 1 / depth."""
Z_FAR_M = NEAR_SLICES + NEAR_SLICES**2 / 8
"""Depth (160 m) behind which the fog is even."""


class FogVolume(NamedTuple):
    """Shares G at the nodes around a window; see the module's text."""

    share: NDArray[np.float32]
    """(SLICES, R, C), or (0, 1, 1) where the fog is even."""
    inverse_depth: NDArray[np.float32]
    """(SLICES,) 1/m; that of slice 0 only has to be larger than the next one's."""
    per_step: NDArray[np.float32]
    """(SLICES,) 1 / (inverse_depth of this slice - of the next), metres."""
    first_row: np.int64
    """Node row of share[:, 0], counted from the picture's top."""
    first_column: np.int64
    """Node column of share[:, :, 0], counted from the picture's left edge."""
    nodes_per_px: np.float32
    """Nodes of the grid per pixel."""


def slice_depths_m() -> NDArray[np.float64]:
    """(SLICES,) depths of the slices, metres; the last is `inf`.

    z_k = k + k^2 / 8 up to `Z_FAR_M`, in steps of 1.1 to 8.9 m.
    """
    k = np.arange(NEAR_SLICES + 1, dtype=np.float64)
    far = np.arange(1, FAR_SLICES, dtype=np.float64) / FAR_SLICES
    return np.concatenate([k + k * k / 8, Z_FAR_M / (1 - far), [np.inf]])


def volume_of(
    share: NDArray[np.float32], first_row: int, first_column: int, node_px: float
) -> FogVolume:
    """`share` as a volume, with the tables that a look-up needs."""
    depths_m = slice_depths_m()
    depths_m[0] = 0.5 * depths_m[1]
    inverse = 1.0 / depths_m
    per_step = np.append(1.0 / -np.diff(inverse), 0.0)
    return FogVolume(
        share,
        inverse.astype(np.float32),
        per_step.astype(np.float32),
        np.int64(first_row),
        np.int64(first_column),
        np.float32(1.0 / node_px),
    )


@lru_cache(maxsize=1)
def even_fog() -> FogVolume:
    """A volume without nodes, to hand to a kernel where the fog is even: do not look it up."""
    return volume_of(np.ones((0, 1, 1), np.float32), 0, 0, 1.0)


@compiled
def share_row(volume, y, left, depth, nodes, place, out):
    """Shares G of one row of pixels at their own depths.

    Args:
        volume: FogVolume whose nodes surround the row.
        y: Row in the whole picture.
        left: First column in the whole picture.
        depth: (W,) float32 z-depth, metres, above 0; `inf` is endless (G of a saturated path).
        nodes: (SLICES * C,) float32 work space, C the volume's columns.
        place: (W,) uint32 work space.
        out: (W,) float32 out.
    """
    share = volume.share
    slices, rows, columns = share.shape
    fy = np.float32(y) * volume.nodes_per_px
    row = np.floor(fy)
    wy = fy - row
    upper = min(max(np.int64(row) - volume.first_row, 0), rows - 2)
    for s in range(slices):
        a, b = share[s, upper], share[s, upper + 1]
        across = nodes[s * columns : (s + 1) * columns]
        for c in range(columns):
            across[c] = a[c] + wy * (b[c] - a[c])
    zero, one = np.float32(0.0), np.float32(1.0)
    four, eight, sixteen = np.float32(4.0), np.float32(8.0), np.float32(16.0)
    near, far = np.float32(NEAR_SLICES), np.float32(FAR_SLICES)
    z_far, last = np.float32(Z_FAR_M), np.float32(SLICES - 2)
    first, rightmost = np.float32(volume.first_column), np.float32(columns - 2)
    stride, nodes_per_px, start = np.float32(columns), volume.nodes_per_px, np.float32(left)
    # Arithmetic first and look-ups second, with unsigned indices that need no wrapping around:
    # together they would run one pixel at a time, seven times slower.
    for x in range(depth.shape[0]):
        z = depth[x]
        close = np.sqrt(sixteen + eight * z) - four
        beyond = near + far * (one - z_far / z)
        position = close if z < z_far else beyond
        slice_ = np.floor(position if position < last else last)
        column = np.floor((np.float32(x) + start) * nodes_per_px) - first
        column = column if column < rightmost else rightmost
        column = column if column > zero else zero
        out[x] = slice_
        place[x] = np.uint32(slice_ * stride + column)
    right, deeper = np.uint32(1), np.uint32(columns)
    for x in range(depth.shape[0]):
        k = np.uint32(out[x])
        v = (volume.inverse_depth[k] - one / depth[x]) * volume.per_step[k]
        v = v if v > zero else zero
        v = v if v < one else one
        fx = (np.float32(x) + start) * nodes_per_px
        wx = fx - np.floor(fx)
        i = place[x]
        j = i + deeper
        here = nodes[i] + wx * (nodes[i + right] - nodes[i])
        there = nodes[j] + wx * (nodes[j + right] - nodes[j])
        out[x] = here + v * (there - here)


@compiled
def even_layer(z, per_height):
    """Optical depth of even fog to depth z, in units of its extinction at the camera (metres).

    Args:
        z: Metres, may be `inf`.
        per_height: Rise of the ray per metre of depth over the scale height, 1/m.
    """
    heights = z * per_height if per_height != 0.0 else 0.0
    # Below eight scale heights under the camera `medium.layer_share` thickens no more.
    if heights < -8.0:
        return z * (np.expm1(8.0) / 8.0)
    if np.abs(heights) < 1e-6:
        return z * (1.0 - 0.5 * heights)
    return -np.expm1(-heights) / per_height


@compiled
def accumulate(increments, per_height, depths_m, out):
    """Turn what each slice adds into shares, and continue them behind the last slice.

    Args:
        increments: (R, C, NEAR_SLICES) float64, fog between a slice and the one before, in units of
            the extinction at the camera (metres of depth).
        per_height: (R, C) rise of the rays per metre of depth over the scale height, 1/m.
        depths_m: (SLICES,).
        out: (SLICES, R, C) float32 out.
    """
    rows, columns, near = increments.shape
    for r in range(rows):
        for c in range(columns):
            total = 0.0
            slope = per_height[r, c]
            for k in range(near):
                total += increments[r, c, k]
                out[k + 1, r, c] = total / even_layer(depths_m[k + 1], slope)
            out[0, r, c] = out[1, r, c]
            even = even_layer(depths_m[near], slope)
            surplus = total - even
            for k in range(near + 1, out.shape[0]):
                out[k, r, c] = 1.0 + surplus / even_layer(depths_m[k], slope)
