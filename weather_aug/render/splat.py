"""Draw one particle over some rows of a picture. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled


@compiled
def blend_splat(splat, rows, window, falloff, planes, covered):
    """Blend one splat over rows [rows[0], rows[1]) of the window; `planes` starts at rows[0]."""
    u, v = splat[0], splat[1]
    a, b, c, reach2, peak, z = splat[2], splat[3], splat[4], splat[5], splat[6], splat[7]
    red, green, blue = splat[8], splat[9], splat[10]
    large = splat[11] > np.float32(0.0)
    top, left, _, width = window
    scale = np.float32(falloff.shape[0] / 12.5)
    last_slot = np.int32(falloff.shape[0] - 1)
    near_edge, one = np.float32(0.1), np.float32(1.0)
    inverse_a = one / a
    half_v = splat[12]
    # What is left of the row's interval falls from all at the middle to nothing at half_v.
    fade = a * reach2 / (half_v * half_v)
    y0 = max(np.int64(np.ceil(v - half_v)) - top, rows[0])
    y1 = min(np.int64(np.floor(v + half_v)) - top, rows[1] - 1)
    for y in range(y0, y1 + 1):
        dy = np.float32(y + top) - v
        room = a * reach2 - fade * dy * dy
        if room <= np.float32(0.0):
            continue
        middle = u - b * dy * inverse_a
        half = np.sqrt(room) * inverse_a
        x0 = max(np.int64(np.ceil(middle - half)) - left, 0)
        x1 = min(np.int64(np.floor(middle + half)) - left, width - 1)
        row = planes[y - rows[0]]
        for x in range(x0, x1 + 1):
            ahead = row[4, x] - z
            if ahead <= -near_edge:
                continue
            dx = np.float32(x + left) - u
            power = (a * dx + np.float32(2.0) * b * dy) * dx + c * dy * dy
            alpha = peak * falloff[min(np.int32(power * scale), last_slot)]
            if ahead < near_edge:
                alpha *= np.float32(0.5) + np.float32(5.0) * ahead
            row[0, x] += alpha * (red - row[0, x])
            row[1, x] += alpha * (green - row[1, x])
            row[2, x] += alpha * (blue - row[2, x])
            row[3, x] *= one - alpha
            if large and alpha > np.float32(0.5):
                covered[y, x] = 1
