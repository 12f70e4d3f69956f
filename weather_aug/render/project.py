"""Particles in camera axes become Gaussians on the picture, ordered for drawing. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled
from weather_aug.render.medium import path_optical_depth, survival

BAND_ROWS = 16
"""Rows that are shaded, splatted and encoded together, while they are in the cache."""
DEPTH_KEYS = 4096
FAINTEST = 1.0 / 255.0
"""Opacity at which a particle's footprint is cut."""


@compiled
def project(particles, optics, medium, resolved_depth, colour, airlight, window, splats):
    """Turn particles into screen-space Gaussians, keeping those that touch the window.

    A disc of diameter D is a Gaussian of standard deviation D / (2 sqrt 2) and peak opacity 1
    (equal area). A uniform sweep q adds q q^T / 12, defocus of diameter c adds c^2 / 16, the pixel
    filter 0.3 px^2; the peak falls by the square root of the ratio of determinants, so that the
    opacity integrated over the picture is the silhouette's, whatever the resolution or exposure.

    Args:
        particles: (N, 7) float32, as `ParticleField.particles` returns them.
        optics: Camera.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        colour: (3,) float32 of a particle.
        airlight: (3,) float32.
        window: (top, left, height, width).
        splats: (N, 13) float32 out: u, v, conic a b c, reach^2, peak, depth, rgb, covers, half
            height.

    Returns:
        Number of splats.
    """
    count = 0
    one = np.float32(1.0)
    twelfth = np.float32(1.0 / 12.0)
    top, left, height, width = window
    large_area = np.float32(1e-3) * optics.area_px
    for i in range(particles.shape[0]):
        x, y, z = particles[i, 0], particles[i, 1], particles[i, 2]
        inverse = one / z
        tx, ty = x * inverse, y * inverse
        sx, sy = optics.fx * inverse, optics.fy * inverse
        t = optics.exposure_s
        ux = t * (particles[i, 3] - (optics.turn_y * z - optics.turn_z * y))
        uy = t * (particles[i, 4] - (optics.turn_z * x - optics.turn_x * z))
        uz = t * (particles[i, 5] - (optics.turn_x * y - optics.turn_y * x))
        qx, qy = sx * (ux - tx * uz), sy * (uy - ty * uz)
        s2 = np.float32(0.125) * particles[i, 6] * particles[i, 6]
        a0 = s2 * sx * sx * (one + tx * tx)
        b0 = s2 * sx * sy * tx * ty
        c0 = s2 * sy * sy * (one + ty * ty)
        blur = optics.aperture_m * (inverse - np.float32(1.0 / 6.0))
        soft_x = blur * optics.fx
        soft = np.float32(0.3) + soft_x * soft_x * np.float32(0.0625)
        a = a0 + qx * qx * twelfth + soft
        b = b0 + qx * qy * twelfth
        c = c0 + qy * qy * twelfth + soft
        # Term by term, because a c - b b cancels to nothing for a sweep of many pixels.
        det_sharp = s2 * s2 * sx * sx * sy * sy * (one + tx * tx + ty * ty)
        ac, cc = a0 + soft, c0 + soft
        swept = ac * qy * qy + cc * qx * qx - np.float32(2.0) * b0 * qx * qy
        det = det_sharp + soft * (a0 + c0 + soft) + twelfth * max(swept, np.float32(0.0))
        peak = np.sqrt(det_sharp / det) + np.float32(FAINTEST)
        peak = min(peak, np.float32(0.99))
        reach2 = np.float32(2.0) * np.float32(np.log(np.float64(peak / np.float32(FAINTEST))))
        if not reach2 > np.float32(0.0):
            continue
        u, v = optics.cx + optics.fx * tx, optics.cy + optics.fy * ty
        half_u, half_v = np.sqrt(reach2 * a), np.sqrt(reach2 * c)
        if u + half_u < left or u - half_u > left + width - 1:
            continue
        if v + half_v < top or v - half_v > top + height - 1:
            continue
        through = survival(path_optical_depth(z, tx, ty, optics, medium, resolved_depth))
        row = splats[count]
        row[0], row[1] = u, v
        row[2], row[3], row[4] = c / det, -b / det, a / det
        row[5], row[6], row[7] = reach2, peak, z
        row[12] = half_v
        for k in range(3):
            row[8 + k] = through * colour[k] + (one - through) * airlight[k]
        area = np.float32(np.pi) * reach2 * np.sqrt(det)
        row[11] = one if area > large_area else np.float32(0.0)
        count += 1
    return count


@compiled
def order_by_band(splats, window, bands):
    """Indices of splats band by band, far to near inside each, and where each band starts.

    Counting sorts only, so that equal depths keep the field's own order in any window.
    """
    n = splats.shape[0]
    keys = np.empty(n, np.int32)
    starts = np.zeros(DEPTH_KEYS + 1, np.int64)
    for i in range(n):
        # Inverse depth from 0 (far) to 2 (the near limit of 0.5 m).
        key = np.int32(min(np.float32(2047.0) / splats[i, 7], np.float32(DEPTH_KEYS - 1)))
        keys[i] = key
        starts[key + 1] += 1
    for k in range(DEPTH_KEYS):
        starts[k + 1] += starts[k]
    far_to_near = np.empty(n, np.int32)
    for i in range(n):
        far_to_near[starts[keys[i]]] = i
        starts[keys[i]] += 1

    top, _, height, _ = window
    band_starts = np.zeros(bands + 1, np.int64)
    first = np.empty(n, np.int32)
    last = np.empty(n, np.int32)
    for i in range(n):
        half = splats[i, 12]
        low = min(max(np.int64(np.floor(splats[i, 1] - half)) - top, 0), height - 1)
        high = max(min(np.int64(np.ceil(splats[i, 1] + half)) - top, height - 1), low)
        first[i], last[i] = low // BAND_ROWS, high // BAND_ROWS
        for band in range(first[i], last[i] + 1):
            band_starts[band + 1] += 1
    for band in range(bands):
        band_starts[band + 1] += band_starts[band]
    order = np.empty(band_starts[bands], np.int32)
    fill = band_starts[:-1].copy()
    for k in range(n):
        i = far_to_near[k]
        for band in range(first[i], last[i] + 1):
            order[fill[band]] = i
            fill[band] += 1
    return order, band_starts
