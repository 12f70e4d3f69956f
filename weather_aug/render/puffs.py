"""Puffs of fog: a Poisson field of isotropic 3D Gaussians at rest in the drifting air. Compiled.

Space in the drifting frame is cut into cubes; what a cube holds is a hash of its index. Within the
light's path a puff is extinction, so its optical depth is a line integral in closed form, and the
optical depths of puffs add.
"""

from __future__ import annotations

import math

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import survival
from weather_aug.particles.kernels import GOLDEN, cell_key, mix64

CUT = 3.0
"""Reach of a puff in standard deviations; what is cut off is made good inside."""


@compiled
def gather(keys, sigma_m, mean_per_cell, cell_m, origin_m, axes, bounds_m, out):
    """Enumerate the puffs whose centres lie in boxes around the camera.

    A cube's puffs are the first of an endless list of its own, as many as a Poisson quantile of its
    own number says: at a higher density puffs are added and none moves.

    Args:
        keys: (K,) uint64 of the classes.
        sigma_m: (K,).
        mean_per_cell: (K,) expected puffs per cube, below 100.
        cell_m: (K,) side of a cube.
        origin_m: (3,) camera minus the drift of the air, in the axes of the lattice.
        axes: (3, 3) rows: the lattice's axes in camera axes.
        bounds_m: (K, 2, 3) box around the camera, in the axes of the lattice.
        out: (N, 5) float64: centre in camera axes (3), class, height above the camera (along the
            lattice's third axis).

    Returns:
        Number of puffs found; those beyond N are counted, not written.
    """
    found = 0
    to_unit = 1.0 / 2097152.0
    for c in range(keys.shape[0]):
        cell, none = cell_m[c], math.exp(-mean_per_cell[c])
        base = np.floor(origin_m / cell)
        rest = origin_m / cell - base
        bx, by, bz = int(base[0]), int(base[1]), int(base[2])
        low = np.floor(bounds_m[c, 0] / cell + rest)
        high = np.floor(bounds_m[c, 1] / cell + rest)
        for ix in range(int(low[0]), int(high[0]) + 1):
            for iy in range(int(low[1]), int(high[1]) + 1):
                for iz in range(int(low[2]), int(high[2]) + 1):
                    key = cell_key(keys[c], bx + ix, by + iy, bz + iz)
                    rank = np.float64(mix64(key + GOLDEN) >> np.uint64(11)) * (2.0**-53)
                    chance, level, count = none, none, 0
                    while rank >= level and count < 400:
                        count += 1
                        chance *= mean_per_cell[c] / count
                        level += chance
                    for slot in range(count):
                        word = mix64(key + np.uint64(slot + 2) * GOLDEN)
                        ux = np.float64(word & np.uint64(0x1FFFFF)) * to_unit
                        uy = np.float64((word >> np.uint64(21)) & np.uint64(0x1FFFFF)) * to_unit
                        uz = np.float64(word >> np.uint64(42)) * (0.5 * to_unit)
                        px = (ix + ux - rest[0]) * cell
                        py = (iy + uy - rest[1]) * cell
                        pz = (iz + uz - rest[2]) * cell
                        if found < out.shape[0]:
                            for k in range(3):
                                out[found, k] = px * axes[0, k] + py * axes[1, k] + pz * axes[2, k]
                            out[found, 3] = c
                            out[found, 4] = pz
                        found += 1
    return found


@compiled
def _tangents(across, ahead, reach):
    """Smallest and largest tangent under which a ball at (across, ahead) is seen."""
    away = math.hypot(across, ahead)
    if away <= reach:
        return -1e9, 1e9
    middle, half = math.atan2(across, ahead), math.asin(reach / away)
    quarter = 0.5 * math.pi - 1e-6
    first, last = middle - half, middle + half
    if first >= quarter or last <= -quarter:
        return 1.0, 0.0
    return math.tan(max(first, -quarter)), math.tan(min(last, quarter))


@compiled
def add_puffs(puffs, sigma_m, optical_depth_m, ray_x, ray_y, depths_m, rise, out):
    """Add the line integrals of puffs to the slices of every ray that they touch.

    Args:
        puffs: (N, 5); see `gather`.
        sigma_m: (N,).
        optical_depth_m: (N,) optical depth through the middle over the extinction at the camera.
        ray_x: (C,) float64 ascending tangents of the columns.
        ray_y: (R,) float64 ascending tangents of the rows.
        depths_m: (NEAR_SLICES + 1,) of the slices, from 0.
        rise: (RISE,) float64 integral of the normal density from -CUT to CUT, 0 to 1.
        out: (R, C, NEAR_SLICES) float64, added to; see `froxels.accumulate`.
    """
    farthest = depths_m[depths_m.shape[0] - 1]
    # What is cut off the sides is made good.
    whole = 1.0 / (1.0 - math.exp(-0.5 * CUT * CUT))
    for n in range(puffs.shape[0]):
        px, py, pz = puffs[n, 0], puffs[n, 1], puffs[n, 2]
        sigma = sigma_m[n]
        x0, x1 = _tangents(px, pz, CUT * sigma)
        y0, y1 = _tangents(py, pz, CUT * sigma)
        c0, c1 = np.searchsorted(ray_x, x0), np.searchsorted(ray_x, x1)
        r0, r1 = np.searchsorted(ray_y, y0), np.searchsorted(ray_y, y1)
        away = px * px + py * py + pz * pz
        cut2, per_variance = CUT * CUT * sigma * sigma, 0.5 / (sigma * sigma)
        peak = optical_depth_m[n] * whole
        for r in range(r0, r1):
            across, along_y = 1.0 + ray_y[r] * ray_y[r], ray_y[r] * py + pz
            for c in range(c0, c1):
                squared = across + ray_x[c] * ray_x[c]
                along = ray_x[c] * px + along_y
                middle = along / squared
                off_axis = away - along * middle
                if off_axis >= cut2:
                    continue
                per_norm = 1.0 / math.sqrt(squared)
                half = CUT * sigma * per_norm
                if middle <= -half or middle - half >= farthest:
                    continue
                fades = np.float64(survival(np.float32(off_axis * per_variance)))
                _add_profile(peak * fades * per_norm, middle, half, depths_m, rise, out[r, c])


@compiled
def _add_profile(amount, middle, half, depths_m, rise, out):
    """Spread one puff over the slices of one ray."""
    last = depths_m.shape[0] - 1
    start, end, per_half = middle - half, middle + half, 1.0 / half
    k = int(math.sqrt(16.0 + 8.0 * start) - 4.0) if start > 0.0 else 0
    before = 0.0 if start >= 0.0 else _risen(-middle * per_half, rise)
    while k < last:
        z = depths_m[k + 1]
        now = 1.0 if z >= end else _risen((z - middle) * per_half, rise)
        out[k] += amount * (now - before)
        if z >= end:
            break
        before = now
        k += 1


@inlined
def _risen(place, rise):
    """Share of a puff in front of `place`, in units of its reach from the middle."""
    position = (place + 1.0) * (0.5 * (rise.shape[0] - 1))
    i = np.uint64(min(max(np.int64(position), 0), rise.shape[0] - 2))
    return rise[i] + (position - np.float64(i)) * (rise[i + np.uint64(1)] - rise[i])
