"""Where a ray enters and leaves a shape, and which way the surface faces there (numba).

Rays are origin + t * direction with a direction of any length; t is in units of it. The numbers of
the kinds are those of `street_parts`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Vector = tuple[float, float, float]
Span = tuple[float, float]
Draws = tuple[float, float, float, float, float, float]


@compiled
def draws_of(x: int, y: int, z: int, seed: float) -> Draws:
    """Return six numbers in [0, 1), steps of 1/1024, that depend on a cell and a whole seed alone.

    The hash is the finaliser of splitmix64 behind odd multipliers. The seed comes as a float
    because that is how the parts carry it (and because numba compiles anew for each literal int).
    """
    h = (
        np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
        ^ np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ np.uint64(z) * np.uint64(0x165667B19E3779F9)
    ) + np.uint64(int(seed)) * np.uint64(0xD6E8FEB86659FD93)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    mask, step = np.uint64(1023), 1.0 / 1024.0
    return (
        float(h & mask) * step,
        float((h >> np.uint64(10)) & mask) * step,
        float((h >> np.uint64(20)) & mask) * step,
        float((h >> np.uint64(30)) & mask) * step,
        float((h >> np.uint64(40)) & mask) * step,
        float((h >> np.uint64(50)) & mask) * step,
    )


@compiled
def into_frame(frame: Float64, i: int, x: float, y: float) -> Span:
    """Turn the horizontal part of a world direction into the object's axes."""
    c, s = frame[i, 3], frame[i, 4]
    return c * x + s * y, c * y - s * x


@compiled
def out_of_frame(frame: Float64, i: int, x: float, y: float) -> Span:
    """Turn the horizontal part of an object's direction into world axes."""
    c, s = frame[i, 3], frame[i, 4]
    return c * x - s * y, s * x + c * y


@compiled
def _slab(o: float, d: float, half: float) -> Span:
    if abs(d) < 1e-12:
        return (-math.inf, math.inf) if abs(o) <= half else (math.inf, -math.inf)
    a, b = (-half - o) / d, (half - o) / d
    return (a, b) if a < b else (b, a)


@compiled
def _box(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, s: Float64) -> Span:
    ax, bx = _slab(ox - s[0], dx, s[3])
    ay, by = _slab(oy - s[1], dy, s[4])
    az, bz = _slab(oz - s[2], dz, s[5])
    return max(ax, ay, az), min(bx, by, bz)


@compiled
def _quadric(a: float, b: float, c: float) -> Span:
    """Return both roots of a t^2 + 2 b t + c."""
    root = b * b - a * c
    if root < 0.0 or a <= 0.0:
        return math.inf, -math.inf
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@compiled
def _ellipsoid(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, s: Float64, scale: float
) -> Span:
    rx, ry, rz = 1.0 / (s[3] * scale), 1.0 / (s[4] * scale), 1.0 / (s[5] * scale)
    x, y, z = (ox - s[0]) * rx, (oy - s[1]) * ry, (oz - s[2]) * rz
    u, v, w = dx * rx, dy * ry, dz * rz
    return _quadric(u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0)


@compiled
def _capsule(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, s: Float64) -> Span:
    bx, by, bz, r = s[3] - s[0], s[4] - s[1], s[5] - s[2], s[6]
    x, y, z = ox - s[0], oy - s[1], oz - s[2]
    bb, bd = bx * bx + by * by + bz * bz, bx * dx + by * dy + bz * dz
    bo, dd = bx * x + by * y + bz * z, dx * dx + dy * dy + dz * dz
    od, oo = x * dx + y * dy + z * dz, x * x + y * y + z * z
    near, far = math.inf, -math.inf
    t0, t1 = _quadric(bb * dd - bd * bd, bb * od - bo * bd, bb * oo - bo * bo - r * r * bb)
    if 0.0 <= bo + t0 * bd <= bb:
        near = t0
    if 0.0 <= bo + t1 * bd <= bb:
        far = t1
    for end in range(2):
        x, y, z = x - end * bx, y - end * by, z - end * bz
        t0, t1 = _quadric(dd, x * dx + y * dy + z * dz, x * x + y * y + z * z - r * r)
        if t0 <= t1:
            near, far = min(near, t0), max(far, t1)
    return near, far


