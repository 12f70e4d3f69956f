"""Sun, sky and shade, and the kernel that fills the pictures (numba).

Light is linear; 1 is what a white surface square to the sun sends back, without the sky.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.street_ground import ground_paint, is_planted
from weather_aug.clip.street_materials import paint
from weather_aug.clip.street_path import Curve, Section, centre_slope, centre_y
from weather_aug.clip.street_rays import World, cell_of, first_part, ground_hit
from weather_aug.clip.street_shapes import into_frame, leaf_hit, normal, out_of_frame
from weather_aug.clip.street_texture import mixed, noise, smooth, times

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Colour = tuple[float, float, float]
Vector = tuple[float, float, float]

SAMPLES = 4


class Surfaces(NamedTuple):
    """What the parts look like; rows as in `World`."""

    material: Int64
    label: Int64
    look: Float64


class Setting(NamedTuple):
    """The street without its parts."""

    curve: Curve
    section: Section
    tile: Float32
    suns: Float64
    """(4, 3) unit vectors towards points of the sun's disc, one for each ray of a pixel, world."""


class Rig(NamedTuple):
    """One camera: what turns a pixel into a ray."""

    rotation: Float64
    """(3, 3) world from camera."""
    centre: Float64
    """(3,) world, metres."""
    focal_px: float
    principal_px: Float64
    """(2,)"""


class Canvas(NamedTuple):
    """What the kernel fills."""

    image: UInt8
    label: UInt8
    depth_m: Float32
    normals_world: Float32


@numba.njit(cache=True, nogil=True)
def sky(tile: Float32, sun: Float64, x: float, y: float, z: float) -> Colour:
    """Return the light of the sky from a unit direction."""
    up = max(z, 0.0)
    blue = mixed((0.70, 0.82, 0.93), (0.16, 0.34, 0.74), 1.0 - math.exp(-2.6 * up))
    glow = max(x * sun[0] + y * sun[1] + z * sun[2], 0.0)
    blue = mixed(blue, (1.0, 0.97, 0.90), 0.25 * glow**6)
    # Clouds lie on a plane above; the offset keeps the horizon from shrinking them to nothing.
    u, v = x / (up + 0.16), y / (up + 0.16)
    cover = noise(tile, u, v, 7.0, 0.004) + 0.35 * noise(tile, u + 3.1, v, 2.1, 0.004)
    density = smooth(0.0, 0.50, cover)
    body = smooth(0.25, 1.0, cover)
    cloud = mixed((0.98, 0.98, 0.97), (0.66, 0.70, 0.76), body)
    return mixed(blue, cloud, density * (0.35 + 0.6 * smooth(0.0, 0.25, up)))


@numba.njit(cache=True, nogil=True)
def _mirrored(tile: Float32, sun: Float64, x: float, y: float, z: float) -> Colour:
    """Return what a mirror sees that looks along a unit direction: sky, houses or road."""
    above = sky(tile, sun, x, y, max(z, 0.05))
    azimuth = math.atan2(y, x)
    blocks = noise(tile, azimuth * 4.0, z * 3.0, 5.0, 0.02)
    houses = mixed((0.05, 0.05, 0.05), (0.27, 0.25, 0.22), 0.4 + 0.6 * blocks)
    low = mixed((0.09, 0.09, 0.09), houses, smooth(-0.25, 0.0, z))
    skyline = 0.30 + 0.22 * noise(tile, azimuth * 3.0, 0.5, 7.0, 0.02)
    return mixed(low, above, smooth(skyline - 0.04, skyline + 0.04, z))


@numba.njit(cache=True, nogil=True, forceinline=True)
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


@numba.njit(cache=True, nogil=True, forceinline=True)
def _footprint(size: float, cosine: float, along: float) -> float:
    """Return the length of a pixel on a surface along an axis that the ray follows by `along`."""
    slant = along / max(cosine, 0.03)
    return size * math.sqrt(1.0 + slant * slant)


