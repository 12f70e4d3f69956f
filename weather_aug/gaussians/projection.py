"""Gaussians in space → Gaussians on a picture, and the way back for gradients. Compiled.

Sources:
    EWA splatting (Zwicker et al. 2001) as in 3DGS (Kerbl et al. 2023); dilation, compensation,
    clamp of the Jacobian and cut at 1/255 with the constants of gsplat.
"""

from __future__ import annotations

import math

import numpy as np

from weather_aug._compiled import compiled, inlined

DILATION_PX2 = 0.3
LEAST_COMPENSATION = 2.5e-5
"""Of the square of the factor by which a splat's opacity makes up for its dilation."""
LEAST_ALPHA = 1.0 / 255.0
CLAMP_MARGIN = 0.3
"""How far beyond the picture the Jacobian follows a centre, in tangents of half the view."""

PARTS = 6
"""u, v (centre), A, B, C (conic) and the opacity: what a row of projected values holds."""


@inlined
def _rotation(q, out):
    """Rotation of a quaternion (w, x, y, z) of any length; returns that length."""
    w, x, y, z = float(q[0]), float(q[1]), float(q[2]), float(q[3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return length


@inlined
def _placed(mean, view, out):
    """Camera coordinates of a centre."""
    for i in range(3):
        out[i] = (
            view[i, 0] * float(mean[0])
            + view[i, 1] * float(mean[1])
            + view[i, 2] * float(mean[2])
            + view[i, 3]
        )


@inlined
def _axes_on_picture(view, rotation, scale, at, lens, axes, flat):
    """The three half axes in camera coordinates, and on the picture (2, 3)."""
    for i in range(3):
        for k in range(3):
            total = 0.0
            for j in range(3):
                total += view[i, j] * rotation[j, k]
            axes[i, k] = total * float(scale[k])
    z = at[2]
    x = min(max(at[0] / z, -lens[4]), lens[5])
    y = min(max(at[1] / z, -lens[6]), lens[7])
    for k in range(3):
        flat[0, k] = lens[0] / z * (axes[0, k] - x * axes[2, k])
        flat[1, k] = lens[1] / z * (axes[1, k] - y * axes[2, k])


@inlined
def _squared_area(flat):
    """Determinant of the covariance on the picture, without the cancellation of a·c - b²."""
    x = flat[0, 1] * flat[1, 2] - flat[0, 2] * flat[1, 1]
    y = flat[0, 2] * flat[1, 0] - flat[0, 0] * flat[1, 2]
    z = flat[0, 0] * flat[1, 1] - flat[0, 1] * flat[1, 0]
    return x * x + y * y + z * z


@inlined
def _covariance(flat):
    a = flat[0, 0] * flat[0, 0] + flat[0, 1] * flat[0, 1] + flat[0, 2] * flat[0, 2]
    b = flat[0, 0] * flat[1, 0] + flat[0, 1] * flat[1, 1] + flat[0, 2] * flat[1, 2]
    c = flat[1, 0] * flat[1, 0] + flat[1, 1] * flat[1, 1] + flat[1, 2] * flat[1, 2]
    return a, b, c


@compiled
def project(
    means, quaternions, scales, opacities, view, lens, near, antialiased, parts, depths, radii
):
    """Fill `parts` (N, 6), `depths` and `radii` (N,); a radius of 0 is not drawn.

    Args:
        means: (N, 3).
        quaternions: (N, 4).
        scales: (N, 3).
        opacities: (N,).
        view: (4, 4) float64, camera from world.
        lens: fx, fy, cx, cy, and the limits of -x/z, x/z, -y/z, y/z for the Jacobian.
        near: Nearest z, metres.
        antialiased: Whether opacities make up for the dilation.
        parts: Written.
        depths: Written, metres.
        radii: Written, pixels.
    """
    width, height = lens[8], lens[9]
    rotation = np.empty((3, 3))
    axes = np.empty((3, 3))
    flat = np.empty((2, 3))
    at = np.empty(3)
    for n in range(means.shape[0]):
        radii[n] = 0.0
        depths[n] = 0.0
        for k in range(PARTS):
            parts[n, k] = 0.0
        _placed(means[n], view, at)
        z = at[2]
        if not z >= near:
            continue
        _rotation(quaternions[n], rotation)
        _axes_on_picture(view, rotation, scales[n], at, lens, axes, flat)
        a, b, c = _covariance(flat)
        det = _squared_area(flat)
        # In this form there is nothing to cancel.
        dilated = det + DILATION_PX2 * (a + c) + DILATION_PX2 * DILATION_PX2
        opacity = float(opacities[n])
        if antialiased:
            opacity *= math.sqrt(max(det / dilated, LEAST_COMPENSATION))
        if not opacity >= LEAST_ALPHA:
            continue
        a += DILATION_PX2
        c += DILATION_PX2
        u = lens[0] * at[0] / z + lens[2]
        v = lens[1] * at[1] / z + lens[3]
        reach = math.sqrt(2.0 * math.log(opacity / LEAST_ALPHA))
        wide, high = reach * math.sqrt(a), reach * math.sqrt(c)
        if not (u + wide >= 0.0 and u - wide <= width - 1.0):
            continue
        if not (v + high >= 0.0 and v - high <= height - 1.0):
            continue
        parts[n, 0] = u
        parts[n, 1] = v
        parts[n, 2] = c / dilated
        parts[n, 3] = -b / dilated
        parts[n, 4] = a / dilated
        parts[n, 5] = opacity
        depths[n] = z
        # A splat as faint as the cut reaches nowhere, and is drawn at its own centre all the same.
        radii[n] = max(wide, high, 1e-3)


@compiled
def project_back(
    means, quaternions, scales, opacities, view, lens, antialiased, radii, d_parts, d_depths, rows
):
    """Gradients of everything that `project` reads.

    Args:
        means: As in `project`, and all up to `radii`.
        quaternions: As in `project`.
        scales: As in `project`.
        opacities: As in `project`.
        view: As in `project`.
        lens: As in `project`.
        antialiased: As in `project`.
        radii: (N,), what `project` wrote.
        d_parts: (N, 6), of the loss with respect to `parts`.
        d_depths: (N,).
        rows: (N, 11) written: of the mean (3), quaternion (4), scales (3) and opacity.

    Returns:
        (3, 4) float64, of the view.
    """
    d_view = np.zeros((3, 4))
    rotation = np.empty((3, 3))
    axes = np.empty((3, 3))
    flat = np.empty((2, 3))
    at = np.empty(3)
    d_at = np.empty(3)
    d_flat = np.empty((2, 3))
    d_axes = np.empty((3, 3))
    d_half = np.empty((3, 3))
    for n in range(means.shape[0]):
        for k in range(11):
            rows[n, k] = 0.0
        if not radii[n] > 0.0:
            continue
        _placed(means[n], view, at)
        length = _rotation(quaternions[n], rotation)
        _axes_on_picture(view, rotation, scales[n], at, lens, axes, flat)
        a, b, c = _covariance(flat)
        det = _squared_area(flat)
        dilated = det + DILATION_PX2 * (a + c) + DILATION_PX2 * DILATION_PX2
        opacity = float(opacities[n])
        # Of the dilated covariance: -K G K, K the conic, G the gradient of it.
        p, q, r = (c + DILATION_PX2) / dilated, -b / dilated, (a + DILATION_PX2) / dilated
        ga, gb, gc = float(d_parts[n, 2]), 0.5 * float(d_parts[n, 3]), float(d_parts[n, 4])
        first0, first1 = p * ga + q * gb, p * gb + q * gc
        second0, second1 = q * ga + r * gb, q * gb + r * gc
        d_a = -(first0 * p + first1 * q)
        d_b = -(first0 * q + first1 * r)
        d_c = -(second0 * q + second1 * r)
        d_opacity = float(d_parts[n, 5])
        if antialiased:
            share = det / dilated
            factor = math.sqrt(max(share, LEAST_COMPENSATION))
            if share > LEAST_COMPENSATION:
                d_share = 0.5 * d_opacity * opacity / (factor * dilated)
                d_a += d_share * (c - share * (c + DILATION_PX2))
                d_c += d_share * (a - share * (a + DILATION_PX2))
                d_b += d_share * b * (share - 1.0)
            d_opacity *= factor
        z = at[2]
        x = min(max(at[0] / z, -lens[4]), lens[5])
        y = min(max(at[1] / z, -lens[6]), lens[7])
        fx, fy = lens[0], lens[1]
        d_x, d_y = 0.0, 0.0
        d_z = float(d_depths[n])
        for k in range(3):
            d_flat[0, k] = 2.0 * (d_a * flat[0, k] + d_b * flat[1, k])
            d_flat[1, k] = 2.0 * (d_b * flat[0, k] + d_c * flat[1, k])
            d_axes[0, k] = fx / z * d_flat[0, k]
            d_axes[1, k] = fy / z * d_flat[1, k]
            d_axes[2, k] = -(fx * x * d_flat[0, k] + fy * y * d_flat[1, k]) / z
            d_x -= fx / z * axes[2, k] * d_flat[0, k]
            d_y -= fy / z * axes[2, k] * d_flat[1, k]
            d_z -= (flat[0, k] * d_flat[0, k] + flat[1, k] * d_flat[1, k]) / z
        # d_x, d_y are those of the clamped x/z and y/z; where the clamp holds they end here.
        d_x = d_x if -lens[4] < at[0] / z < lens[5] else 0.0
        d_y = d_y if -lens[6] < at[1] / z < lens[7] else 0.0
        d_x += fx * float(d_parts[n, 0])
        d_y += fy * float(d_parts[n, 1])
        d_at[0], d_at[1] = d_x / z, d_y / z
        d_at[2] = d_z - (d_x * at[0] + d_y * at[1]) / (z * z)
        for i in range(3):
            for j in range(3):
                d_view[i, j] += d_at[i] * float(means[n, j])
                rows[n, j] += view[i, j] * d_at[i]
            d_view[i, 3] += d_at[i]
        for j in range(3):
            for k in range(3):
                # Of rotation times scale: what the axes were before the view turned them.
                total = 0.0
                for i in range(3):
                    total += view[i, j] * d_axes[i, k]
                    d_view[i, j] += d_axes[i, k] * rotation[j, k] * float(scales[n, k])
                rows[n, 7 + k] += total * rotation[j, k]
                d_half[j, k] = total * float(scales[n, k])
        _quaternion_back(quaternions[n], length, d_half, rows[n])
        rows[n, 10] = d_opacity
    return d_view


@inlined
def _quaternion_back(quaternion, length, d_rotation, row):
    """Gradient of a quaternion of any length from that of its rotation; into row[3:7]."""
    w, x = float(quaternion[0]) / length, float(quaternion[1]) / length
    y, z = float(quaternion[2]) / length, float(quaternion[3]) / length
    d = d_rotation
    d_w = 2.0 * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]))
    d_x = 2.0 * (
        w * (d[2, 1] - d[1, 2])
        + y * (d[0, 1] + d[1, 0])
        + z * (d[0, 2] + d[2, 0])
        - 2.0 * x * (d[1, 1] + d[2, 2])
    )
    d_y = 2.0 * (
        w * (d[0, 2] - d[2, 0])
        + x * (d[0, 1] + d[1, 0])
        + z * (d[1, 2] + d[2, 1])
        - 2.0 * y * (d[0, 0] + d[2, 2])
    )
    d_z = 2.0 * (
        w * (d[1, 0] - d[0, 1])
        + x * (d[0, 2] + d[2, 0])
        + y * (d[1, 2] + d[2, 1])
        - 2.0 * z * (d[0, 0] + d[1, 1])
    )
    along = d_w * w + d_x * x + d_y * y + d_z * z
    row[3] = (d_w - along * w) / length
    row[4] = (d_x - along * x) / length
    row[5] = (d_y - along * y) / length
    row[6] = (d_z - along * z) / length
