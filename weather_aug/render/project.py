"""Particles in camera axes become Gaussians on the picture, ordered for drawing. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import survival
from weather_aug.particles.field import COVARIANCE, OPACITY, VELOCITY
from weather_aug.render.medium import carried_at, near_optical_depth

BAND_ROWS = 8
"""Rows that are shaded, splatted and encoded together, while they are in the cache."""
DEPTH_KEYS = 4096
MOST_PARTS = 16
"""A sweep is cut into no more parts than this."""
FAINTEST = 1.0 / 255.0
"""Opacity at which a particle's footprint is cut."""
MOST_OPAQUE = 0.99
PIXEL_FILTER_PX2 = 0.3
FOCUS_M = 6.0
DEFOCUS_VARIANCE = 1.0 / 16.0
"""Of a disc of diameter one."""
WHOLE_SPREAD = 1.0 / 12.0
"""Variance of a uniform sweep of length one."""
PART_SPREAD = 0.2
"""Of a part, which overlaps its neighbours: as wide as 1/12 says, their sum would ripple by a
third."""
LONG_SWEEP_PX = 12.0
WIDE_STREAK_PX = 1.0
SWEEP_PER_PART = 3.0
"""Sweep of a part in standard deviations of the footprint."""
LARGE_SHARE = 1e-3
"""A footprint of more than this share of the picture can hide a surface."""
HIDING_ALPHA = 0.5
"""Where a large footprint is more opaque than this it hides the surface."""

U, V, CONIC, REACH2, PEAK, DEPTH = 0, 1, 2, 5, 6, 7
LIGHT, LARGE, HALF_HEIGHT, HALF_WIDTH, LEAN = 8, 11, 12, 13, 14
"""Where the numbers of a splat begin; see `project`. The conic has three, the light as well."""

# Where the 16 lanes of each number of a footprint begin, as `_shape` writes them. The first seven
# are a splat's, in its order. A part is _STEP away from the next one, all of them together reach
# _SPAN from their middle.
_U, _V, _A, _B, _C, _REACH2, _PEAK, _THROUGH, _LARGE = range(0, 16 * 9, 16)
_HALF_HEIGHT, _HALF_WIDTH, _LEAN, _STEP_U, _STEP_V = range(16 * 9, 16 * 14, 16)
_PARTS, _SPAN_U, _SPAN_V = range(16 * 14, 16 * 17, 16)
_FOOTPRINT = 16 * 17
# What drawn particles carry has the place of the transmittance until that is known.
_CARRIED = _THROUGH


@compiled
def project(blocks, kinds, colours, optics, medium, resolved_depth, airlight, window, compensate):
    """Turn particles into screen-space Gaussians, keeping those that touch the window.

    The covariance is that of the particle, projected, plus q q^T / 12 for a uniform sweep q, plus
    c^2 / 16 for defocus of diameter c, plus 0.3 px^2 for the pixel filter. The peak falls by the
    square root of the ratio of determinants, so that the opacity integrated over the picture is
    the silhouette's, whatever the resolution or exposure. A sweep much longer than the footprint is
    wide is drawn in parts, because one Gaussian is no flat streak.

    Args:
        blocks: (B, 13, 16) float32 particles, as `sorted_in_blocks` returns them.
        kinds: (B, 16) uint8, the kind of each, 255 where a block is not full.
        colours: (K, 3) float32 of each kind.
        optics: Camera.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        airlight: (3,) float32.
        window: (top, left, height, width).
        compensate: Whether the peak falls with the blur; False for the classic 3D Gaussian splat,
            which only grows.

    Returns:
        (M, 16) float32 splats: u, v, conic a b c, reach^2, peak, depth, rgb, covers, half height,
        half width of a row, lean of the middles of the rows, 0.
    """
    capacity = blocks.shape[0] * 18 + 64
    splats = np.empty((capacity, 16), np.float32)
    shape = np.empty(_FOOTPRINT, np.float32)
    count = 0
    for i in range(blocks.shape[0]):
        block = blocks[i].reshape(13 * 16)
        _shape(block, optics, medium, resolved_depth, compensate, shape)
        for lane in range(16):
            if kinds[i, lane] == 255 or not _touches(shape, lane, window):
                continue
            parts = np.int64(shape[_PARTS + lane])
            if count + parts > capacity:
                capacity += capacity // 2
                splats = _grown(splats, count, capacity)
            count = _emit(shape, lane, parts, block[2 * 16 + lane], splats, count)
            _paint(shape, lane, parts, colours[kinds[i, lane]], airlight, splats, count)
    return splats[:count]