@numba.njit(cache=True, nogil=True, forceinline=True)
def _ground_shade(
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
) -> tuple[int, Vector, Colour, float]:
    """Return label, normal, albedo and open share of the sky at a point of the ground."""
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
    return label, n, albedo, open_sky


@numba.njit(cache=True, nogil=True, forceinline=True)
def _lit(
    sun: Float64,
    albedo: Colour,
    n: Vector,
    visible: float,
    open_sky: float,
) -> Colour:
    facing = max(n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2], 0.0) * visible
    up = 0.5 + 0.5 * n[2]
    blue = (0.25 + 0.14 * up) * open_sky
    bounce = 0.11 * (1.0 - up) * (0.4 + 0.6 * open_sky)
    return (
        albedo[0] * (1.12 * facing + 0.86 * blue + 1.10 * bounce),
        albedo[1] * (1.05 * facing + 0.97 * blue + 1.00 * bounce),
        albedo[2] * (0.92 * facing + 1.16 * blue + 0.88 * bounce),
    )


@numba.njit(cache=True, nogil=True, forceinline=True)
def _sun_reaches(world: World, sun: Float64, x: float, y: float, z: float, n: Vector) -> float:
    if n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2] <= 0.0:
        return 0.0
    lift = 0.004
    found = first_part(
        world,
        x + n[0] * lift,
        y + n[1] * lift,
        z + n[2] * lift,
        sun[0],
        sun[1],
        sun[2],
        1e9,
        True,
    )[1]
    return 0.0 if found >= 0 else 1.0


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _part_shade(
    world: World,
    surfaces: Surfaces,
    setting: Setting,
    i: int,
    x: float,
    y: float,
    z: float,
    o: Vector,
    d: Vector,
    t: float,
    size: float,
) -> tuple[Vector, Vector, Colour, float, float, float]:
    """Return the true normal, the one to light, albedo, mirror, open sky, and light let through."""
    frame, s, look = world.frame, world.shape[i], surfaces.look[i]
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
        albedo, leaf_sky = _leaf_shade(
            setting.tile, look, (lx, ly, lz), (nx, ny, nz), tint, core, size
        )
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
            setting.tile,
            surfaces.material[i],
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
        if surfaces.material[i] == 7:
            # Sheet metal bulges: bend the light, not the geometry.
            bz += 0.9 * (lz - 0.62)
            bx += 0.10 * lx / look[3]
        elif surfaces.material[i] == 8:
            bx += 0.15 * lx
            by += 0.25 * ly
    scale = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
    gx, gy = out_of_frame(frame, i, nx, ny)
    hx, hy = out_of_frame(frame, i, bx * scale, by * scale)
    return (gx, gy, nz), (hx, hy, bz * scale), albedo, mirror, open_sky, through


