"""Compiled loops of the particle field: which sizes are resolved, where each particle is.

Serial, without fast-math and without sums across threads, so that the same arguments give the same
bits in every process. Constants come in as arguments, because a compiled cache does not notice a
changed constant of another module.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from weather_aug._compiled import compiled, inlined

QUARTER_PI = 0.7853981633974483
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
BUFFER = 1024
"""Candidates that are looked at closely in one go."""


class View(NamedTuple):
    """What a camera sees and resolves of C classes of Q sizes; field axes are the particles'."""

    near_m: Any
    """Near limit."""
    near_full_m: Any
    """Depth up to which the opacity rises from 0 at the near limit."""
    reach_m: Any
    """(C, Q) float32 depth limits, rising along each row; Q is a power of 2 up to 16."""
    fade_per_m: Any
    """(C, Q) float32, how fast the opacity falls before the reach."""
    camera_from_field: Any
    """(3, 3) rotation."""
    tangents: Any
    """(4,): left, right, top, bottom of the view, blur included."""
    pad_m: Any
    """(C,) how far outside the view a particle of the class still touches it."""
    steepest: Any
    """(2,) tangents across and down beyond which no particle of the whole picture is drawn."""


class Motion(NamedTuple):
    """How the particles of each class move, camera axes."""

    velocities: Any
    """(C, 3) float32, relative to the camera."""
    sway_m: Any
    """(C, 2) amplitudes of the two sways, not negative."""
    sway_turns: Any
    """(C, 2) turns of the sways at this time."""
    sway_axes: Any
    """(2, 3) directions of the sways."""
    sway_velocities: Any
    """(C, 2, 3) float32 velocity amplitude of both sways."""


class Looks(NamedTuple):
    """What a particle looks like."""

    diameters_m: Any
    """(C, Q) float32."""
    shapes: Any
    """(S, 5, 6) float32, covariances of tumbling particles of diameter 1 (see tumble.py), camera
    axes, S a power of 2 up to 1024; S = 0 for balls."""
    shape_turns: Any
    """(S,) turns of the tumbling at this time."""
    sine: Any
    """(1024,) one turn of the sine."""


@compiled
def reach(diameter_m, streak_m, focal_px, alpha, half_m):
    """Depth up to which a particle's pixel opacity is at least alpha (1 + z / half_m), or 0.

    The opacity stays the same while the particle is wider than a pixel, then falls with the depth
    while its streak is longer than a pixel, then with its square.
    """
    quarter_pi = QUARTER_PI
    length_m = streak_m + diameter_m
    flat = half_m * (quarter_pi * diameter_m / (alpha * length_m) - 1.0)
    if flat <= focal_px * diameter_m:
        return max(flat, 0.0)
    streak = quarter_pi * focal_px * diameter_m * diameter_m / (alpha * length_m)
    falling = 0.5 * half_m * (np.sqrt(1.0 + 4.0 * streak / half_m) - 1.0)
    if falling <= focal_px * length_m:
        return falling
    square = quarter_pi * (focal_px * diameter_m) ** 2 / alpha
    z = np.sqrt(square)
    for _ in range(6):
        # Newton's steps come down from above: the function is convex.
        z -= (z * z * (1.0 + z / half_m) - square) / (z * (2.0 + 3.0 * z / half_m))
    return z


@compiled
def _fill_reach(
    diameters_m,
    per_size,
    streak_m,
    focal_px,
    solid_px,
    half_m,
    alpha,
    near_m,
    least_m,
    far_m,
    reach_m,
):
    count = 0.0
    for c in range(diameters_m.shape[0]):
        for q in range(diameters_m.shape[1]):
            z = min(reach(diameters_m[c, q], streak_m[c], focal_px, alpha, half_m), far_m)
            if z <= least_m:
                z = 0.0
            else:
                count += per_size[c] * solid_px * (z**3 - near_m**3) / 3.0
            reach_m[c, q] = z
    return count


