"""Rotations as quaternions (w, x, y, z), vectors and matrices.

In numpy for what was recorded, in torch, with gradients, for what is learnt.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Float64 = NDArray[np.float64]

_NEAR = 1e-4
"""Of a squared sine: below it a series is exact to 1e-13 where the closed form divides 0 by 0."""


def quaternions_of(rotations: Float64) -> Float64:
    """(..., 4) unit quaternions with w at least 0 of rotation matrices (..., 3, 3).

    Source:
        Shepperd 1978 in the form of Bar-Itzhack 2000: each row of 4 q qᵀ is q times one of its
        entries, and the row of the greatest entry is well conditioned for any angle.
    """
    rows = np.moveaxis(np.array(_outer_rows(rotations)), (0, 1), (-2, -1))
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    row = np.where(row[..., :1] < 0, -row, row)
    unit: Float64 = row / np.linalg.norm(row, axis=-1, keepdims=True)
    return unit


def quaternions_of_tensor(rotations: Tensor) -> Tensor:
    """`quaternions_of` with gradients; the sign of w is whatever it is."""
    rows = torch.stack([torch.stack(row, -1) for row in _outer_rows(rotations)], -2)
    best = torch.diagonal(rows.detach(), dim1=-2, dim2=-1).argmax(-1)
    row = torch.gather(rows, -2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return row / row.norm(dim=-1, keepdim=True)


def _outer_rows(r: Any) -> list[list[Any]]:
    """The rows of 4 q qᵀ, of arrays or tensors (..., 3, 3)."""
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    wx, wy, wz = (
        r[..., 2, 1] - r[..., 1, 2],
        r[..., 0, 2] - r[..., 2, 0],
        r[..., 1, 0] - r[..., 0, 1],
    )
    xy, xz, yz = (
        r[..., 0, 1] + r[..., 1, 0],
        r[..., 0, 2] + r[..., 2, 0],
        r[..., 1, 2] + r[..., 2, 1],
    )
    return [
        [1 + xx + yy + zz, wx, wy, wz],
        [wx, 1 + xx - yy - zz, xy, xz],
        [wy, xy, 1 - xx + yy - zz, yz],
        [wz, xz, yz, 1 - xx - yy + zz],
    ]


def slerped(start: Float64, end: Float64, share: float) -> Float64:
    """(3, 3) rotation on the shortest way from `start` (share 0, bit for bit) to `end` (share 1).

    Source:
        Shoemake 1985, spherical linear interpolation.
    """
    w, *axis = quaternions_of(start.T @ end)
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return start.copy()
    half = share * float(np.arctan2(sine, w))
    turned: Float64 = start @ _matrix(np.cos(half), np.sin(half) / sine * np.array(axis))
    return turned


def _matrix(w: float, axis: Float64) -> Float64:
    x, y, z = axis
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrices_of(quaternions: Tensor) -> Tensor:
    """(..., 3, 3) rotation matrices of unit quaternions (..., 4); of (1, 0, 0, 0) exactly 1."""
    w, x, y, z = quaternions.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def product(first: Tensor, second: Tensor) -> Tensor:
    """(..., 4) Hamilton product: the rotation `second`, then `first`."""
    w, x, y, z = first.unbind(-1)
    a, b, c, d = second.unbind(-1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        -1,
    )


def quaternions_of_vectors(vectors_rad: Tensor) -> Tensor:
    """(..., 4) unit quaternions of rotation vectors (..., 3): axis times angle, radians.

    Of zero exactly (1, 0, 0, 0), with a gradient.
    """
    square = 0.25 * (vectors_rad * vectors_rad).sum(-1, keepdim=True)
    near = square < _NEAR
    half = torch.where(near, torch.ones_like(square), square).sqrt()
    cosine = torch.where(near, 1 - square / 2 + square**2 / 24 - square**3 / 720, half.cos())
    sinc = torch.where(near, 1 - square / 6 + square**2 / 120 - square**3 / 5040, half.sin() / half)
    return torch.cat([cosine, 0.5 * sinc * vectors_rad], -1)


def slerped_tensor(start: Tensor, end: Tensor, share: Tensor) -> Tensor:
    """(..., 4) unit quaternions on the shortest way from `start` to `end`, with gradients.

    Args:
        start: (..., 4) unit.
        end: (..., 4) unit.
        share: (...) in 0..1; where it is 0 the result is `start` bit for bit.
    """
    end = torch.where((start * end).sum(-1, keepdim=True) < 0, -end, end)
    half_chord = 0.5 * (end - start)
    # The sine of half the angle between the two, squared; a cosine near 1 would lose it.
    square = (half_chord * half_chord).sum(-1).clamp(max=1.0)
    first, second = _weight(1 - share, square), _weight(share, square)
    mixed = first[..., None] * start + second[..., None] * end
    return torch.where((share == 0)[..., None], start, mixed)


def _weight(share: Tensor, square: Tensor) -> Tensor:
    """sin(share θ) / sin θ with sin²(θ/2) = `square` at most 1/2."""
    near = square < _NEAR
    angle = 2 * torch.where(near, torch.full_like(square, 0.25), square).sqrt().asin()
    squared = 4 * square * (1 + square / 3 + 8 * square**2 / 45)
    even = share * share
    series = 1 + squared * (1 - even) / 6 + squared**2 * (7 - 10 * even + 3 * even**2) / 360
    return torch.where(near, share * series, (share * angle).sin() / angle.sin())
