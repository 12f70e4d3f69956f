"""What a ray meets: label, normal, paint and the share of the sky that lights it (numba)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined
from weather_aug.clip.street_ground import ground_paint, is_planted
from weather_aug.clip.street_materials import paint
from weather_aug.clip.street_path import Curve, Section, centre_slope, centre_y
from weather_aug.clip.street_rays import World, cell_of
from weather_aug.clip.street_shapes import into_frame, leaf_hit, normal, out_of_frame
from weather_aug.clip.street_texture import mixed, noise, smooth, times

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Colour = tuple[float, float, float]
Vector = tuple[float, float, float]


class Looks(NamedTuple):
    """What the parts look like; rows as in `World`."""

    material: Int64
    label: Int64
    look: Float64


class Setting(NamedTuple):
    """The street without its parts."""

    curve: Curve
    section: Section
    tile: Float32
    """From `noise_tile`."""
    suns: Float64
    """(4, 3) unit vectors towards points of the sun's disc, one for each ray of a pixel, world."""


class Surface(NamedTuple):
    """A point of a surface."""

    label: int
    """Train id."""
    normal: Vector
    """Unit, world, towards the ray's start."""
    lit_normal: Vector
    """The normal that light sees: that of a rounder, leafier thing than the geometry is."""
    albedo: Colour
    mirror: float
    """Share of light that is mirrored, 0..1."""
    open_sky: float
    """Share of the sky's light that gets here, 0..1."""
    through: float
    """Share of sunlight that shines through, for leaves."""


@inlined
def _contact(world: World, x: float, y: float) -> float:
    """Return how much sky light the objects that stand nearby leave for the ground, 0..1."""
    cell = cell_of(world, x, y)
    left = 1.0
    if cell < 0:
        return left
    for k in range(world.start[cell], world.start[cell + 1]):
        i = world.item[k]
        if world.kind[i] != 7:
            continue
        u, v = into_frame(world.frame, i, x - world.frame[i, 0], y - world.frame[i, 1])
        s = world.shape[i]
        gap = math.hypot(max(abs(u - s[0]) - s[3], 0.0), max(abs(v - s[1]) - s[4], 0.0))
        left = min(left, 1.0 - s[5] * math.exp(-gap * 4.5) * smooth(0.9, 0.3, gap))
    return left


@inlined
def _footprint(size: float, cosine: float, along: float) -> float:
    """Return the length of a pixel on a surface along an axis that the ray follows by `along`."""
    slant = along / max(cosine, 0.03)
    return size * math.sqrt(1.0 + slant * slant)


@inlined
def ground_surface(
    world: World,
    setting: Setting,
    zone: int,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    size: float,
) -> Surface:
    """Return the ground at a point that a ray of unit direction (dx, dy, dz) meets.

    Args:
        world: All parts; those that stand nearby darken the ground.
        setting: The street.
        zone: From `ground_hit`.
        x: The point, world, metres.
        y: The same.
        z: The same.
        dx: Direction of the ray.
        dy: The same.
        dz: The same.
        size: Width of the pixel at the point, square to the ray, metres.
    """
    section = setting.section
    offset = y - centre_y(setting.curve, x)
    slope = centre_slope(setting.curve, x)
    n = (0.0, 0.0, 1.0)
    cosine, open_sky = -dz, 1.0
    if zone == 2:
        side = -1.0 if offset > 0.0 else 1.0
        scale = side / math.sqrt(1.0 + slope * slope)
        n = (-slope * scale, scale, 0.0)
        cosine = -(n[0] * dx + n[1] * dy)
        open_sky = 0.6
    fx, fd = _footprint(size, cosine, dx), _footprint(size, cosine, dy)
    albedo = ground_paint(setting.tile, section, zone, x, offset, z, fx, fd)
    label = 0 if zone == 1 else 1
    if zone == 3 and is_planted(section, x, offset):
        label = 9
    open_sky *= _contact(world, x, y)
    wall = section.facade_m - abs(offset)
    open_sky *= 0.62 + 0.38 * smooth(-1.0, 6.0, wall)
    return Surface(label, n, n, albedo, 0.0, open_sky, 0.0)


