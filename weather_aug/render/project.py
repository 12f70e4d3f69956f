"""Particles in camera axes become Gaussians on the picture, ordered for drawing. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.render.medium import path_optical_depth, survival

BAND_ROWS = 16
"""Rows that are shaded, splatted and encoded together, while they are in the cache."""
DEPTH_KEYS = 4096
MOST_PARTS = 16
"""A sweep is cut into no more parts than this."""
FAINTEST = 1.0 / 255.0
"""Opacity at which a particle's footprint is cut."""


@compiled
def project(
    particles, order, kinds, colours, optics, medium, resolved_depth, airlight, window, compensate,
    splats,
):
    """Turn particles into screen-space Gaussians, keeping those that touch the window.

    The covariance is that of the particle, projected, plus q q^T / 12 for a uniform sweep q, plus
    c^2 / 16 for defocus of diameter c, plus 0.3 px^2 for the pixel filter. The peak falls by the
    square root of the ratio of determinants, so that the opacity integrated over the picture is
    the silhouette's, whatever the resolution or exposure. A sweep much longer than the footprint is
    wide is drawn in parts, because one Gaussian is no flat streak.

    Args:
        particles: (N, 13) float32 as `ParticleField.particles` returns them, far to near.
        order: (N,) index that each particle had before it was sorted.
        kinds: (K,) where the particles of each kind ended then.
        colours: (K, 3) float32 of each kind.
        optics: Camera.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        airlight: (3,) float32.
        window: (top, left, height, width).
        compensate: Whether the peak falls with the blur; False for the classic 3D Gaussian splat,
            which only grows.
        splats: (M, 16) float32 out: u, v, conic a b c, reach^2, peak, depth, rgb, covers, half
            height, half width of a row, lean of the middles of the rows, 0.

    Returns:
        Number of splats; those beyond M are counted, not written.
    """
    count = 0
    one = np.float32(1.0)
    top, left, height, width = window
    capacity = splats.shape[0]
    large_area = np.float32(1e-3) * optics.area_px
    for n in range(particles.shape[0]):
        p = particles[n]
        x, y, z = p[0], p[1], p[2]
        inverse = one / z
        tx, ty = x * inverse, y * inverse
        sx, sy = optics.fx * inverse, optics.fy * inverse
        t = optics.exposure_s
        ux = t * (p[3] - (optics.turn_y * z - optics.turn_z * y))
        uy = t * (p[4] - (optics.turn_z * x - optics.turn_x * z))
        uz = t * (p[5] - (optics.turn_x * y - optics.turn_y * x))
        qx, qy = sx * (ux - tx * uz), sy * (uy - ty * uz)
        # J Sigma J^T, with J = diag(sx, sy) [[1, 0, -tx], [0, 1, -ty]].
        xz, yz = p[8] - tx * p[11], p[10] - ty * p[11]
        a0 = sx * sx * (p[6] - tx * p[8] - tx * xz)
        b0 = sx * sy * (p[7] - ty * p[8] - tx * yz)
        c0 = sy * sy * (p[9] - ty * p[10] - ty * yz)
        det_sharp = max(a0 * c0 - b0 * b0, np.float32(1e-20))
        blur = optics.aperture_m * optics.fx * (inverse - np.float32(1.0 / 6.0))
        soft = np.float32(0.3) + blur * blur * np.float32(0.0625)
        parts = _parts(qx * qx + qy * qy, a0 + c0 + np.float32(2.0) * soft)
        share = one / np.float32(parts)
        qx, qy = qx * share, qy * share
        # Parts overlap: as wide as 1/12 says, their sum would ripple by a third.
        spread = np.float32(1.0 / 12.0) if parts == 1 else np.float32(0.2)
        a, b, c, det = _blurred(a0, b0, c0, det_sharp, soft, qx, qy, spread)
        peak = p[12]
        if compensate:
            peak = peak * np.sqrt(det_sharp / det) * share
        # What the cut of the footprint takes away, so that the sum over the pixels is right.
        peak = min(peak + np.float32(FAINTEST), np.float32(0.99))
        reach2 = np.float32(2.0) * log(peak * np.float32(1.0 / FAINTEST))
        if not reach2 > np.float32(0.0):
            continue
        u, v = optics.cx + optics.fx * tx, optics.cy + optics.fy * ty
        half_u, half_v = np.sqrt(reach2 * a), np.sqrt(reach2 * c)
        aside = np.float32(0.5) * np.float32(parts - 1)
        span_u, span_v = half_u + aside * abs(qx), half_v + aside * abs(qy)
        if u + span_u < left or u - span_u > left + width - 1:
            continue
        if v + span_v < top or v - span_v > top + height - 1:
            continue
        through = survival(path_optical_depth(z, tx, ty, optics, medium, resolved_depth))
        kind = 0
        while order[n] >= kinds[kind]:
            kind += 1
        covers = np.float32(np.pi) * reach2 * np.sqrt(det) * np.float32(parts) > large_area
        for k in range(parts):
            if count < capacity:
                row = splats[count]
                step = np.float32(k) - aside
                row[0], row[1] = u + step * qx, v + step * qy
                row[2], row[3], row[4] = c / det, -b / det, a / det
                row[5], row[6], row[7] = reach2, peak, z
                for channel in range(3):
                    veil = airlight[channel]
                    row[8 + channel] = veil + through * (colours[kind, channel] - veil)
                row[11] = one if covers else np.float32(0.0)
                # A hundredth of a pixel more, so that rounding cuts no pixel off.
                row[12] = half_v + np.float32(0.01)
                row[13] = np.sqrt(reach2 * det / c) + np.float32(0.01)
                row[14] = b / c
                row[15] = np.float32(0.0)
            count += 1
    return count


