"""Compiled loops of `placing`: Gaussians from the frames of their owners into the world, and back.

M Gaussians of A owners; offsets are sums of B basis functions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@compiled
def place(
    means: Float32,
    quaternions: Float32,
    owners: NDArray[np.int64],
    offsets: Float32,
    poses: Float32,
    turns: Float32,
    bases: Float32,
    means_world: Float32,
    quaternions_world: Float32,
) -> None:
    """Write the places (M, 3) and the quaternions (M, 4) in world axes.

    Of means (M, 3), quaternions (M, 4), offsets (M, B, 3), poses (A, 4, 4), their rotations as
    quaternions (A, 4) and bases (A, B).
    """
    for row in range(len(means)):
        owner = owners[row]
        x, y, z = means[row, 0], means[row, 1], means[row, 2]
        for term in range(bases.shape[1]):
            share = bases[owner, term]
            x += share * offsets[row, term, 0]
            y += share * offsets[row, term, 1]
            z += share * offsets[row, term, 2]
        for axis in range(3):
            means_world[row, axis] = (
                poses[owner, axis, 0] * x
                + poses[owner, axis, 1] * y
                + poses[owner, axis, 2] * z
                + poses[owner, axis, 3]
            )
        w, i, j, k = turns[owner, 0], turns[owner, 1], turns[owner, 2], turns[owner, 3]
        a, b = quaternions[row, 0], quaternions[row, 1]
        c, d = quaternions[row, 2], quaternions[row, 3]
        quaternions_world[row, 0] = w * a - i * b - j * c - k * d
        quaternions_world[row, 1] = w * b + i * a + j * d - k * c
        quaternions_world[row, 2] = w * c - i * d + j * a + k * b
        quaternions_world[row, 3] = w * d + i * c - j * b + k * a


@compiled
def place_back(
    means: Float32,
    quaternions: Float32,
    owners: NDArray[np.int64],
    offsets: Float32,
    poses: Float32,
    turns: Float32,
    bases: Float32,
    d_means_world: Float32,
    d_quaternions_world: Float32,
    d_means: Float32,
    d_quaternions: Float32,
    d_offsets: Float32,
    d_poses: Float64,
    d_turns: Float64,
) -> None:
    """Write the gradients of means, quaternions and offsets; add those of poses and turns."""
    for row in range(len(means)):
        owner = owners[row]
        x, y, z = means[row, 0], means[row, 1], means[row, 2]
        for term in range(bases.shape[1]):
            share = bases[owner, term]
            x += share * offsets[row, term, 0]
            y += share * offsets[row, term, 1]
            z += share * offsets[row, term, 2]
        dx, dy, dz = d_means_world[row, 0], d_means_world[row, 1], d_means_world[row, 2]
        for axis in range(3):
            own = poses[owner, 0, axis] * dx + poses[owner, 1, axis] * dy
            own += poses[owner, 2, axis] * dz
            d_means[row, axis] = own
            for term in range(bases.shape[1]):
                d_offsets[row, term, axis] = bases[owner, term] * own
            slope = np.float64(d_means_world[row, axis])
            d_poses[owner, axis, 0] += slope * x
            d_poses[owner, axis, 1] += slope * y
            d_poses[owner, axis, 2] += slope * z
            d_poses[owner, axis, 3] += slope
        w, i, j, k = turns[owner, 0], turns[owner, 1], turns[owner, 2], turns[owner, 3]
        a, b = quaternions[row, 0], quaternions[row, 1]
        c, d = quaternions[row, 2], quaternions[row, 3]
        dw, di = d_quaternions_world[row, 0], d_quaternions_world[row, 1]
        dj, dk = d_quaternions_world[row, 2], d_quaternions_world[row, 3]
        d_quaternions[row, 0] = w * dw + i * di + j * dj + k * dk
        d_quaternions[row, 1] = w * di - i * dw - j * dk + k * dj
        d_quaternions[row, 2] = w * dj + i * dk - j * dw - k * di
        d_quaternions[row, 3] = w * dk - i * dj + j * di - k * dw
        d_turns[owner, 0] += np.float64(dw * a + di * b + dj * c + dk * d)
        d_turns[owner, 1] += np.float64(-dw * b + di * a - dj * d + dk * c)
        d_turns[owner, 2] += np.float64(-dw * c + di * d + dj * a - dk * b)
        d_turns[owner, 3] += np.float64(-dw * d - di * c + dj * b + dk * a)
