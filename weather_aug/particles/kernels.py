"""Compiled loops of the particle field: which sizes are resolved, where each particle is.

Serial, without fast-math and without sums across threads, so that the same arguments give the same
bits in every process. Constants come in as arguments, because a compiled cache does not notice a
changed constant of another module.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled

QUARTER_PI = 0.7853981633974483
GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@compiled
def reach(diameter_m, streak_m, focal_px, alpha):
    """Depth at which a particle's pixel opacity falls to `alpha`; 0 if it is fainter everywhere."""
    length_m = streak_m + diameter_m
    if QUARTER_PI * diameter_m < alpha * length_m:
        return 0.0
    as_streak = QUARTER_PI * focal_px * diameter_m * diameter_m / (alpha * length_m)
    if as_streak <= focal_px * length_m:
        return as_streak
    return focal_px * diameter_m * np.sqrt(QUARTER_PI / alpha)


@compiled
def _fill_reach(diameters_m, per_size, streak_m, focal_px, solid_px, alpha, near_m, far_m, reach_m):
    count = 0.0
    for c in range(diameters_m.shape[0]):
        for q in range(diameters_m.shape[1]):
            z = min(reach(diameters_m[c, q], streak_m[c], focal_px, alpha), far_m)
            if z <= near_m:
                z = 0.0
            else:
                count += per_size[c] * solid_px * (z**3 - near_m**3) / 3.0
            reach_m[c, q] = z
    return count


@compiled
def solve_reach(
    diameters_m, per_size, streak_m, focal_px, solid_px, budget, faintest, near_m, far_m
):
    """Smallest opacity threshold whose expected particle count keeps the budget, by bisection.

    Returns:
        The threshold, reach (C, Q) in metres, and the expected count.
    """
    reach_m = np.zeros(diameters_m.shape)
    args = (diameters_m, per_size, streak_m, focal_px, solid_px)
    low, high = faintest, 1.0
    count = _fill_reach(*args, low, near_m, far_m, reach_m)
    if count <= budget:
        return low, reach_m, count
    for _ in range(24):
        middle = np.sqrt(low * high)
        if _fill_reach(*args, middle, near_m, far_m, reach_m) > budget:
            low = middle
        else:
            high = middle
    count = _fill_reach(*args, high, near_m, far_m, reach_m)
    return high, reach_m, count


@compiled
def resolved_optical_depth(diameters_m, per_size, reach_m, near_m, far_m, bins):
    """Optical depth of the drawn particles from the camera to each of `bins` + 1 depths up to far.

    Each size adds a straight line between the near limit and its reach.
    """
    step_m = far_m / bins
    bend = np.zeros(bins + 2)
    for c in range(diameters_m.shape[0]):
        for q in range(diameters_m.shape[1]):
            if reach_m[c, q] > 0.0:
                d = diameters_m[c, q]
                per_step = per_size[c] * QUARTER_PI * d * d * step_m
                _bend(bend, near_m / step_m, per_step)
                _bend(bend, reach_m[c, q] / step_m, -per_step)
    optical_depth = np.zeros(bins + 1, np.float32)
    slope, total = 0.0, 0.0
    for k in range(bins):
        slope += bend[k]
        total += slope
        optical_depth[k + 1] = total
    return optical_depth


@compiled
def _bend(bend, position, slope):
    """Change the slope at `position`: for the rest of its bin, and wholly from the next one on."""
    k = int(position)
    inside = (k + 1 - position) * slope
    bend[k] += inside
    bend[k + 1] += slope - inside


@compiled
def mix64(word):
    """Finaliser of splitmix64: a bijection of 64-bit words whose every output bit is mixed."""
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


@compiled
def cell_key(class_key, ix, iy, iz):
    """Key of one cell of one class's lattice."""
    word = class_key + np.uint64(ix) * np.uint64(0xD6E8FEB86659FD93)
    word = mix64(word) + np.uint64(iy) * np.uint64(0xA0761D6478BD642F)
    word = mix64(word) + np.uint64(iz) * np.uint64(0xE7037ED1A0B428DB)
    return mix64(word)


@compiled
def _interval(planes, px, py, slack, cell):
    """Range of z (in cells from the camera) that all planes leave to the cell column at (px, py).

    A plane keeps points p with n.p + offset >= -slack; the camera is the origin.
    """
    low, high = -1e9, 1e9
    for k in range(planes.shape[0]):
        rest = planes[k, 0] * px + planes[k, 1] * py + planes[k, 3] + slack
        nz = planes[k, 2]
        if nz > 1e-9:
            low = max(low, -rest / nz)
        elif nz < -1e-9:
            high = min(high, -rest / nz)
        elif rest < 0.0:
            return 1.0, 0.0
    return low / cell, high / cell


@compiled
def _turn(word, turns):
    """Place in a sine table of 1024 after `turns`, from a phase in the low bits of `word`."""
    return np.int64(np.float64(word & np.uint64(1023)) + 1024.0 * turns) & 1023