@compiled
def _wheel(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, s: Float64) -> Span:
    x, z = ox - s[0], oz - s[2]
    a, b = _slab(oy - s[1], dy, s[4])
    flat = dx * dx + dz * dz
    if flat < 1e-18:
        return (a, b) if x * x + z * z <= s[3] * s[3] else (math.inf, -math.inf)
    t0, t1 = _quadric(flat, x * dx + z * dz, x * x + z * z - s[3] * s[3])
    return max(a, t0), min(b, t1)


@compiled
def _disc(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, s: Float64) -> Span:
    along_y = s[5] > 0.5
    o, d = (oy - s[1], dy) if along_y else (ox - s[0], dx)
    if abs(d) < 1e-9:
        return math.inf, -math.inf
    t = -o / d
    across = ox + t * dx - s[0] if along_y else oy + t * dy - s[1]
    height = oz + t * dz - s[2]
    square = across * across + height * height
    if s[4] * s[4] <= square <= s[3] * s[3]:
        return t, t
    return math.inf, -math.inf


@compiled
def _hull(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    planes: Float64,
    first: int,
    count: int,
) -> Span:
    near, far = -math.inf, math.inf
    for p in range(first, first + count):
        a, b, c = planes[p, 0], planes[p, 1], planes[p, 2]
        speed = a * dx + b * dy + c * dz
        gap = planes[p, 3] - (a * ox + b * oy + c * oz)
        if abs(speed) < 1e-12:
            if gap < 0.0:
                return math.inf, -math.inf
        elif speed < 0.0:
            near = max(near, gap / speed)
        else:
            far = min(far, gap / speed)
        if near > far:
            return math.inf, -math.inf
    return near, far


@compiled
def leaf_hit(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    s: Float64,
    seed: float,
    t0: float,
    t1: float,
) -> tuple[float, float, float, float, float]:
    """Return the first leaf between t0 and t1: t (inf for none), normal, a tint in [0, 1).

    Each cell of a lattice in the object's frame owns a few leaves, drawn from the hash of the
    cell and cut at its walls, so that every ray, from any side, meets the same leaves.
    """
    h = 0.22
    sx, sy, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    ex, ey, ez = ox + dx * t0, oy + dy * t0, oz + dz * t0
    ix, iy, iz = math.floor(ex / h), math.floor(ey / h), math.floor(ez / h)
    gx = h / abs(dx) if abs(dx) > 1e-12 else math.inf
    gy = h / abs(dy) if abs(dy) > 1e-12 else math.inf
    gz = h / abs(dz) if abs(dz) > 1e-12 else math.inf
    tx = ((ix + (sx > 0)) * h - ox) / dx if abs(dx) > 1e-12 else math.inf
    ty = ((iy + (sy > 0)) * h - oy) / dy if abs(dy) > 1e-12 else math.inf
    tz = ((iz + (sz > 0)) * h - oz) / dz if abs(dz) > 1e-12 else math.inf
    t = t0
    while t < t1:
        leave = min(tx, ty, tz, t1)
        best, bx, by, bz, tint = math.inf, 0.0, 0.0, 1.0, 0.0
        for k in range(3):
            word = draws_of(ix, iy, iz, seed * 4.0 + k)
            cx = (ix + word[0]) * h
            cy = (iy + word[1]) * h
            cz = (iz + word[2]) * h
            qx, qy, qz = (cx - s[0]) / s[3], (cy - s[1]) / s[4], (cz - s[2]) / s[5]
            # Fewer leaves towards the rim, and none in random holes, make the outline ragged.
            if qx * qx + qy * qy + qz * qz > 0.55 + 0.5 * word[3]:
                continue
            nx, ny = 2.0 * word[4] - 1.0, 2.0 * word[5] - 1.0
            nz = 1.25 - abs(nx) * 0.8 - abs(ny) * 0.4
            speed = nx * dx + ny * dy + nz * dz
            if abs(speed) < 1e-9:
                continue
            hit = (nx * (cx - ox) + ny * (cy - oy) + nz * (cz - oz)) / speed
            if not (t <= hit <= leave and hit < best):
                continue
            px, py, pz = ox + dx * hit - cx, oy + dy * hit - cy, oz + dz * hit - cz
            along = (px * ny - py * nx) / math.sqrt(nx * nx + ny * ny + 1e-9)
            square = px * px + py * py + pz * pz
            width = 0.062 * (1.0 - along * along * 60.0)
            if width > 0.0 and square - along * along < width * width:
                best, bx, by, bz, tint = hit, nx, ny, nz, word[2]
        if best < math.inf:
            scale = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
            if bx * dx + by * dy + bz * dz > 0.0:
                scale = -scale
            return best, bx * scale, by * scale, bz * scale, tint
        t = leave
        if tx <= ty and tx <= tz:
            ix, tx = ix + sx, tx + gx
        elif ty <= tz:
            iy, ty = iy + sy, ty + gy
        else:
            iz, tz = iz + sz, tz + gz
    return math.inf, 0.0, 0.0, 1.0, 0.0