@inlined
def _parts(sweep2, spread2):
    """Into how many parts a sweep is cut, from its squared length and twice the mean variance."""
    variance = np.float32(0.5) * spread2
    if sweep2 <= np.float32(144.0) or variance <= np.float32(1.0):
        return 1
    return min(np.int64(np.ceil(np.sqrt(sweep2 / (np.float32(9.0) * variance)))), MOST_PARTS)


@inlined
def _blurred(a0, b0, c0, det_sharp, soft, qx, qy, spread):
    """Covariance (a, b, c) with filter and `spread` q q^T, and its determinant.

    The determinant term by term, because a c - b b cancels to nothing for a sweep of many pixels.
    """
    a, b = a0 + soft + qx * qx * spread, b0 + qx * qy * spread
    c = c0 + soft + qy * qy * spread
    swept = (a0 + soft) * qy * qy + (c0 + soft) * qx * qx - np.float32(2.0) * b0 * qx * qy
    det = det_sharp + soft * (a0 + c0 + soft) + spread * max(swept, np.float32(0.0))
    return a, b, c, det


@inlined
def log(x):
    """Natural logarithm to 1e-4 for x in [1/2, 255], in operations with equal bits everywhere.

    ln x = 8 ln m with m the eighth root, and ln m = 2 artanh((m - 1) / (m + 1)) as a series.
    """
    one = np.float32(1.0)
    m = np.sqrt(np.sqrt(np.sqrt(x)))
    s = (m - one) / (m + one)
    s2 = s * s
    series = np.float32(1.0 / 5.0) + s2 * np.float32(1.0 / 7.0)
    series = one + s2 * (np.float32(1.0 / 3.0) + s2 * series)
    return np.float32(16.0) * s * series


@compiled
def split_by_band(splats, window, bands):
    """Splats band by band, in their order inside each, and where each band starts.

    A splat that touches several bands comes in each of them: copied, so that a band reads memory
    in the order in which it lies.

    Returns:
        (M, 16) float32 and (bands + 1,) int64.
    """
    top, _, height, _ = window
    starts = np.zeros(bands + 1, np.int64)
    for i in range(splats.shape[0]):
        first, last = _bands_of(splats, i, top, height)
        for band in range(first, last + 1):
            starts[band + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    out = np.empty((starts[bands], splats.shape[1]), np.float32)
    fill = starts[:-1].copy()
    for i in range(splats.shape[0]):
        first, last = _bands_of(splats, i, top, height)
        for band in range(first, last + 1):
            for k in range(16):
                out[fill[band], k] = splats[i, k]
            fill[band] += 1
    return out, starts


@inlined
def _bands_of(splats, i, top, height):
    """First and last band that splat `i` touches."""
    v, half = splats[i, 1], splats[i, 12]
    low = min(max(np.int64(np.floor(v - half)) - top, 0), height - 1)
    high = max(min(np.int64(np.ceil(v + half)) - top, height - 1), low)
    return low // BAND_ROWS, high // BAND_ROWS


@compiled
def far_to_near(particles):
    """Indices (N,) int32 of particles (N, 13) from far to near.

    A counting sort by inverse depth, from 0 (far) to 2 (the near limit of 0.5 m), so that equal
    depths keep the field's own order in any window.
    """
    n = particles.shape[0]
    keys = np.empty(n, np.int32)
    starts = np.zeros(DEPTH_KEYS + 1, np.int64)
    for i in range(n):
        key = np.int32(min(np.float32(2047.0) / particles[i, 2], np.float32(DEPTH_KEYS - 1)))
        keys[i] = key
        starts[key + 1] += 1
    for k in range(DEPTH_KEYS):
        starts[k + 1] += starts[k]
    indices = np.empty(n, np.int32)
    for i in range(n):
        indices[starts[keys[i]]] = i
        starts[keys[i]] += 1
    return indices