@compiled
def scatter(
    class_keys,
    mean_per_cell,
    cell_m,
    drift_m,
    reach_m,
    planes,
    bounds,
    exponential,
    sway_m,
    sway_turns,
    sway_axes,
    sine,
    near_m,
    camera_from_world,
    view,
    pad_m,
    diameters_m,
    velocities,
    sway_velocities,
    out,
):
    """Enumerate the particles that a camera can resolve, in camera axes.

    The particles of a class form an endless Poisson field that drifts rigidly: space, seen from the
    drifting frame, is cut into cubes, and the content of a cube is a hash of its index. A cube's
    particles are the arrivals of a unit-rate process up to its expected number, so that a higher
    density adds particles and moves none.

    Args:
        class_keys: (C,) uint64.
        mean_per_cell: (C,) expected particles per cube.
        cell_m: (C,) side of a cube.
        drift_m: (C, 3) camera position minus the drift of the class, world axes, float64.
        reach_m: (C, Q) float32 depth limits.
        planes: (C, 6, 4) planes of the padded view, world axes about the camera: normals point
            inwards, the offset holds the padding.
        bounds: (C, 2, 3) box around the padded view, world axes about the camera, metres.
        exponential: (4097,) quantiles of the unit exponential.
        sway_m: Amplitude of the sway.
        sway_turns: (C, 2) turns of the sway at this time.
        sway_axes: (2, 3) horizontal unit vectors, world axes.
        sine: (1024,) one turn of the sine.
        near_m: Near limit.
        camera_from_world: (3, 3) rotation.
        view: (x0, x1, y0, y1) tangents of the view, blur included.
        pad_m: (C,) how far outside the view a particle of the class still touches it.
        diameters_m: (C, Q) float32.
        velocities: (C, 3) float32, camera axes, relative to the camera.
        sway_velocities: (C, 2, 3) float32 velocity amplitude of both sways, camera axes.
        out: (N, 7) float32: position, velocity, diameter; camera axes.

    Returns:
        Number of particles found; those beyond N are counted, not written.
    """
    found = 0
    capacity = out.shape[0]
    sizes = reach_m.shape[1]
    r = camera_from_world
    to_unit = 1.0 / 2097152.0
    for c in range(class_keys.shape[0]):
        farthest = reach_m[c, sizes - 1]
        if farthest <= near_m or mean_per_cell[c] <= 0.0:
            continue
        cell = cell_m[c]
        mean = mean_per_cell[c]
        # A cube's corner, not its centre, is indexed; half the diagonal reaches all of it.
        slack = 0.8660254037844386 * cell
        # Where the camera sits in the class's lattice: an integer cube and the rest.
        origin = drift_m[c] / cell
        base = np.floor(origin)
        rest = origin - base
        bx, by, bz = int(base[0]), int(base[1]), int(base[2])
        x0 = int(np.floor(bounds[c, 0, 0] / cell + rest[0]))
        x1 = int(np.floor(bounds[c, 1, 0] / cell + rest[0]))
        y0 = int(np.floor(bounds[c, 0, 1] / cell + rest[1]))
        y1 = int(np.floor(bounds[c, 1, 1] / cell + rest[1]))
        for ix in range(x0, x1 + 1):
            px = (ix + 0.5 - rest[0]) * cell
            for iy in range(y0, y1 + 1):
                py = (iy + 0.5 - rest[1]) * cell
                low, high = _interval(planes[c], px, py, slack, cell)
                if low > high:
                    continue
                z0 = int(np.floor(low + rest[2] - 0.5))
                z1 = int(np.ceil(high + rest[2] - 0.5))
                for iz in range(z0, z1 + 1):
                    key = cell_key(class_keys[c], bx + ix, by + iy, bz + iz)
                    level = np.float64(0.0)
                    slot = np.uint64(0)
                    while True:
                        slot += np.uint64(1)
                        word = mix64(key + slot * GOLDEN)
                        step = np.int64(word & np.uint64(4095))
                        part = np.float64(word >> np.uint64(52)) * (1.0 / 4096.0)
                        below = np.float64(exponential[step])
                        level += below + part * (np.float64(exponential[step + 1]) - below)
                        if level > mean:
                            break
                        place = mix64(word)
                        ux = np.float64(place & np.uint64(0x1FFFFF)) * to_unit
                        uy = np.float64((place >> np.uint64(21)) & np.uint64(0x1FFFFF)) * to_unit
                        uz = np.float64(place >> np.uint64(42)) * (0.5 * to_unit)
                        wx = (ix + ux - rest[0]) * cell
                        wy = (iy + uy - rest[1]) * cell
                        wz = (iz + uz - rest[2]) * cell
                        ta, tb = 0, 0
                        if sway_m > 0.0:
                            ta = _turn(word >> np.uint64(20), sway_turns[c, 0])
                            tb = _turn(word >> np.uint64(30), sway_turns[c, 1])
                            sa, sb = sway_m * sine[ta], sway_m * sine[tb]
                            wx += sa * sway_axes[0, 0] + sb * sway_axes[1, 0]
                            wy += sa * sway_axes[0, 1] + sb * sway_axes[1, 1]
                            wz += sa * sway_axes[0, 2] + sb * sway_axes[1, 2]
                        z = r[2, 0] * wx + r[2, 1] * wy + r[2, 2] * wz
                        q = np.int64((word >> np.uint64(12)) & np.uint64(sizes - 1))
                        if z < near_m or z > reach_m[c, q]:
                            continue
                        x = r[0, 0] * wx + r[0, 1] * wy + r[0, 2] * wz
                        if x < view[0] * z - pad_m[c] or x > view[1] * z + pad_m[c]:
                            continue
                        y = r[1, 0] * wx + r[1, 1] * wy + r[1, 2] * wz
                        if y < view[2] * z - pad_m[c] or y > view[3] * z + pad_m[c]:
                            continue
                        if found < capacity:
                            row = out[found]
                            row[0], row[1], row[2] = x, y, z
                            ca, cb = sine[(ta + 256) & 1023], sine[(tb + 256) & 1023]
                            for k in range(3):
                                swing = (
                                    ca * sway_velocities[c, 0, k] + cb * sway_velocities[c, 1, k]
                                )
                                row[3 + k] = velocities[c, k] + swing
                            row[6] = diameters_m[c, q]
                        found += 1
    return found