@compiled
def span(
    kind: int,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    s: Float64,
    planes: Float64,
    seed: float,
    limit: float,
) -> Span:
    """Return where a ray in the object's frame enters and leaves a part; (inf, -inf) if nowhere.

    For leaves it is the first leaf, or the opaque inner part behind them, in front of the origin;
    those beyond `limit` need not be found.
    """
    if kind == 0:
        return _box(ox, oy, oz, dx, dy, dz, s)
    if kind == 1:
        return _ellipsoid(ox, oy, oz, dx, dy, dz, s, 1.0)
    if kind == 2:
        return _capsule(ox, oy, oz, dx, dy, dz, s)
    if kind == 3:
        return _wheel(ox, oy, oz, dx, dy, dz, s)
    if kind == 4:
        return _disc(ox, oy, oz, dx, dy, dz, s)
    if kind == 5:
        return _hull(ox, oy, oz, dx, dy, dz, planes, int(s[0]), int(s[1]))
    if kind == 6:
        t0, t1 = _ellipsoid(ox, oy, oz, dx, dy, dz, s, 1.0)
        if t1 <= 0.0 or t0 > t1 or t0 > limit:
            return math.inf, -math.inf
        core0, core1 = _ellipsoid(ox, oy, oz, dx, dy, dz, s, 0.66)
        if core0 > core1 or core1 <= 0.0:
            core0 = math.inf
        leaf = leaf_hit(ox, oy, oz, dx, dy, dz, s, seed, max(t0, 1e-6), min(t1, core0, limit))[0]
        hit = min(leaf, core0)
        return (hit, hit) if hit < math.inf else (math.inf, -math.inf)
    return math.inf, -math.inf


@compiled
def normal(kind: int, x: float, y: float, z: float, s: Float64, planes: Float64) -> Vector:
    """Return the outward unit normal, in the object's frame, at a point of a part's surface."""
    nx, ny, nz = 0.0, 0.0, 1.0
    if kind == 0:
        ax, ay, az = (x - s[0]) / s[3], (y - s[1]) / s[4], (z - s[2]) / s[5]
        # Slack in metres, not in half extents: the face is the one the point is closest to.
        gx = (1.0 - abs(ax)) * s[3]
        gy = (1.0 - abs(ay)) * s[4]
        gz = (1.0 - abs(az)) * s[5]
        if gx <= gy and gx <= gz:
            nx, nz = (1.0 if ax > 0 else -1.0), 0.0
        elif gy <= gz:
            ny, nz = (1.0 if ay > 0 else -1.0), 0.0
        else:
            nz = 1.0 if az > 0 else -1.0
    elif kind == 1 or kind == 6:
        nx, ny = (x - s[0]) / (s[3] * s[3]), (y - s[1]) / (s[4] * s[4])
        nz = (z - s[2]) / (s[5] * s[5])
    elif kind == 2:
        bx, by, bz = s[3] - s[0], s[4] - s[1], s[5] - s[2]
        bb = bx * bx + by * by + bz * bz
        share = ((x - s[0]) * bx + (y - s[1]) * by + (z - s[2]) * bz) / max(bb, 1e-12)
        share = min(max(share, 0.0), 1.0)
        nx, ny, nz = x - s[0] - share * bx, y - s[1] - share * by, z - s[2] - share * bz
    elif kind == 3:
        if s[4] - abs(y - s[1]) < s[3] - math.hypot(x - s[0], z - s[2]):
            ny, nz = (1.0 if y > s[1] else -1.0), 0.0
        else:
            nx, ny, nz = x - s[0], 0.0, z - s[2]
    elif kind == 4:
        nx, ny, nz = (0.0, 1.0, 0.0) if s[5] > 0.5 else (1.0, 0.0, 0.0)
    elif kind == 5:
        least = -math.inf
        for p in range(int(s[0]), int(s[0]) + int(s[1])):
            gap = planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z - planes[p, 3]
            if gap > least:
                least, nx, ny, nz = gap, planes[p, 0], planes[p, 1], planes[p, 2]
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length
