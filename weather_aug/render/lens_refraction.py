"""Drops on the glass drawn as small lenses. Compiled.

A drop is a union of discs with a signed distance. Inside, the slope of its surface grows from 0 in
the middle to the contact angle at the rim, as a spherical cap's does, and a ray is bent against the
slope: the scene is seen small and upside down, the sky below, the road above.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]

DISCS = 3
"""Discs that may have merged with a drop's main one."""
MERGE = 0.7
"""Over what share of the main disc's radius discs flow together; each bulges by a quarter of it."""
X, Y, RADIUS, STRETCH, SLANT, OPACITY, SOFT, REACH, BLUR, GAIN, SIZE = range(11)
COLUMNS = SIZE + 1 + 3 * DISCS
"""Of a drop, float32: place of its centre, radius, length over width, shift to the right per pixel
down, opacity in [0, 1], width of its soft edge, how far a ray at its rim is bent, radius of the
blur of what it shows, gain, reach of its outline from the centre; then (right, down, radius) of
each merged disc, radius 0 for none. All lengths in pixels."""


@compiled
def fill_pyramid(whole: Float32, levels: Int64, out: Float32) -> tuple[float, float, float]:
    """Ever smaller copies of a picture, one below the other, each smoothed before it is halved.

    Args:
        whole: (h, w, 3) float32.
        levels: (L, 3) int64: first row in `out`, height, width; halved from level to level.
        out: (sum of heights, w, 3) float32.

    Returns:
        Mean of the picture's three channels, float64.
    """
    red, green, blue = 0.0, 0.0, 0.0
    for y in range(whole.shape[0]):
        for x in range(whole.shape[1]):
            for k in range(3):
                out[y, x, k] = whole[y, x, k]
            red += whole[y, x, 0]
            green += whole[y, x, 1]
            blue += whole[y, x, 2]
    outer, inner = np.float32(0.125), np.float32(0.375)
    row = np.empty((whole.shape[1], 3), np.float32)
    for level in range(1, levels.shape[0]):
        source, rows, columns = levels[level - 1]
        target, height, width = levels[level]
        for y in range(height):
            a = source + max(2 * y - 1, 0)
            b = source + min(2 * y, rows - 1)
            c = source + min(2 * y + 1, rows - 1)
            d = source + min(2 * y + 2, rows - 1)
            for x in range(columns):
                for k in range(3):
                    row[x, k] = outer * (out[a, x, k] + out[d, x, k]) + inner * (
                        out[b, x, k] + out[c, x, k]
                    )
            for x in range(width):
                e, f = max(2 * x - 1, 0), min(2 * x, columns - 1)
                g, h = min(2 * x + 1, columns - 1), min(2 * x + 2, columns - 1)
                for k in range(3):
                    out[target + y, x, k] = outer * (row[e, k] + row[h, k]) + inner * (
                        row[f, k] + row[g, k]
                    )
    pixels = whole.shape[0] * whole.shape[1]
    return red / pixels, green / pixels, blue / pixels


@inlined
def light_at(pyramid: Float32, first: Any, height: Any, width: Any, u: Any, v: Any) -> Any:
    """Light at a place of a level, in its pixels; bilinear, the edge goes on outside."""
    zero = np.float32(0.0)
    u = min(max(u, zero), np.float32(width - 1))
    v = min(max(v, zero), np.float32(height - 1))
    i, j = np.int64(u), np.int64(v)
    fu, fv = u - np.float32(i), v - np.float32(j)
    right, below = min(i + 1, width - 1), first + min(j + 1, height - 1)
    j += first
    top_r = pyramid[j, i, 0] + fu * (pyramid[j, right, 0] - pyramid[j, i, 0])
    top_g = pyramid[j, i, 1] + fu * (pyramid[j, right, 1] - pyramid[j, i, 1])
    top_b = pyramid[j, i, 2] + fu * (pyramid[j, right, 2] - pyramid[j, i, 2])
    low_r = pyramid[below, i, 0] + fu * (pyramid[below, right, 0] - pyramid[below, i, 0])
    low_g = pyramid[below, i, 1] + fu * (pyramid[below, right, 1] - pyramid[below, i, 1])
    low_b = pyramid[below, i, 2] + fu * (pyramid[below, right, 2] - pyramid[below, i, 2])
    return top_r + fv * (low_r - top_r), top_g + fv * (low_g - top_g), top_b + fv * (low_b - top_b)


@inlined
def mixed(level: Any, light: Any, weight: Any, linear: Float32, srgb: UInt8) -> Any:
    """An sRGB level with a share of other linear light over it."""
    behind = linear[level]
    value = behind + weight * (light - behind)
    value = min(max(value, np.float32(0.0)), np.float32(1.0))
    return srgb[np.int64(value * np.float32(65535.0) + np.float32(0.5))]