@compiled
def solve_reach(
    diameters_m,
    per_size,
    streak_m,
    focal_px,
    solid_px,
    half_m,
    budget,
    faintest,
    near_m,
    least_m,
    far_m,
):
    """Smallest opacity threshold whose expected particle count keeps the budget, by bisection.

    The threshold rises with the depth, doubling at `half_m`: a particle wider than a pixel is as
    opaque near as far, so that an even threshold would let in all of a dense size or none, and the
    reach would leap when weather or speed change. A size whose reach would be under `least_m` is
    not drawn at all.

    Returns:
        The threshold, reach (C, Q) in metres, and the expected count.
    """
    reach_m = np.zeros(diameters_m.shape)
    args = (diameters_m, per_size, streak_m, focal_px, solid_px, half_m)
    limits = (near_m, least_m, far_m, reach_m)
    low, high = faintest, 1.0
    count = _fill_reach(*args, low, *limits)
    if count <= budget:
        return low, reach_m, count
    for _ in range(24):
        middle = np.sqrt(low * high)
        if _fill_reach(*args, middle, *limits) > budget:
            low = middle
        else:
            high = middle
    count = _fill_reach(*args, high, *limits)
    return high, reach_m, count


@compiled
def resolved_optical_depth(
    diameters_m, per_size, reach_m, near_m, near_full_m, fade_share, far_m, bins
):
    """Optical depth of the drawn particles from the camera to each of `bins` + 1 depths up to far.

    The opacity of a size is a trapezium of depth: it rises between the two near limits and falls
    over the last `fade_share` of its reach. Its second derivative is four impulses g at depths p,
    so that the optical depth is the sum of g (z - p)^2 / 2 over those in front of z: three running
    sums, exact at every bin.
    """
    step_m = far_m / bins
    moments = np.zeros((bins + 2, 3))
    for c in range(diameters_m.shape[0]):
        for q in range(diameters_m.shape[1]):
            z = reach_m[c, q]
            if z > 0.0:
                d = diameters_m[c, q]
                area = per_size[c] * QUARTER_PI * d * d
                rise, fall = area / (near_full_m - near_m), area / (fade_share * z)
                _impulse(moments, step_m, near_m, rise)
                _impulse(moments, step_m, near_full_m, -rise)
                _impulse(moments, step_m, (1.0 - fade_share) * z, -fall)
                _impulse(moments, step_m, z, fall)
    optical_depth = np.zeros(bins + 1, np.float32)
    s0, s1, s2 = 0.0, 0.0, 0.0
    for k in range(bins + 1):
        s0, s1, s2 = s0 + moments[k, 0], s1 + moments[k, 1], s2 + moments[k, 2]
        z = k * step_m
        optical_depth[k] = max(0.5 * (s0 * z * z - 2.0 * s1 * z + s2), 0.0)
    return optical_depth


@compiled
def _impulse(moments, step_m, position_m, strength):
    """Add an impulse to the moments of the first bin at or behind it."""
    k = int(np.ceil(position_m / step_m))
    moments[k, 0] += strength
    moments[k, 1] += strength * position_m
    moments[k, 2] += strength * position_m * position_m


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
def _interval(planes, px, py):
    """Range of z that all planes leave to the points of a column at (px, py).

    A plane keeps points p with n.p + offset >= 0; the camera is the origin.
    """
    low, high = -1e9, 1e9
    for k in range(planes.shape[0]):
        rest = planes[k, 0] * px + planes[k, 1] * py + planes[k, 3]
        nz = planes[k, 2]
        if nz > 1e-9:
            low = max(low, -rest / nz)
        elif nz < -1e-9:
            high = min(high, -rest / nz)
        elif rest < 0.0:
            return 1.0, 0.0
    return low, high


@compiled
def _turn(word, turns):
    """Place in a sine table of 1024 after `turns`, from a phase in the low bits of `word`."""
    return np.int64(np.float64(np.int64(word & np.uint64(1023))) + 1024.0 * turns) & 1023


