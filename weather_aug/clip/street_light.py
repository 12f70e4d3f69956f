"""Sun, sky and shade: the light that a surface sends to the eye (numba).

Light is linear; 1 is about what a white surface square to the sun sends back, without the sky.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined
from weather_aug.clip.street_rays import World, first_part
from weather_aug.clip.street_surface import Surface
from weather_aug.clip.street_texture import mixed, noise, smooth

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Colour = tuple[float, float, float]
Vector = tuple[float, float, float]


@compiled
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


@compiled
def _mirrored(tile: Float32, sun: Float64, x: float, y: float, z: float) -> Colour:
    """Return what a mirror sees that looks along a unit direction: sky, houses or road."""
    above = sky(tile, sun, x, y, max(z, 0.05))
    azimuth = math.atan2(y, x)
    blocks = noise(tile, azimuth * 4.0, z * 3.0, 5.0, 0.02)
    houses = mixed((0.05, 0.05, 0.05), (0.27, 0.25, 0.22), 0.4 + 0.6 * blocks)
    low = mixed((0.09, 0.09, 0.09), houses, smooth(-0.25, 0.0, z))
    skyline = 0.30 + 0.22 * noise(tile, azimuth * 3.0, 0.5, 7.0, 0.02)
    return mixed(low, above, smooth(skyline - 0.04, skyline + 0.04, z))


@inlined
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


@inlined
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
        -1.0,
    )[1]
    return 0.0 if found >= 0 else 1.0


@compiled
def seen(
    world: World,
    tile: Float32,
    sun: Float64,
    surface: Surface,
    x: float,
    y: float,
    z: float,
    unit: Vector,
    distance_m: float,
) -> Colour:
    """Return the linear colour of a surface point at (x, y, z).

    Args:
        world: All parts, for their shade.
        tile: From `noise_tile`.
        sun: (3,) unit vector towards the point of the sun's disc that is asked for shade.
        surface: The point.
        x: Where it is, world, metres.
        y: The same.
        z: The same.
        unit: Direction from the eye to the point.
        distance_m: From the eye.
    """
    n, bent, albedo = surface.normal, surface.lit_normal, surface.albedo
    visible = 0.0
    facing = bent[0] * sun[0] + bent[1] * sun[1] + bent[2] * sun[2]
    if facing > 0.0 or surface.through > 0.0:
        side = 1.0
        if surface.through > 0.0 and n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2] < 0.0:
            side = -1.0
        visible = _sun_reaches(world, sun, x, y, z, (side * n[0], side * n[1], side * n[2]))
    colour = _lit(sun, albedo, bent, visible, surface.open_sky)
    glow = surface.through * visible
    colour = (
        colour[0] + glow * albedo[0],
        colour[1] + glow * albedo[1],
        colour[2] + glow * albedo[2] * 0.6,
    )
    if surface.mirror > 0.0:
        cosine = bent[0] * unit[0] + bent[1] * unit[1] + bent[2] * unit[2]
        grazing = max(1.0 + cosine, 0.0) ** 4
        share = min(surface.mirror + (0.75 * surface.mirror + 0.05) * grazing, 0.9)
        image = _mirrored(
            tile,
            sun,
            unit[0] - 2.0 * cosine * bent[0],
            unit[1] - 2.0 * cosine * bent[1],
            unit[2] - 2.0 * cosine * bent[2],
        )
        colour = mixed(colour, image, share)
    haze = 1.0 - math.exp(-distance_m / 1400.0)
    return mixed(colour, (0.66, 0.76, 0.86), haze)
