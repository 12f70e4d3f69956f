"""Patches in the fog: log-normal fractal noise at rest in the drifting air. Compiled.

n is the sum of octaves, each of standard normal numbers at the points of a lattice, blended between
them and divided by the root of the sum of the squared blending weights, so that n is standard
normal at every place and not only on average; g = exp(kappa n - kappa^2 / 2) then has the mean 1
everywhere. A lattice point's number is a hash of its index: the noise is endless and never repeats.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import survival
from weather_aug.particles.kernels import cell_key
from weather_aug.render.froxels import even_layer


@compiled
def lattice(key, lowest, normal, out):
    """Standard normal numbers of a box of lattice points.

    Args:
        key: uint64 of the octave.
        lowest: (3,) int64 index of the box's first point.
        normal: (4096,) float32 quantiles of the standard normal distribution.
        out: (X, Y, Z) float32 out.
    """
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                word = cell_key(key, lowest[0] + i, lowest[1] + j, lowest[2] + k)
                out[i, j, k] = normal[word >> np.uint64(52)]


@inlined
def _eased(t):
    """Smooth step of zero slope and curvature at 0 and 1."""
    return t * t * t * (t * (t * np.float32(6.0) - np.float32(15.0)) + np.float32(10.0))


@inlined
def noise_at(points, lowest, strides, x, y, z):
    """Standard normal noise at lattice coordinates (x, y, z) inside a box of lattice points.

    Args:
        points: (X * Y * Z,) float32 numbers of the lattice points.
        lowest: Three float32, index of the first of them.
        strides: Two uint64, Y * Z and Z.
        x: float32, in lattice steps; as `y` and `z`.
        y: See `x`.
        z: See `x`.
    """
    one = np.float32(1.0)
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    u, v, w = _eased(x - fx), _eased(y - fy), _eased(z - fz)
    # Unsigned, because a signed index would be checked for wrapping around.
    i, j = np.uint64(np.int64(fx - lowest[0])), np.uint64(np.int64(fy - lowest[1]))
    near = i * strides[0] + j * strides[1] + np.uint64(np.int64(fz - lowest[2]))
    far, up, right = near + strides[0], strides[1], np.uint64(1)
    a = points[near] + w * (points[near + right] - points[near])
    b = points[near + up] + w * (points[near + up + right] - points[near + up])
    c = points[far] + w * (points[far + right] - points[far])
    d = points[far + up] + w * (points[far + up + right] - points[far + up])
    a, c = a + v * (b - a), c + v * (d - c)
    variance = (u * u + (one - u) * (one - u)) * (v * v + (one - v) * (one - v))
    variance = variance * (w * w + (one - w) * (one - w))
    return (a + u * (c - a)) / np.sqrt(variance)


@compiled
def add_octave(points, lowest, rest, turn, ray_x, ray_y, depth_m, amplitude, noise):
    """Add one octave at the samples of every ray.

    Args:
        points: (X, Y, Z) float32; see `lattice`.
        lowest: (3,) int64, counted from the lattice cell that holds the camera.
        rest: (3,) float32 place of the camera in its cell.
        turn: (3, 3) float32 lattice steps per metre of camera axes.
        ray_x: (C,) float32 tangents of the columns.
        ray_y: (R,) float32 tangents of the rows.
        depth_m: (J,) float32 depths of the samples.
        amplitude: (J,) float32 of this octave; once 0, then 0 for all farther samples.
        noise: (J, R, C) float32, added to.
    """
    flat = points.reshape(-1)
    strides = (np.uint64(points.shape[1] * points.shape[2]), np.uint64(points.shape[2]))
    first = (np.float32(lowest[0]), np.float32(lowest[1]), np.float32(lowest[2]))
    for j in range(depth_m.shape[0]):
        z, scale = depth_m[j], amplitude[j]
        if scale <= np.float32(0.0):
            break
        for r in range(ray_y.shape[0]):
            x0 = rest[0] + z * (turn[0, 1] * ray_y[r] + turn[0, 2])
            y0 = rest[1] + z * (turn[1, 1] * ray_y[r] + turn[1, 2])
            z0 = rest[2] + z * (turn[2, 1] * ray_y[r] + turn[2, 2])
            for c in range(ray_x.shape[0]):
                across = z * ray_x[c]
                noise[j, r, c] += scale * noise_at(
                    flat,
                    first,
                    strides,
                    x0 + turn[0, 0] * across,
                    y0 + turn[1, 0] * across,
                    z0 + turn[2, 0] * across,
                )


@compiled
def add_patches(noise, half_variance, even_share, kappa, slice_of, ends_m, per_height, out):
    """Add the fog of every step of every ray to its slice.

    Args:
        noise: (J, R, C) float32, of the steps' middles.
        half_variance: (J,) float32, half the variance of `noise`.
        even_share: (J,) share of the extinction that this fog carries at each step.
        kappa: Standard deviation of the logarithm of the extinction.
        slice_of: (J,) int64.
        ends_m: (J + 1,) depths between the steps.
        per_height: (R, C) rise of the rays per metre of depth over the scale height, 1/m.
        out: (R, C, NEAR_SLICES) float64, added to; see `froxels.accumulate`.
    """
    steps, rows, columns = noise.shape
    kappa32 = np.float32(kappa)
    before = np.zeros((rows, columns))
    for j in range(steps):
        mean = kappa32 * kappa32 * half_variance[j]
        share, k, end_m = even_share[j], slice_of[j], ends_m[j + 1]
        for r in range(rows):
            for c in range(columns):
                even = even_layer(end_m, per_height[r, c])
                gain = survival(mean - kappa32 * noise[j, r, c])
                out[r, c, k] += share * (even - before[r, c]) * gain
                before[r, c] = even