@compiled
def scatter(
    class_keys, counts, arrivals, cell_m, origin_m, planes, bounds, view, motion, looks, out
):
    """Enumerate the particles that a camera can resolve, in camera axes.

    The particles of a class form an endless Poisson field that drifts rigidly: space, seen from the
    drifting frame, is cut into cubes, and the content of a cube is a hash of its index. How many
    particles a cube holds is a quantile of the Poisson distribution at the cube's own uniform
    number, and where the n-th of them is does not depend on how many there are: a higher density
    adds particles and moves none. The latest ones of a cube are faint, so that none pops up while
    the density rises.

    Args:
        class_keys: (C,) uint64.
        counts: (C, K) uint64, the distribution function of the count of a cube times 2^64; the
            last is the largest word.
        arrivals: (C,) how many later particles a cube must have room for until one is fully there.
        cell_m: (C,) side of a cube.
        origin_m: (C, 3) camera position minus the drift of the class, field axes, float64.
        planes: (C, 6, 4) planes of the padded view, field axes about the camera: normals point
            inwards, the offset holds the padding and half a cube.
        bounds: (C, 2, 3) box around the padded view, field axes about the camera, metres.
        view: View.
        motion: Motion.
        looks: Looks.
        out: (N, 13) float32: position, velocity, covariance, opacity; camera axes.

    Returns:
        Number of particles found; those beyond N are counted, not written.
    """
    found = 0
    sizes = view.reach_m.shape[1]
    size_mask = np.uint64(sizes - 1)
    grid = np.uint64(0xFFFFF)
    r = view.camera_from_field
    left, right, top, bottom = view.tangents
    steepest = max(abs(left), abs(right), abs(top), abs(bottom))
    words = np.empty(BUFFER + counts.shape[1], np.uint64)
    places = np.empty((BUFFER + counts.shape[1], 4))
    limit = np.empty(sizes)
    for c in range(class_keys.shape[0]):
        if view.reach_m[c, sizes - 1] <= view.near_m:
            continue
        cell = cell_m[c]
        per_arrival = 1.0 / arrivals[c]
        swing = motion.sway_m[c, 0] + motion.sway_m[c, 1]
        wide = view.pad_m[c] + swing * (1.0 + steepest)
        near = view.near_m - swing
        for q in range(sizes):
            limit[q] = view.reach_m[c, q] + swing
        # Where the camera sits in the class's lattice: an integer cube and the rest.
        origin = origin_m[c] / cell
        base = np.floor(origin)
        rx, ry, rz = origin[0] - base[0], origin[1] - base[1], origin[2] - base[2]
        bx, by, bz = int(base[0]), int(base[1]), int(base[2])
        x0 = int(np.floor(bounds[c, 0, 0] / cell + rx))
        x1 = int(np.floor(bounds[c, 1, 0] / cell + rx))
        y0 = int(np.floor(bounds[c, 0, 1] / cell + ry))
        y1 = int(np.floor(bounds[c, 1, 1] / cell + ry))
        # A step of the grid inside a cube, in camera axes.
        step = cell / 1048576.0
        xx, xy, xz = r[0, 0] * step, r[0, 1] * step, r[0, 2] * step
        yx, yy, yz = r[1, 0] * step, r[1, 1] * step, r[1, 2] * step
        zx, zy, zz = r[2, 0] * step, r[2, 1] * step, r[2, 2] * step
        fill = 0
        for ix in range(x0, x1 + 1):
            px = (ix - rx) * cell
            for iy in range(y0, y1 + 1):
                py = (iy - ry) * cell
                low, high = _interval(planes[c], px + 0.5 * cell, py + 0.5 * cell)
                z0 = int(np.ceil(low / cell + rz - 0.5 - 1e-6))
                z1 = int(np.floor(high / cell + rz - 0.5 + 1e-6))
                for iz in range(z0, z1 + 1):
                    key = cell_key(class_keys[c], bx + ix, by + iy, bz + iz)
                    many = 0
                    while key > counts[c, many]:
                        many += 1
                    pz = (iz - rz) * cell
                    corner_x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz
                    corner_y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz
                    corner_z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz
                    slot = key
                    later = 1.0
                    if many > 0:
                        before = counts[c, many - 1]
                        later = np.float64(key - before) / np.float64(counts[c, many] - before)
                    later += many
                    for n in range(many):
                        slot += GOLDEN
                        word = mix64(slot)
                        ux = np.float64(np.int64((word >> np.uint64(4)) & grid))
                        uy = np.float64(np.int64((word >> np.uint64(24)) & grid))
                        uz = np.float64(np.int64(word >> np.uint64(44)))
                        x = corner_x + xx * ux + xy * uy + xz * uz
                        y = corner_y + yx * ux + yy * uy + yz * uz
                        z = corner_z + zx * ux + zy * uy + zz * uz
                        # One in three passes, unpredictably: count it, do not branch on it.
                        passes = (z >= near) & (z <= limit[np.int64(word & size_mask)])
                        passes &= (x >= left * z - wide) & (x <= right * z + wide)
                        passes &= (y >= top * z - wide) & (y <= bottom * z + wide)
                        words[fill] = word
                        places[fill, 0], places[fill, 1], places[fill, 2] = x, y, z
                        places[fill, 3] = min((later - (n + 1)) * per_arrival, 1.0)
                        fill += int(passes)
                    if fill >= BUFFER:
                        found = _record(c, words, places, fill, view, motion, looks, found, out)
                        fill = 0
        found = _record(c, words, places, fill, view, motion, looks, found, out)
    return found


