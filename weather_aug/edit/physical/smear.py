"""Compiled loops that smear light on lines, each cell by its own width, at a cost of the cells."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.edit.physical.mirror_lines import line_at, ray_at

WIDE_CELLS = 24
"""From this radius on, whole radii are fine enough steps of a smear's width."""
LEAST_WEIGHT = 1e-6
"""Of known cells under a tent; less is rounding."""


@compiled
def summed_down(source, light, sky_light, view, twice, ends):
    """Sum the light on the lines down twice.

    Args:
        source: (h, w).
        light: (h * w, 3).
        sky_light: (2, 3).
        view: Of the map.
        twice: (h + 1, w, 4), filled with the sums of the sums of red, green, blue and 1 over the
            rows before, below the horizon; float64, because smears are differences of them.
        ends: (w, 4), filled with the sums over all rows.
    """
    height, width = source.shape
    twice[0] = 0.0
    ends[:] = 0.0
    for row in range(height):
        for j in range(width):
            x, y, climb = ray_at(np.float32(row), np.float32(j), view)
            cell = source[row, j]
            if climb < np.float32(0.0):
                ends[j, 3] += 1.0
                if cell >= 0:
                    for k in range(3):
                        ends[j, k] += light[cell, k]
                else:
                    sine = -climb / np.sqrt(x * x + y * y + np.float32(1.0))
                    for k in range(3):
                        ends[j, k] += sky_light[0, k] + sine * (sky_light[1, k] - sky_light[0, k])
            for k in range(4):
                twice[row + 1, j, k] = twice[row, j, k] + ends[j, k]


@compiled
def smear(ends, twice, spread, view, slope, out):
    """Smear the light along the lines and across, and put it from the lines on the columns.

    A tent of any width is the second difference of the twofold sum; its width varies from cell to
    cell. Where it reaches beyond what is known, the known part is weighted up.
    """
    height, width = spread.shape
    down = np.empty((width, 4), np.float64)
    across = np.zeros((width, 3), np.float32)
    radii = np.empty(width, np.float32)
    row_ends, row_twice = np.empty(4, np.float64), np.zeros((width + 1, 4), np.float64)
    lowest = height
    for row in range(height - 1, -1, -1):
        known = 0
        for j in range(width):
            x, y, climb = ray_at(np.float32(row), np.float32(j), view)
            sine = max(-climb, np.float32(0.0)) / np.sqrt(x * x + y * y + np.float32(1.0))
            sigma_rad = np.float32(2.0) * slope * spread[row, j]
            radii[j] = _radius(sine * sigma_rad * view.fx)
            _tent(ends[j], twice[:, j], row, _radius(sigma_rad * view.fy), down[j])
            known += climb < np.float32(0.0)
        if known == 0:
            break
        row_ends[:] = 0.0
        for j in range(width):
            share = 1.0 / down[j, 3] if down[j, 3] > LEAST_WEIGHT else 0.0
            row_ends[3] += 1.0 if share > 0.0 else 0.0
            for k in range(3):
                row_ends[k] += share * down[j, k]
            for k in range(4):
                row_twice[j + 1, k] = row_twice[j, k] + row_ends[k]
        for j in range(width):
            _tent(row_ends, row_twice, j, radii[j], down[j])
            # Above the horizon the row below goes on.
            if down[j, 3] > LEAST_WEIGHT:
                for k in range(3):
                    across[j, k] = down[j, k] / down[j, 3]
        _on_columns(across, np.float32(row), view, out[row])
        lowest = row
    if lowest == height:
        # The whole picture is above the horizon: nothing in it mirrors.
        out[:] = np.float32(0.0)
        return
    for row in range(lowest):
        out[row] = out[lowest]


@inlined
def _radius(sigma):
    """Half the width of the tent (1 - |t| / r) whose variance on cells, (r² - 1) / 6, is sigma²."""
    return np.sqrt(np.float32(1.0) + np.float32(6.0) * sigma * sigma)


@inlined
def _tent(ends, twice, at, radius, out):
    """Sums (4,) under a tent about a cell, from twofold sums (n + 1, 4) and sums (4,) of all.

    Between two whole radii it is a mixture of their tents; of wide ones the nearest serves.
    """
    narrow = np.int64(radius)
    share = np.float64(radius - np.float32(narrow))
    if narrow >= WIDE_CELLS:
        narrow = np.int64(radius + np.float32(0.5))
        share = np.float64(0.0)
    inverse = (1.0 - share) / np.float64(narrow * narrow)
    _second_difference(ends, twice, at, narrow, inverse, False, out)
    if share > 0.0:
        inverse = share / np.float64((narrow + 1) * (narrow + 1))
        _second_difference(ends, twice, at, narrow + 1, inverse, True, out)


@inlined
def _second_difference(ends, twice, at, reach, factor, adding, out):
    """Write, or add, `factor` times the second difference of twofold sums."""
    last = twice.shape[0] - 1
    low = max(at - reach, 0)
    high = min(at + reach, last)
    beyond = np.float64(at + reach - high)
    for k in range(4):
        rise = twice[high, k] + beyond * ends[k] - 2.0 * twice[at, k] + twice[low, k]
        out[k] = (out[k] if adding else 0.0) + factor * rise


@inlined
def _on_columns(across, row, view, out):
    """Put a row (w, 3) from the lines on the columns."""
    width = across.shape[0]
    shift, scale = line_at(row, view)
    inverse = np.float32(1.0) / max(scale, np.float32(1e-3))
    for column in range(width):
        line = (np.float32(column) - shift) * inverse
        line = min(max(line, np.float32(0.0)), np.float32(width - 1))
        left = min(np.int64(line), width - 2)
        share = line - np.float32(left)
        for k in range(3):
            out[column, k] = across[left, k] + share * (across[left + 1, k] - across[left, k])