@inlined
def smooth_step(t: Any) -> Any:
    """0 below 0, 1 above 1, smooth in between."""
    t = min(max(t, np.float32(0.0)), np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@compiled
def draw_drops(
    drops: Float32,
    pyramid: Float32,
    levels: Int64,
    scale: Float32,
    veil: Float32,
    window: Int64,
    linear: Float32,
    srgb: UInt8,
    least_blur_px: np.float32,
    image: UInt8,
    alpha: Float32,
    hidden: UInt8,
) -> None:
    """Draw drops over a window, in their order.

    Args:
        drops: (N, COLUMNS) float32; see `COLUMNS`.
        pyramid: See `fill_pyramid`.
        levels: (L, 3) int64, likewise.
        scale: (2,) float32, pixels of level 0 per pixel of the picture (across, down).
        veil: (3,) float32 light that the glass adds everywhere.
        window: (top, left) int64 of the window in the picture.
        linear: (256,) float32 linear light of each sRGB level.
        srgb: (65536,) uint8 sRGB level of linear light, 65535 for white.
        least_blur_px: Drops that blur no more hide nothing.
        image: (H, W, 3) uint8, drawn over.
        alpha: (H, W) float32 opacity, added to as layers are.
        hidden: (H, W) uint8, set to 1 where `alpha` exceeds 0.5 in a drop that blurs.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    rim, caustic = np.float32(0.15), np.float32(0.10)
    rows, columns = alpha.shape
    for n in range(drops.shape[0]):
        drop = drops[n]
        cx, cy, radius, stretch, slant = drop[X], drop[Y], drop[RADIUS], drop[STRETCH], drop[SLANT]
        opacity, reach, gain = drop[OPACITY], drop[REACH], drop[GAIN]
        blurs = drop[BLUR] > least_blur_px
        across, down, level = scale[0], scale[1], 0
        # A smoothed level, read bilinearly, blurs as a disc of 1.3 of its pixels does.
        while level + 1 < levels.shape[0] and drop[BLUR] * across > np.float32(1.8):
            across, down, level = half * across, half * down, level + 1
        first, height, width = levels[level]
        per_soft, per_radius = one / drop[SOFT], one / radius
        merge = np.float32(MERGE) * radius
        per_merge = one / merge
        tall = drop[SIZE] * stretch
        y0 = max(np.int64(np.floor(cy - tall)), window[0])
        y1 = min(np.int64(np.ceil(cy + tall)), window[0] + rows - 1)
        for y in range(y0, y1 + 1):
            fall = np.float32(y) - cy
            middle = cx + slant * fall
            qy = fall / stretch
            x0 = max(np.int64(np.floor(middle - drop[SIZE])), window[1])
            x1 = min(np.int64(np.ceil(middle + drop[SIZE])), window[1] + columns - 1)
            for x in range(x0, x1 + 1):
                qx = np.float32(x) - middle
                away = np.sqrt(qx * qx + qy * qy) + np.float32(1e-6)
                distance, nx, ny = away - radius, qx / away, qy / away
                for k in range(SIZE + 1, COLUMNS, 3):
                    size = drop[k + 2]
                    if size == zero:
                        break
                    px, py = qx - drop[k], qy - drop[k + 1]
                    away = np.sqrt(px * px + py * py) + np.float32(1e-6)
                    other = away - size
                    # The smooth minimum of two distances, and the normal that goes with it.
                    share = max(merge - abs(distance - other), zero) * per_merge
                    weight = half * share
                    if other < distance:
                        weight = one - weight
                    nx += weight * (px / away - nx)
                    ny += weight * (py / away - ny)
                    distance = min(distance, other) - np.float32(0.25) * share * share * merge
                cover = opacity * smooth_step(half - distance * per_soft)
                if cover <= zero:
                    continue
                slope = one - min(max(-distance * per_radius, zero), one)
                bend = reach * slope
                u = (np.float32(x) - nx * bend + half) * across - half
                v = (np.float32(y) - ny * bend + half) * down - half
                red, green, blue = light_at(pyramid, first, height, width, u, v)
                glow = max(ny, zero) * slope
                shine = gain * (one - rim * slope * slope * slope) * (one + caustic * glow * glow)
                i, j = y - window[0], x - window[1]
                image[i, j, 0] = mixed(image[i, j, 0], shine * red + veil[0], cover, linear, srgb)
                image[i, j, 1] = mixed(image[i, j, 1], shine * green + veil[1], cover, linear, srgb)
                image[i, j, 2] = mixed(image[i, j, 2], shine * blue + veil[2], cover, linear, srgb)
                total = alpha[i, j] + cover * (one - alpha[i, j])
                alpha[i, j] = total
                if blurs and total > half:
                    hidden[i, j] = 1