@compiled
def _record(c, words, places, fill, view, motion, looks, found, out):
    """Let the candidates of a class sway, and write those that the camera resolves."""
    capacity = out.shape[0]
    sine = looks.sine
    size_mask = np.uint64(view.reach_m.shape[1] - 1)
    shape_mask = np.uint64(max(looks.shapes.shape[0] - 1, 0))
    left, right, top, bottom = view.tangents
    per_near_m = 1.0 / (view.near_full_m - view.near_m)
    pad = view.pad_m[c]
    axes = motion.sway_axes
    for i in range(fill):
        q = np.int64(words[i] & size_mask)
        # Phases and shape come from another hash, for the few that are in view.
        word = mix64(words[i])
        ta = _turn(word, motion.sway_turns[c, 0])
        tb = _turn(word >> np.uint64(10), motion.sway_turns[c, 1])
        sa, sb = motion.sway_m[c, 0] * sine[ta], motion.sway_m[c, 1] * sine[tb]
        x = places[i, 0] + sa * axes[0, 0] + sb * axes[1, 0]
        y = places[i, 1] + sa * axes[0, 1] + sb * axes[1, 1]
        z = places[i, 2] + sa * axes[0, 2] + sb * axes[1, 2]
        passes = (z >= view.near_m) & (z <= view.reach_m[c, q])
        passes &= (x >= left * z - pad) & (x <= right * z + pad)
        passes &= (y >= top * z - pad) & (y <= bottom * z + pad)
        passes &= (abs(x) <= view.steepest[0] * z) & (abs(y) <= view.steepest[1] * z)
        if not passes:
            continue
        if found < capacity:
            row = out[found]
            row[0], row[1], row[2] = x, y, z
            ca = np.float32(sine[(ta + 256) & 1023])
            cb = np.float32(sine[(tb + 256) & 1023])
            for k in range(3):
                row[3 + k] = (
                    motion.velocities[c, k]
                    + ca * motion.sway_velocities[c, 0, k]
                    + cb * motion.sway_velocities[c, 1, k]
                )
            square = looks.diameters_m[c, q] * looks.diameters_m[c, q]
            if looks.shapes.shape[0] > 0:
                s = np.int64((word >> np.uint64(20)) & shape_mask)
                t = _turn(word >> np.uint64(30), looks.shape_turns[s])
                _tumbled(looks.shapes[s], square, sine, t, row)
            else:
                _ball(square, row)
            leaving = (view.reach_m[c, q] - z) * view.fade_per_m[c, q]
            entering = (z - view.near_m) * per_near_m
            row[12] = min(leaving, entering, 1.0) * places[i, 3]
        found += 1
    return found


@inlined
def _ball(square, row):
    """Covariance of a ball of this squared diameter: a disc from everywhere."""
    variance = np.float32(0.125) * square
    row[6], row[7], row[8] = variance, np.float32(0.0), np.float32(0.0)
    row[9], row[10], row[11] = variance, np.float32(0.0), variance


@inlined
def _tumbled(shape, square, sine, turn, row):
    """Covariance of a tumbling particle at a place of the sine's table."""
    sin1, cos1 = np.float32(sine[turn]), np.float32(sine[(turn + 256) & 1023])
    double = 2 * turn
    sin2, cos2 = np.float32(sine[double & 1023]), np.float32(sine[(double + 256) & 1023])
    for k in range(6):
        row[6 + k] = square * (
            shape[0, k]
            + cos1 * shape[1, k]
            + sin1 * shape[2, k]
            + cos2 * shape[3, k]
            + sin2 * shape[4, k]
        )