@compiled
def _shape(p, optics, medium, resolved_depth, compensate, out):
    """Footprints of 16 particles, all at once: without branches, so that they go in one vector.

    In `p` as in `out` a number of all 16 comes before the next one.
    """
    velocity, covariance, opacity = 16 * VELOCITY, 16 * COVARIANCE, 16 * OPACITY
    one, two = np.float32(1.0), np.float32(2.0)
    t = optics.exposure_s
    large_area = np.float32(LARGE_SHARE / np.pi) * optics.area_px
    # Looked up beforehand: a look-up in the long loop would keep it from being one vector.
    for k in range(16):
        out[_CARRIED + k] = carried_at(p[32 + k], resolved_depth, medium)
    for k in range(16):
        x, y, z = p[k], p[16 + k], p[32 + k]
        inverse = one / z
        tx, ty = x * inverse, y * inverse
        sx, sy = optics.fx * inverse, optics.fy * inverse
        ux = t * (p[velocity + k] - (optics.turn_y * z - optics.turn_z * y))
        uy = t * (p[velocity + 16 + k] - (optics.turn_z * x - optics.turn_x * z))
        uz = t * (p[velocity + 32 + k] - (optics.turn_x * y - optics.turn_y * x))
        jx = tx if tx < optics.limit_x else optics.limit_x
        jy = ty if ty < optics.limit_y else optics.limit_y
        jx = jx if jx > -optics.limit_x else -optics.limit_x
        jy = jy if jy > -optics.limit_y else -optics.limit_y
        qx, qy = sx * (ux - jx * uz), sy * (uy - jy * uz)
        # J Sigma J^T, with J = diag(sx, sy) [[1, 0, -x], [0, 1, -y]].
        i = covariance + k
        xx, xy, xz, yy, yz, zz = p[i], p[i + 16], p[i + 32], p[i + 48], p[i + 64], p[i + 80]
        a0 = sx * sx * (xx - jx * (two * xz - jx * zz))
        b0 = sx * sy * (xy - jy * xz - jx * (yz - jy * zz))
        c0 = sy * sy * (yy - jy * (two * yz - jy * zz))
        sharp = a0 * c0 - b0 * b0
        sharp = sharp if sharp > np.float32(1e-20) else np.float32(1e-20)
        blur = optics.aperture_m * optics.fx * (inverse - np.float32(1.0 / FOCUS_M))
        soft = np.float32(PIXEL_FILTER_PX2) + blur * blur * np.float32(DEFOCUS_VARIANCE)
        parts = _parts(qx * qx + qy * qy, np.float32(0.5) * (a0 + c0) + soft)
        spread = np.float32(WHOLE_SPREAD) if parts == one else np.float32(PART_SPREAD)
        share = one / parts
        qx, qy = qx * share, qy * share
        a, c = a0 + soft + spread * qx * qx, c0 + soft + spread * qy * qy
        b = b0 + spread * qx * qy
        # Term by term, because a c - b b cancels to nothing for a sweep of many pixels.
        swept = (a0 + soft) * qy * qy + (c0 + soft) * qx * qx - two * b0 * qx * qy
        swept = swept if swept > np.float32(0.0) else np.float32(0.0)
        det = sharp + soft * (a0 + c0 + soft) + spread * swept
        shrunk = np.sqrt(sharp / det) * share if compensate else one
        # What the cut of the footprint takes away, so that the sum over the pixels is right.
        given_back = np.float32(FAINTEST) if compensate else np.float32(0.0)
        peak = p[opacity + k] * shrunk + given_back
        peak = peak if peak < np.float32(MOST_OPAQUE) else np.float32(MOST_OPAQUE)
        reach2 = two * log(peak * np.float32(1.0 / FAINTEST))
        drawn = reach2 if reach2 > np.float32(0.0) else np.float32(0.0)
        aside = np.float32(0.5) * (parts - one)
        half_v = np.sqrt(drawn * c)
        # The area within which it hides what is behind it.
        hiding2 = two * log(peak * np.float32(1.0 / HIDING_ALPHA))
        over = (hiding2 * np.sqrt(det) * parts > large_area) & (peak > np.float32(HIDING_ALPHA))
        tau = near_optical_depth(z, tx, ty, optics, medium, out[_CARRIED + k])
        out[_U + k] = optics.cx + optics.fx * tx
        out[_V + k] = optics.cy + optics.fy * ty
        out[_A + k], out[_B + k], out[_C + k] = c / det, -b / det, a / det
        out[_REACH2 + k], out[_PEAK + k] = reach2, peak
        out[_THROUGH + k] = survival(tau)
        out[_LARGE + k] = one if over else np.float32(0.0)
        # A hundredth of a pixel more, so that rounding cuts no pixel off.
        out[_HALF_HEIGHT + k] = half_v + np.float32(0.01)
        out[_HALF_WIDTH + k] = np.sqrt(drawn * det / c) + np.float32(0.01)
        out[_LEAN + k] = b / c
        out[_STEP_U + k], out[_STEP_V + k] = qx, qy
        out[_PARTS + k] = parts
        out[_SPAN_U + k] = np.sqrt(drawn * a) + aside * abs(qx)
        out[_SPAN_V + k] = half_v + aside * abs(qy)