@numba.njit(cache=True, nogil=True)
def shade(
    world: World,
    surfaces: Surfaces,
    setting: Setting,
    o: Vector,
    d: Vector,
    pixel: float,
    sun: Float64,
) -> tuple[int, float, Vector, Colour]:
    """Follow one ray: label, t (inf for the sky), normal (0 for the sky), linear colour.

    Args:
        world: All parts.
        surfaces: Their looks.
        setting: The ground and the light.
        o: Where the ray starts, world.
        d: Direction of any length, world.
        pixel: Width of the ray's pixel at unit distance.
        sun: (3,) towards the point of the sun's disc that this ray asks for shade.
    """
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    unit = (d[0] / length, d[1] / length, d[2] / length)
    limit, zone = ground_hit(setting.curve, setting.section, o[0], o[1], o[2], d[0], d[1], d[2])
    t, i = first_part(world, o[0], o[1], o[2], d[0], d[1], d[2], limit, False)
    if t * length > 4000.0:
        return 10, math.inf, (0.0, 0.0, 0.0), sky(setting.tile, sun, *unit)
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    size = t * length * pixel
    mirror, through = 0.0, 0.0
    if i < 0:
        z = max(z, 0.0) if zone == 2 else (0.0 if zone == 1 else setting.section.kerb_height_m)
        label, n, albedo, open_sky = _ground_shade(
            world, setting, zone, x, y, z, unit[0], unit[1], unit[2], size
        )
        bent = n
    else:
        label = surfaces.label[i]
        n, bent, albedo, mirror, open_sky, through = _part_shade(
            world, surfaces, setting, i, x, y, z, o, d, t, size
        )
    visible = 0.0
    facing = bent[0] * sun[0] + bent[1] * sun[1] + bent[2] * sun[2]
    if facing > 0.0 or through > 0.0:
        side = 1.0
        if through > 0.0 and (n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2] < 0.0):
            side = -1.0
        visible = _sun_reaches(world, sun, x, y, z, (side * n[0], side * n[1], side * n[2]))
    colour = _lit(sun, albedo, bent, visible, open_sky)
    if through > 0.0 and visible > 0.0:
        glow = through * visible
        colour = (
            colour[0] + glow * albedo[0],
            colour[1] + glow * albedo[1],
            colour[2] + glow * albedo[2] * 0.6,
        )
    if mirror > 0.0:
        cosine = bent[0] * unit[0] + bent[1] * unit[1] + bent[2] * unit[2]
        grazing = max(1.0 + cosine, 0.0) ** 4
        share = min(mirror + (0.75 * mirror + 0.05) * grazing, 0.9)
        seen = _mirrored(
            setting.tile,
            sun,
            unit[0] - 2.0 * cosine * bent[0],
            unit[1] - 2.0 * cosine * bent[1],
            unit[2] - 2.0 * cosine * bent[2],
        )
        colour = mixed(colour, seen, share)
    haze = 1.0 - math.exp(-t * length / 1400.0)
    return label, t, n, mixed(colour, (0.66, 0.76, 0.86), haze)


@numba.njit(cache=True, nogil=True)
def _display(value: float) -> int:
    """Return the sRGB byte of a linear value, highlights rolled off above 0.7."""
    if value > 0.7:
        value = 0.7 + 0.3 * (1.0 - math.exp(-(value - 0.7) / 0.3))
    if value <= 0.0031308:
        encoded = 12.92 * max(value, 0.0)
    else:
        encoded = 1.055 * value ** (1.0 / 2.4) - 0.055
    return int(encoded * 255.0 + 0.5)


@numba.njit(cache=True, nogil=True)
def fill(world: World, surfaces: Surfaces, setting: Setting, rig: Rig, canvas: Canvas) -> None:
    """Fill a canvas: colour from four rays a pixel, everything else from the one at its centre."""
    height, width = canvas.label.shape
    o = (rig.centre[0], rig.centre[1], rig.centre[2])
    r = rig.rotation
    pixel = 0.7 / rig.focal_px
    for row in range(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(4):
                # The centre and a triangle around it.
                du = 0.0 if k == 0 else (0.38 if k == 1 else (-0.10 if k == 2 else -0.33))
                dv = 0.0 if k == 0 else (0.12 if k == 1 else (-0.38 if k == 2 else 0.30))
                u = (column + du - rig.principal_px[0]) / rig.focal_px
                v = (row + dv - rig.principal_px[1]) / rig.focal_px
                d = (
                    r[0, 0] * u + r[0, 1] * v + r[0, 2],
                    r[1, 0] * u + r[1, 1] * v + r[1, 2],
                    r[2, 0] * u + r[2, 1] * v + r[2, 2],
                )
                label, t, n, colour = shade(world, surfaces, setting, o, d, pixel, setting.suns[k])
                red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
                if k == 0:
                    canvas.label[row, column] = label
                    canvas.depth_m[row, column] = t
                    canvas.normals_world[row, column, 0] = n[0]
                    canvas.normals_world[row, column, 1] = n[1]
                    canvas.normals_world[row, column, 2] = n[2]
            canvas.image[row, column, 0] = _display(0.25 * red)
            canvas.image[row, column, 1] = _display(0.25 * green)
            canvas.image[row, column, 2] = _display(0.25 * blue)