@compiled
def _leaf_shade(
    tile: Float32, look: Float64, q: Vector, outward: Vector, tint: float, core: bool, f: float
) -> tuple[Colour, float]:
    """Return albedo and open sky of a leaf at q in the tree's frame."""
    fade = smooth(0.5, 0.05, f)
    clump = noise(tile, q[0] + 0.7 * q[2], q[1] + 0.7 * q[2], 3.3, f)
    hue = 0.5 + 0.5 * clump + 0.55 * (tint - 0.5) * fade
    albedo = mixed((0.62, 0.80, 0.45), (1.25, 1.15, 0.85), min(max(hue, 0.0), 1.0))
    albedo = (albedo[0] * look[0], albedo[1] * look[1], albedo[2] * look[2])
    open_sky = 0.55 + 0.45 * outward[2]
    if core:
        speckle = noise(tile, q[0] + q[2], q[1] - q[2], 1.1, f)
        return times(albedo, 0.55 + 0.5 * speckle), open_sky * 0.55
    return albedo, open_sky


@compiled
def part_surface(
    world: World,
    looks: Looks,
    tile: Float32,
    i: int,
    x: float,
    y: float,
    z: float,
    o: Vector,
    d: Vector,
    t: float,
    size: float,
) -> Surface:
    """Return part `i` at the point (x, y, z) = o + t d, where a ray meets it.

    Args:
        world: All parts.
        looks: What they look like.
        tile: From `noise_tile`.
        i: Which part.
        x: The point, world, metres.
        y: The same.
        z: The same.
        o: Where the ray starts.
        d: Unit direction of the ray.
        t: Length of the ray, metres.
        size: Width of the pixel at the point, square to the ray, metres.
    """
    frame, s, look = world.frame, world.shape[i], looks.look[i]
    kind = world.kind[i]
    lx, ly = into_frame(frame, i, x - frame[i, 0], y - frame[i, 1])
    lz = z - frame[i, 2]
    ux, uy = into_frame(frame, i, d[0], d[1])
    nx, ny, nz = normal(kind, lx, ly, lz, s, world.planes)
    mirror, through, open_sky = 0.0, 0.0, 0.5 + 0.5 * smooth(0.0, 1.6, z)
    bx, by, bz = nx, ny, nz
    if kind == 6:
        px, py = into_frame(frame, i, o[0] - frame[i, 0], o[1] - frame[i, 1])
        pz = o[2] - frame[i, 2]
        found, mx, my, mz, tint = leaf_hit(
            px, py, pz, ux, uy, d[2], s, world.seed[i], t - 1e-5, t + 1e-5
        )
        core = found == math.inf
        fade = 0.0 if core else smooth(0.6, 0.05, size)
        albedo, leaf_sky = _leaf_shade(tile, look, (lx, ly, lz), (nx, ny, nz), tint, core, size)
        open_sky *= leaf_sky
        if not core:
            bx, by, bz = nx + fade * mx, ny + fade * my, nz + fade * mz
            nx, ny, nz = mx, my, mz
            through = 0.35
    else:
        cosine = -(nx * ux + ny * uy + nz * d[2])
        if kind == 4 and cosine < 0.0:
            nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
        bx, by, bz = nx, ny, nz
        fx = _footprint(size, cosine, ux)
        fy = _footprint(size, cosine, uy)
        fz = _footprint(size, cosine, d[2])
        r, g, b, mirror = paint(
            tile,
            looks.material[i],
            look,
            s,
            lx,
            ly,
            lz,
            nx,
            ny,
            nz,
            fx,
            fy,
            fz,
        )
        albedo = (r, g, b)
        if looks.material[i] == 7:
            # Sheet metal bulges: bend the light, not the geometry, and hide the facets.
            upright = smooth(0.75, 0.95, abs(nx) + abs(ny))
            bz = (1.0 - upright) * nz + 1.1 * upright * (lz - 0.60)
            bx += 0.10 * lx / look[3]
        elif looks.material[i] == 8:
            bx += 0.15 * lx
            by += 0.25 * ly
    scale = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
    gx, gy = out_of_frame(frame, i, nx, ny)
    hx, hy = out_of_frame(frame, i, bx * scale, by * scale)
    true, bent = (gx, gy, nz), (hx, hy, bz * scale)
    return Surface(looks.label[i], true, bent, albedo, mirror, open_sky, through)
