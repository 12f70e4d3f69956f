"""Blend splats front to back, tile by tile, and find gradients the same way. Compiled.

Each tile is one flat buffer of 64 pixels, so that the loops over its pixels become vector code. A
splat's alpha at a pixel is opacity · exp(-σ), at the most 0.99; below 1/255 it is nothing. A pixel
is done when the next splat would leave 1e-4 of the light or less; that splat is not drawn.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined, reassociated
from weather_aug.gaussians.projection import LEAST_ALPHA
from weather_aug.gaussians.tiles import TILE_PX

MAX_ALPHA = 0.99
LEAST_LIGHT = 1e-4
PIXELS = TILE_PX * TILE_PX
CHECKED_EVERY = 8
"""Splats after which a tile looks whether all its pixels are done."""

# Rows of a tile's buffer. A pixel that is done keeps what light is left as a negative number.
_X, _Y, _LIGHT, _WEIGHT, _VALUE, _REST, _FREE = range(7)
_CUT = np.float32(LEAST_ALPHA)
_CAP = np.float32(MAX_ALPHA)
_STOP = np.float32(LEAST_LIGHT)


@inlined
def _falloff(sigma):
    """exp(-σ) to 2e-6 for σ in 0..6; less than 1/255 for all beyond, which nobody sees.

    A polynomial for a sixteenth of σ, of least largest relative error.
    """
    x = min(sigma, np.float32(6.0)) * np.float32(0.0625)
    p = np.float32(-0.16433597) + x * np.float32(0.0344822)
    p = np.float32(0.49968342) + x * p
    p = np.float32(-0.99998464) + x * p
    p = np.float32(1.0) + x * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@inlined
def _weights(part, left, top, b):
    """What a splat adds at each pixel of a tile, and what light it leaves there.

    One loop for all of it: in two, the pixels' values go through memory and cost twice the time.
    """
    u, v = part[0] - np.float32(left), part[1] - np.float32(top)
    half_a, cross, half_c = np.float32(0.5) * part[2], part[3], np.float32(0.5) * part[4]
    opacity = part[5]
    zero = np.float32(0.0)
    for p in range(PIXELS):
        x, y = b[_X, p] - u, b[_Y, p] - v
        alpha = opacity * _falloff((half_a * x + cross * y) * x + half_c * y * y)
        alpha = alpha if alpha >= _CUT else zero
        light = b[_LIGHT, p]
        weight = min(alpha, _CAP) * max(light, zero)
        after = light - weight
        goes_on = after > _STOP
        b[_WEIGHT, p] = weight if goes_on else zero
        b[_LIGHT, p] = after if goes_on else -abs(light)


@inlined
def _start(b):
    for p in range(PIXELS):
        b[_X, p] = np.float32(p % TILE_PX)
        b[_Y, p] = np.float32(p // TILE_PX)
        b[_LIGHT, p] = np.float32(1.0)


@inlined
def _is_done(b):
    light = np.float32(-1.0)
    for p in range(PIXELS):
        light = max(light, b[_LIGHT, p])
    return light <= np.float32(0.0)


@compiled
def blend(parts, planes, starts, ranks, tiles, left, blended, ends):
    """Blend the tiles from tiles[0] to before tiles[1].

    Args:
        parts: (V, 6) float32 in drawing order.
        planes: (V, C) float32, what is blended.
        starts: Lists of `tiles_of`.
        ranks: Lists of `tiles_of`.
        tiles: First and one after the last.
        left: (H, W) written: the share of light that passes all splats.
        blended: (H, W, C) written: Σ w · plane.
        ends: (tiles,) written: one after the last list entry that was looked at.
    """
    height, width = left.shape
    channels = planes.shape[1]
    columns = (width + TILE_PX - 1) // TILE_PX
    b = np.empty((_FREE, PIXELS), np.float32)
    sums = np.empty((channels, PIXELS), np.float32)
    for tile in range(tiles[0], tiles[1]):
        x0, y0 = (tile % columns) * TILE_PX, (tile // columns) * TILE_PX
        _start(b)
        sums[:] = np.float32(0.0)
        end = starts[tile + 1]
        for entry in range(starts[tile], starts[tile + 1]):
            rank = ranks[entry]
            _weights(parts[rank], x0, y0, b)
            for c in range(channels):
                value = planes[rank, c]
                for p in range(PIXELS):
                    sums[c, p] += b[_WEIGHT, p] * value
            if (entry - starts[tile]) % CHECKED_EVERY == CHECKED_EVERY - 1 and _is_done(b):
                end = entry + 1
                break
        ends[tile] = end
        for y in range(y0, min(y0 + TILE_PX, height)):
            for x in range(x0, min(x0 + TILE_PX, width)):
                p = (y - y0) * TILE_PX + x - x0
                left[y, x] = abs(b[_LIGHT, p])
                for c in range(channels):
                    blended[y, x, c] = sums[c, p]


@reassociated
def blend_back(
    parts,
    planes,
    starts,
    ranks,
    tiles,
    ends,
    left,
    blended,
    d_left,
    d_blended,
    has_shape,
    by_entry,
    d_rows,
):
    """Gradients of the tiles from tiles[0] to before tiles[1], added to `d_rows`.

    Front to back as `blend`: what lies behind a splat is what the whole pixel has, less what lies
    before it; nothing is divided by a light that may be near zero.

    Args:
        parts: As in `blend`, and all up to `tiles`.
        planes: As in `blend`.
        starts: As in `blend`.
        ranks: As in `blend`.
        tiles: As in `blend`.
        ends: What `blend` wrote, and so on.
        left: (H, W).
        blended: (H, W, C).
        d_left: (H, W), gradient of the loss.
        d_blended: (H, W, C).
        has_shape: Whether gradients of `parts` are wanted, too.
        by_entry: Whether `d_rows` has a row for each list entry, else for each splat.
        d_rows: (…, 6 + C) float32: of the parts, then of the planes.
    """
    height, width = left.shape
    channels = planes.shape[1]
    columns = (width + TILE_PX - 1) // TILE_PX
    b = np.empty((_FREE, PIXELS), np.float32)
    d = np.empty((channels, PIXELS), np.float32)
    zero = np.float32(0.0)
    for tile in range(tiles[0], tiles[1]):
        x0, y0 = (tile % columns) * TILE_PX, (tile // columns) * TILE_PX
        _start(b)
        for p in range(PIXELS):
            y, x = y0 + p // TILE_PX, x0 + p % TILE_PX
            inside = y < height and x < width
            rest = d_left[y, x] * left[y, x] if inside else zero
            for c in range(channels):
                d[c, p] = d_blended[y, x, c] if inside else zero
                rest += d[c, p] * blended[y, x, c] if inside else zero
            b[_REST, p] = rest
        for entry in range(starts[tile], ends[tile]):
            rank = ranks[entry]
            row = d_rows[entry if by_entry else rank]
            if has_shape:
                for p in range(PIXELS):
                    b[_VALUE, p] = zero
                for c in range(channels):
                    value = planes[rank, c]
                    for p in range(PIXELS):
                        b[_VALUE, p] += d[c, p] * value
                _shape_back(parts[rank], x0, y0, b, row)
            else:
                _weights(parts[rank], x0, y0, b)
            for c in range(channels):
                total = zero
                for p in range(PIXELS):
                    total += b[_WEIGHT, p] * d[c, p]
                row[6 + c] += total


@inlined
def _shape_back(part, left, top, b, row):
    """Gradients of centre, conic and opacity; weights, light and rest go on by one splat."""
    u, v = part[0] - np.float32(left), part[1] - np.float32(top)
    half_a, cross, half_c = np.float32(0.5) * part[2], part[3], np.float32(0.5) * part[4]
    opacity = part[5]
    zero, one = np.float32(0.0), np.float32(1.0)
    s, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
    for p in range(PIXELS):
        x, y = b[_X, p] - u, b[_Y, p] - v
        raw = opacity * _falloff((half_a * x + cross * y) * x + half_c * y * y)
        raw = raw if raw >= _CUT else zero
        alpha = min(raw, _CAP)
        light = b[_LIGHT, p]
        live = max(light, zero)
        weight = alpha * live
        after = light - weight
        goes_on = after > _STOP
        weight = weight if goes_on else zero
        rest = b[_REST, p] - weight * b[_VALUE, p]
        d_sigma = raw * (rest / (one - alpha) - live * b[_VALUE, p])
        # Where the cap holds, or nothing is drawn, alpha does not change with the splat.
        d_sigma = d_sigma if weight > zero else zero
        d_sigma = d_sigma if raw < _CAP else zero
        b[_WEIGHT, p] = weight
        b[_LIGHT, p] = after if goes_on else -abs(light)
        b[_REST, p] = rest
        s += d_sigma
        sx += d_sigma * x
        sy += d_sigma * y
        sxx += d_sigma * x * x
        sxy += d_sigma * x * y
        syy += d_sigma * y * y
    row[0] -= part[2] * sx + part[3] * sy
    row[1] -= part[3] * sx + part[4] * sy
    row[2] += np.float32(0.5) * sxx
    row[3] += sxy
    row[4] += np.float32(0.5) * syy
    row[5] -= s / part[5]


@compiled
def add_entries(ranks, by_entry, starts, ends, d_rows):
    """Add the rows of list entries to their splats' rows, in the order of the tiles."""
    for tile in range(ends.shape[0]):
        for entry in range(starts[tile], ends[tile]):
            for k in range(d_rows.shape[1]):
                d_rows[ranks[entry], k] += by_entry[entry, k]


@compiled
def gather(order, parts, planes, parts_out, planes_out):
    """Rows in drawing order."""
    for i in range(order.shape[0]):
        n = order[i]
        for k in range(parts.shape[1]):
            parts_out[i, k] = parts[n, k]
        for c in range(planes.shape[1]):
            planes_out[i, c] = planes[n, c]


@compiled
def scatter(order, rows, parts_out, planes_out):
    """Rows of (parts, planes) from drawing order back to where they came from."""
    shape = parts_out.shape[1]
    for i in range(order.shape[0]):
        n = order[i]
        for k in range(shape):
            parts_out[n, k] = rows[i, k]
        for c in range(planes_out.shape[1]):
            planes_out[n, c] = rows[i, shape + c]