@inlined
def _touches(shape, lane, window):
    """Whether any part of a footprint is seen in the window."""
    top, left, height, width = window
    u, v = shape[_U + lane], shape[_V + lane]
    span_u, span_v = shape[_SPAN_U + lane], shape[_SPAN_V + lane]
    across = (u + span_u >= left) & (u - span_u <= left + width - 1)
    down = (v + span_v >= top) & (v - span_v <= top + height - 1)
    return across & down & (shape[_REACH2 + lane] > np.float32(0.0))


@inlined
def _emit(shape, lane, parts, z, splats, count):
    """Write the parts of one footprint, all but their colour; returns the new count."""
    aside = np.float32(0.5) * np.float32(parts - 1)
    for part in range(parts):
        row = splats[count]
        step = np.float32(part) - aside
        row[U] = shape[_U + lane] + step * shape[_STEP_U + lane]
        row[V] = shape[_V + lane] + step * shape[_STEP_V + lane]
        for field in range(CONIC, DEPTH):
            row[field] = shape[16 * field + lane]
        row[DEPTH] = z
        row[LARGE], row[HALF_HEIGHT] = shape[_LARGE + lane], shape[_HALF_HEIGHT + lane]
        row[HALF_WIDTH], row[LEAN] = shape[_HALF_WIDTH + lane], shape[_LEAN + lane]
        row[15] = np.float32(0.0)
        count += 1
    return count


@inlined
def _paint(shape, lane, parts, colour, airlight, splats, count):
    """Colour the last `parts` splats: a particle is seen through the air in front of it."""
    through = shape[_THROUGH + lane]
    for n in range(count - parts, count):
        for channel in range(3):
            veil = airlight[channel]
            splats[n, LIGHT + channel] = veil + through * (colour[channel] - veil)


@inlined
def _parts(sweep2, variance):
    """Into how many parts a sweep is cut, from its squared length and the mean variance."""
    step2 = np.float32(SWEEP_PER_PART * SWEEP_PER_PART)
    long2 = np.float32(LONG_SWEEP_PX * LONG_SWEEP_PX)
    wide2 = np.float32(WIDE_STREAK_PX * WIDE_STREAK_PX)
    wanted = np.ceil(np.sqrt(sweep2 / (step2 * variance)))
    wanted = wanted if wanted < np.float32(MOST_PARTS) else np.float32(MOST_PARTS)
    return wanted if (sweep2 > long2) & (variance > wide2) else np.float32(1.0)


@compiled
def _grown(splats, count, capacity):
    wider = np.empty((capacity, 16), np.float32)
    wider[:count] = splats[:count]
    return wider


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
def sorted_in_blocks(particles, ends):
    """Particles far to near, in blocks of 16 that a vector can take at once.

    A counting sort by inverse depth, from 0 (far) to 2 (the near limit of 0.5 m), so that equal
    depths keep the field's own order in any window.

    Args:
        particles: (N, 13) float32.
        ends: (K,) where the particles of each kind end.

    Returns:
        (B, 13, 16) float32 and the kinds (B, 16) uint8; the last block is filled up with copies of
        the nearest particle whose kind is 255.
    """
    order = _far_to_near(particles)
    n = particles.shape[0]
    count = (n + 15) // 16
    blocks = np.empty((count, 13, 16), np.float32)
    kinds = np.full((count, 16), 255, np.uint8)
    for k in range(16 * count):
        i = order[min(k, n - 1)]
        block, lane = k >> 4, k & 15
        for field in range(13):
            blocks[block, field, lane] = particles[i, field]
        if k < n:
            kind = 0
            while i >= ends[kind]:
                kind += 1
            kinds[block, lane] = kind
    return blocks, kinds


@compiled
def split_by_band(splats, window, bands):
    """Splats band by band, in their order inside each, and where each band starts.

    A splat that touches several bands comes in each of them: copied, so that a band reads memory
    in the order in which it lies.

    Returns:
        (M, 16) float32 and (bands + 1,) int64.
    """
    n = splats.shape[0]
    first, last = np.empty(n, np.int32), np.empty(n, np.int32)
    starts = np.zeros(bands + 1, np.int64)
    top, _, height, _ = window
    bottom = np.float32(height - 1)
    for i in range(n):
        v, half = splats[i, V] - np.float32(top), splats[i, HALF_HEIGHT]
        low, high = np.floor(v - half), np.ceil(v + half)
        first[i] = np.int32(min(max(low, np.float32(0.0)), bottom)) // np.int32(BAND_ROWS)
        last[i] = np.int32(max(min(high, bottom), np.float32(0.0))) // np.int32(BAND_ROWS)
        for band in range(first[i], last[i] + 1):
            starts[band + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    out = np.empty((starts[bands], 16), np.float32)
    fill = starts[:-1].copy()
    for i in range(n):
        for band in range(first[i], last[i] + 1):
            for k in range(16):
                out[fill[band], k] = splats[i, k]
            fill[band] += 1
    return out, starts


@compiled
def _far_to_near(particles):
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
