"""Fog and particles over a picture, band by band, in linear light. Compiled.

Serial and without fast-math, so that the same arguments give the same bits in every process.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled
from weather_aug._rows import encode_row, together_row
from weather_aug.edit.surface import depth_row, light_row, sky_row
from weather_aug.render.medium import air_row, rays_across, row_space
from weather_aug.render.project import BAND_ROWS, LARGE
from weather_aug.render.tile import TILE_FLOATS, blend_band, cover_splat


@compiled
def shade(
    surface,
    patches,
    window,
    optics,
    medium,
    resolved_depth,
    linear,
    encoded,
    airlight,
    splats,
    band_starts,
    limits,
    out,
    through,
    distinct,
    covered,
):
    """Render the window: fog and particles in linear light, band by band.

    Args:
        surface: The background.
        patches: FogVolume, of no slices where the fog is even.
        window: (top, left, height, width) in the whole picture.
        optics: Camera of the whole picture.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        linear: (256,) float32 light by sRGB level.
        encoded: Whether colours are blended as they are stored, in sRGB; `linear` is then so, too.
        airlight: (3,) float32.
        splats: (M, 16) float32, band by band.
        band_starts: (bands + 1,) where each band's splats start.
        limits: Linear difference from the airlight that can just be seen, and the transmittance
            below which a surface must differ from it to be seen.
        out: (H, W, 3) uint8 out.
        through: (H, W) float32 out: transmittance of air and particles.
        distinct: (H, W) uint8 out: 1 where what is left of a surface's difference from the
            airlight can be seen.
        covered: (H, W) uint8, zero: set where a large particle hides the surface; may be (0, 0)
            if no splat is large.

    Returns:
        Number of pixels whose surface is below the second limit.
    """
    top, left, height, width = window
    least_contrast, hazy = limits
    # Rows of whole vectors: the few pixels that would be left over cost as much as hundreds.
    wide = (width + 15) // 16 * 16
    ray_x, space = rays_across(wide, left, optics), row_space(wide, patches)
    # Red, green, blue, transmittance and depth of a band's rows side by side. The odd stride keeps
    # them apart in the cache: planes of equal page offset would evict each other at every pixel.
    stride = wide + 80
    planes = np.ones((BAND_ROWS, 5, stride), np.float32)
    bits = planes.view(np.int32)
    tiles = np.empty((BAND_ROWS // 4, stride // 4, TILE_FLOATS), np.float32)
    gap = np.empty((BAND_ROWS, wide), np.float32)
    sky = np.zeros((BAND_ROWS, wide), np.uint8)
    levels = np.empty((3, wide), np.uint8)
    hidden = 0
    for band in range(band_starts.shape[0] - 1):
        y0 = band * BAND_ROWS
        y1 = min(y0 + BAND_ROWS, height)
        for y in range(y0, y1):
            k = y - y0
            ray_y = (np.float32(y + top) - optics.cy) / optics.fy
            red, green, blue = planes[k, 0, :wide], planes[k, 1, :wide], planes[k, 2, :wide]
            clear, depth = planes[k, 3, :wide], planes[k, 4, :wide]
            depth_row(surface, y + top, left, bits[k, 4, :width], depth[:width])
            sky_row(surface, y + top, left, depth[:width], sky[k, :width])
            air_row(
                depth,
                width,
                y + top,
                left,
                ray_x,
                ray_y,
                patches,
                optics,
                medium,
                resolved_depth,
                space,
                clear,
            )
            light_row(surface, y + top, left, linear, red[:width], green[:width], blue[:width])
            _fog_row(clear, airlight, red, green, blue, gap[k])
        mine = splats[band_starts[band] : band_starts[band + 1]]
        blend_band(mine, window, y0, planes, tiles)
        for i in range(mine.shape[0]):
            if mine[i, LARGE] > np.float32(0.0):
                cover_splat(mine[i], (y0, y1), window, planes, covered)
        for y in range(y0, y1):
            k = y - y0
            for channel in range(3):
                if encoded:
                    _level_row(planes[k, channel, :wide], levels[channel])
                else:
                    encode_row(planes[k, channel, :wide], levels[channel])
            together_row(levels[0], levels[1], levels[2], out[y])
            _copy_row(planes[k, 3, :width], through[y])
            _distinct_row(gap[k], through[y], sky[k], least_contrast, distinct[y])
            hidden += _count_below(through[y], sky[k], hazy)
    return hidden


@compiled
def _fog_row(through, airlight, red, green, blue, gap):
    """Veil one row, and say how far (linear light) its surfaces are from the airlight."""
    a0, a1, a2 = airlight[0], airlight[1], airlight[2]
    for x in range(through.shape[0]):
        t = through[x]
        dr, dg, db = red[x] - a0, green[x] - a1, blue[x] - a2
        red[x], green[x], blue[x] = a0 + t * dr, a1 + t * dg, a2 + t * db
        dr, dg, db = abs(dr), abs(dg), abs(db)
        most = dr if dr > dg else dg
        gap[x] = most if most > db else db


@compiled
def _level_row(light, out):
    """Turn colours that are sRGB already into levels, rounded."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(light.shape[0]):
        v = light[x]
        v = v if v > zero else zero
        v = v if v < one else one
        out[x] = np.uint8(np.int32(v * np.float32(255.0) + np.float32(0.5)))


@compiled
def _copy_row(row, out):
    """Copy in a loop: an assignment of slices takes its time to compare shapes and overlaps."""
    for x in range(out.shape[0]):
        out[x] = row[x]


@compiled
def _distinct_row(gap, through, sky, least_contrast, out):
    for x in range(out.shape[0]):
        seen = (gap[x] * through[x] >= least_contrast) & (sky[x] == np.uint8(0))
        out[x] = np.uint8(1) if seen else np.uint8(0)


@compiled
def _count_below(through, sky, limit):
    count = np.int32(0)
    for x in range(through.shape[0]):
        below = (through[x] < limit) & (sky[x] == np.uint8(0))
        count += np.int32(1) if below else np.int32(0)
    return count
