"""Spherical harmonics to degree 3 and the way back for gradients. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


@inlined
def _basis(x, y, z, count, out):
    """The first `count` functions at a unit vector, with the signs of 3DGS."""
    out[0] = C0
    if count > 1:
        out[1] = -C1 * y
        out[2] = C1 * z
        out[3] = -C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = C2[0] * x * y
        out[5] = -C2[0] * y * z
        out[6] = C2[1] * (2.0 * zz - xx - yy)
        out[7] = -C2[0] * x * z
        out[8] = C2[2] * (xx - yy)
        if count > 9:
            out[9] = -C3[0] * y * (3.0 * xx - yy)
            out[10] = C3[1] * x * y * z
            out[11] = -C3[2] * y * (4.0 * zz - xx - yy)
            out[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            out[13] = -C3[2] * x * (4.0 * zz - xx - yy)
            out[14] = C3[4] * z * (xx - yy)
            out[15] = -C3[0] * x * (xx - 3.0 * yy)


@inlined
def _basis_back(x, y, z, count, d, out):
    """Gradient of x, y, z as free numbers, given `d` of the functions."""
    dx, dy, dz = 0.0, 0.0, 0.0
    if count > 1:
        dy -= C1 * d[1]
        dz += C1 * d[2]
        dx -= C1 * d[3]
    if count > 4:
        dx += C2[0] * (y * d[4] - z * d[7]) + 2.0 * x * (C2[2] * d[8] - C2[1] * d[6])
        dy += C2[0] * (x * d[4] - z * d[5]) - 2.0 * y * (C2[2] * d[8] + C2[1] * d[6])
        dz += -C2[0] * (y * d[5] + x * d[7]) + 4.0 * C2[1] * z * d[6]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        dx += -6.0 * C3[0] * x * y * d[9] + C3[1] * y * z * d[10] + 2.0 * C3[2] * x * y * d[11]
        dx += -6.0 * C3[3] * x * z * d[12] - C3[2] * (4.0 * zz - 3.0 * xx - yy) * d[13]
        dx += 2.0 * C3[4] * x * z * d[14] - 3.0 * C3[0] * (xx - yy) * d[15]
        dy += -3.0 * C3[0] * (xx - yy) * d[9] + C3[1] * x * z * d[10]
        dy += -C3[2] * (4.0 * zz - xx - 3.0 * yy) * d[11] - 6.0 * C3[3] * y * z * d[12]
        dy += 2.0 * C3[2] * x * y * d[13] - 2.0 * C3[4] * y * z * d[14]
        dy += 6.0 * C3[0] * x * y * d[15]
        dz += C3[1] * x * y * d[10] - 8.0 * C3[2] * z * (y * d[11] + x * d[13])
        dz += C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * d[12] + C3[4] * (xx - yy) * d[14]
    out[0], out[1], out[2] = dx, dy, dz


@compiled
def colours(sh, means, centre, count, out):
    """Fill `out` (N, 3) with colours seen from `centre`, floored at 0."""
    values = np.empty(16)
    for n in range(sh.shape[0]):
        x = float(means[n, 0]) - centre[0]
        y = float(means[n, 1]) - centre[1]
        z = float(means[n, 2]) - centre[2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        _basis(x / length, y / length, z / length, count, values)
        for c in range(3):
            total = 0.5
            for k in range(count):
                total += values[k] * sh[n, k, c]
            out[n, c] = max(total, 0.0)


@compiled
def colours_back(sh, means, centre, count, seen, d_colours, d_sh, d_means):
    """Gradients: `d_sh` (N, K, 3) and `d_means` (N, 3) are written; of the centre is returned."""
    values = np.empty(16)
    d_values = np.empty(16)
    d_unit = np.empty(3)
    d_centre = np.zeros(3)
    for n in range(sh.shape[0]):
        x = float(means[n, 0]) - centre[0]
        y = float(means[n, 1]) - centre[1]
        z = float(means[n, 2]) - centre[2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        x, y, z = x / length, y / length, z / length
        _basis(x, y, z, count, values)
        d_values[:] = 0.0
        for k in range(d_sh.shape[1]):
            for c in range(3):
                d_sh[n, k, c] = 0.0
        for c in range(3):
            # Below the floor a colour does not change.
            d = float(d_colours[n, c]) if seen[n, c] > 0.0 else 0.0
            for k in range(count):
                d_sh[n, k, c] = d * values[k]
                d_values[k] += d * sh[n, k, c]
        _basis_back(x, y, z, count, d_values, d_unit)
        along = d_unit[0] * x + d_unit[1] * y + d_unit[2] * z
        for j in range(3):
            unit = x if j == 0 else (y if j == 1 else z)
            d = (d_unit[j] - along * unit) / length
            d_means[n, j] = d
            d_centre[j] -= d
    return d_centre
