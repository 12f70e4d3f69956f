"""Tumbling flakes: ellipsoids as Gaussians, turning about an axis of their own.

A table of shapes, orientations, axes and rates is drawn once; a flake picks one by its hash and
starts at a phase of its own, so that its attitude is a pure function of time.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms

SHAPES = 256
MIDDLE_AXIS = (0.6, 1.0)
SHORT_AXIS = (0.4, 0.8)
"""Ranges of the second and third axis of a flake, as shares of its first."""
TUMBLING_HZ = 0.5
"""Standard deviation of the rate of tumbling."""

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_ROWS = np.array([0, 0, 0, 1, 1, 2])
_COLUMNS = np.array([0, 1, 2, 1, 2, 2])


def shapes_in(rotation: Float64) -> Float32:
    """Covariances (SHAPES, 5, 6) of flakes of diameter 1, in the axes that `rotation` leads from.

    Args:
        rotation: (3, 3), world from camera.

    Returns:
        The five matrices A..E, as (xx, xy, xz, yy, yz, zz), of the covariance at phase p,
        A + B cos p + C sin p + D cos 2p + E sin 2p.
    """
    # A rotation of symmetric matrices is linear in their six numbers: one small product for all.
    first = rotation[_ROWS][:, _ROWS], rotation[_COLUMNS][:, _COLUMNS]
    second = rotation[_ROWS][:, _COLUMNS], rotation[_COLUMNS][:, _ROWS]
    diagonal = np.where(_ROWS == _COLUMNS, 0.5, 1.0)
    turn = (first[0] * first[1] + second[0] * second[1]) * diagonal[:, None]
    return np.asarray(tumbling()[0] @ turn, np.float32)


def shape_turns(time_s: float) -> Float64:
    """Turns (SHAPES,) that each entry of the table has made at `time_s`, reduced to [0, 1)."""
    turns: Float64 = np.mod(tumbling()[1] * time_s, 1.0)
    return turns


@lru_cache(maxsize=1)
def tumbling() -> tuple[Float64, Float64]:
    """The table: (SHAPES, 5, 6) covariances in world axes, and (SHAPES,) tumbling rates in Hz.

    Source:
        A Gaussian of the standard deviations axis / (2 sqrt 2) covers what the ellipsoid covers
        from every side: 2 pi sqrt(det) of its projection is the silhouette's area.
    """
    draws = uniforms(key_of("tumble"), 12 * SHAPES).reshape(12, SHAPES)
    middle = np.interp(draws[0], (0, 1), MIDDLE_AXIS)
    short = np.interp(draws[1], (0, 1), SHORT_AXIS)
    axes = np.stack([np.ones(SHAPES), middle, short], axis=1)
    axes /= np.sqrt(mean_silhouette(axes) / (np.pi / 4))[:, None]
    attitude = _rotations(_normals(draws[2:6]).T)
    covariance = attitude @ (axes[:, :, None] ** 2 / 8 * attitude.transpose(0, 2, 1))
    axis = _normals(draws[6:10]).T[:, :3]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    rates_hz = TUMBLING_HZ * _normals(draws[10:12])[0]
    return _harmonics(covariance, axis)[:, :, _ROWS, _COLUMNS], rates_hz


def mean_silhouette(axes: Float64) -> Float64:
    """Area (N,) of the shadows of ellipsoids of full axes (N, 3), averaged over all directions.

    Source:
        Cauchy: it is a quarter of the surface. The shadow along a unit n has the area
        pi/4 sqrt((bc n1)^2 + (ac n2)^2 + (ab n3)^2).
    """
    cosine, weight = np.polynomial.legendre.leggauss(24)
    sine = np.sqrt(1 - cosine**2)
    azimuth = 2 * np.pi * (np.arange(48) + 0.5) / 48
    squares = np.stack(
        [
            (sine[:, None] * np.cos(azimuth)) ** 2,
            (sine[:, None] * np.sin(azimuth)) ** 2,
            np.broadcast_to(cosine[:, None] ** 2, (24, 48)),
        ]
    )
    faces = (axes[:, [1, 0, 0]] * axes[:, [2, 2, 1]]) ** 2
    shadow = np.sqrt(np.tensordot(faces, squares, axes=1)).mean(axis=2)
    area: Float64 = np.pi / 4 * shadow @ weight / 2
    return area


def _harmonics(covariance: Float64, axis: Float64) -> Float64:
    """(N, 5, 3, 3) matrices of A + B cos p + C sin p + D cos 2p + E sin 2p.

    The rotation by p about n is P + Q cos p + K sin p with P = n n^T, Q = I - P and K the cross
    product with n (Rodrigues); the covariance turns with it from both sides.
    """
    p = axis[:, :, None] * axis[:, None, :]
    q = np.eye(3) - p
    k = np.cross(axis[:, None, :], np.eye(3)).transpose(0, 2, 1)

    def between(left: Float64, right: Float64) -> Float64:
        half: Float64 = left @ covariance @ right.transpose(0, 2, 1)
        return half + half.transpose(0, 2, 1) if left is not right else half

    qq, kk = between(q, q), between(k, k)
    parts = [
        between(p, p) + 0.5 * (qq + kk),
        between(p, q),
        between(p, k),
        0.5 * (qq - kk),
        0.5 * between(q, k),
    ]
    return np.stack(parts, axis=1)


def _normals(draws: Float64) -> Float64:
    """Standard normal numbers from uniform ones, two from two rows (Box and Muller)."""
    rows = []
    for k in range(0, len(draws) - 1, 2):
        radius = np.sqrt(-2 * np.log1p(-draws[k]))
        rows += [radius * f(2 * np.pi * draws[k + 1]) for f in (np.cos, np.sin)]
    return np.stack(rows)


def _rotations(quaternions: Float64) -> Float64:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
