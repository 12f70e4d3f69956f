"""The kernel that fills the pictures (numba)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.street_light import seen, sky
from weather_aug.clip.street_rays import World, first_part, ground_hit
from weather_aug.clip.street_surface import Looks, Setting, ground_surface, part_surface

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


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
    """(H, W, 3) sRGB."""
    label: UInt8
    """(H, W) train ids."""
    depth_m: Float32
    """(H, W) along the optical axis; inf for the sky."""
    normals_world: Float32
    """(H, W, 3); zero for the sky."""


@compiled
def _display(value: float) -> int:
    """Return the sRGB byte of a linear value, highlights rolled off above 0.7."""
    if value > 0.7:
        value = 0.7 + 0.3 * (1.0 - math.exp(-(value - 0.7) / 0.3))
    if value <= 0.0031308:
        encoded = 12.92 * max(value, 0.0)
    else:
        encoded = 1.055 * value ** (1.0 / 2.4) - 0.055
    return int(encoded * 255.0 + 0.5)


@compiled
def fill(world: World, looks: Looks, setting: Setting, rig: Rig, canvas: Canvas) -> None:
    """Fill a canvas: colour from four rays a pixel, everything else from the one at its centre."""
    height, width = canvas.label.shape
    cx, cy, cz = rig.centre[0], rig.centre[1], rig.centre[2]
    r = rig.rotation
    for row in range(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(4):
                # The centre and a triangle around it.
                du = 0.0 if k == 0 else (0.38 if k == 1 else (-0.10 if k == 2 else -0.33))
                dv = 0.0 if k == 0 else (0.12 if k == 1 else (-0.38 if k == 2 else 0.30))
                u = (column + du - rig.principal_px[0]) / rig.focal_px
                v = (row + dv - rig.principal_px[1]) / rig.focal_px
                # Its length along the optical axis is 1, so that t is the depth.
                dx = r[0, 0] * u + r[0, 1] * v + r[0, 2]
                dy = r[1, 0] * u + r[1, 1] * v + r[1, 2]
                dz = r[2, 0] * u + r[2, 1] * v + r[2, 2]
                limit, zone = ground_hit(setting.curve, setting.section, cx, cy, cz, dx, dy, dz)
                t, i = first_part(world, cx, cy, cz, dx, dy, dz, limit)
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                unit = (dx / length, dy / length, dz / length)
                distance = t * length
                label, n = 10, (0.0, 0.0, 0.0)
                if distance > 4000.0:
                    t = math.inf
                    colour = sky(setting.tile, setting.suns[k], unit[0], unit[1], unit[2])
                else:
                    x, y, z = cx + t * dx, cy + t * dy, cz + t * dz
                    # Four rays share the pixel.
                    size = 0.7 * distance / rig.focal_px
                    if i < 0:
                        surface = ground_surface(world, setting, zone, x, y, z, *unit, size)
                    else:
                        surface = part_surface(
                            world,
                            looks,
                            setting.tile,
                            i,
                            x,
                            y,
                            z,
                            (cx, cy, cz),
                            unit,
                            distance,
                            size,
                        )
                    label, n = surface.label, surface.normal
                    colour = seen(
                        world, setting.tile, setting.suns[k], surface, x, y, z, unit, distance
                    )
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
