"""The physical editor: a window of a frame under the weather's sky, wet or snowed on."""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Frame, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.dress import Geometry, dress
from weather_aug.edit.physical.layer_rows import MOST_ROOT, TABLE_STEPS
from weather_aug.edit.physical.layers import Layers
from weather_aug.edit.physical.look import Look, look_of
from weather_aug.edit.physical.materials import material_table
from weather_aug.edit.physical.noise import PERIOD_M, noise_tile
from weather_aug.edit.physical.overcast import tone
from weather_aug.edit.surface import shared, surface_of
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


def edited(
    frame: Frame,
    layers: Layers,
    weather: Weather,
    ambience: Ambience,
    window: Window,
    without: Collection[str] = (),
) -> UInt8:
    """Background of a window in the weather: a pure function of its arguments.

    The same place of the street is wet, puddled or white in every picture of it, whichever camera
    took it and when, because noise is anchored to the world.

    Args:
        frame: Picture with depth; its label says what holds water and snow.
        layers: Of the same frame.
        weather: State of air and ground; what is in the air is not drawn here.
        ambience: Light and axes of the scene.
        window: (top, left, height, width); its pixels equal the same pixels of the whole.
        without: Effects that are left out, of relight, sky, film, mirror, puddles, ripples,
            snow_cover and tracks.

    Returns:
        (H, W, 3) sRGB.
    """
    look = look_of(weather, ambience, layers.illumination, frame.time_s, without)
    overcast = 0.0 if "relight" in without else weather.overcast
    return dressed(frame, layers, ambience, window, look, overcast)


def dressed(
    frame: Frame,
    layers: Layers,
    ambience: Ambience,
    window: Window,
    look: Look,
    overcast: float,
) -> UInt8:
    """Background of a window in a look; see `edited`.

    Args:
        frame: Picture with depth.
        layers: Of the same frame.
        ambience: Light and axes of the scene.
        window: (top, left, height, width).
        look: A weather, in the kernels' numbers.
        overcast: In 0..1, that the tone follows.

    Returns:
        (H, W, 3) sRGB.
    """
    labelled = frame.label is not None
    out = np.empty((*window[2:], 3), np.uint8)
    dress(
        surface_of(frame),
        shared(layers.classes).reshape(-1),
        window,
        geometry_of(frame.camera, ambience.axes_world, layers.plane, labelled=labelled),
        look,
        shared(layers.tint),
        tone_tables(overcast),
        material_table(labelled=labelled),
        shared(layers.maps.view(np.uint16)),
        np.float32(layers.step),
        noise_tile(),
        out,
    )
    return out


def geometry_of(camera: Camera, axes_world: Float64, plane: Float64, *, labelled: bool) -> Geometry:
    """What the kernels know of a camera over the road's plane; see `Site.plane`."""
    rays = axes_world @ camera.world_from_camera[:3, :3]
    origin = axes_world @ camera.centre_world
    climb = np.array([-plane[1], -plane[2], 1.0]) @ rays
    height_m = origin[2] - plane[0] - plane[1:] @ origin[:2]
    places = np.mod(origin[:2], PERIOD_M)
    values = (
        *(*camera.focal_px, *camera.principal_px, *rays[0], *rays[1]),
        *(*climb, *places, height_m, float(labelled)),
    )
    return Geometry(*(np.float32(value) for value in values))


@lru_cache(maxsize=64)
def tone_tables(overcast: float) -> tuple[Float32, Float32, Float32]:
    """Toned light by sRGB level (256,) and by square root of light (N,), and the matrix."""
    curve, matrix = tone(overcast)
    light = np.linspace(0.0, MOST_ROOT, MOST_ROOT * TABLE_STEPS + 1) ** 2
    # The tone is a power of light, so that its last two levels say how it goes on.
    power = np.log(curve[-1] / curve[-2]) / np.log(SRGB_LEVELS_LINEAR[-1] / SRGB_LEVELS_LINEAR[-2])
    inside = np.interp(light, SRGB_LEVELS_LINEAR, curve)
    by_root = np.where(light > 1.0, curve[-1] * light**power, inside)
    tables = curve.astype(np.float32), by_root.astype(np.float32), matrix.astype(np.float32)
    for table in tables:
        table.flags.writeable = False
    return tables
