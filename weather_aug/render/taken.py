"""The picture as a camera takes it: through wet glass, with glare and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Frame, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.physical.layers import Layers
from weather_aug.particles.field import ParticleField
from weather_aug.render.background import background_of, shrunk
from weather_aug.render.lens import Glass, through_glass
from weather_aug.render.options import RenderOptions
from weather_aug.render.sensor import block_window, exposed, exposure_s_in, glare_share
from weather_aug.render.stage import Stage
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

LENS_EFFECTS = ("drops", "wipers", "lens_veil")
SENSOR_EFFECTS = ("noise", "glare", "compression")


class Taken(NamedTuple):
    """A window of the picture that the camera delivers."""

    image: UInt8
    """(H, W, 3) sRGB."""
    glass: Glass | None
    """What the glass hides; None where it is clean."""


def camera_in(camera: Camera, weather: Weather, options: RenderOptions) -> Camera:
    """The camera with the exposure that it chooses in this light."""
    if not options.has("exposure"):
        return camera
    return replace(camera, exposure_s=exposure_s_in(camera.exposure_s, weather))


def window_taken(window: Window, camera: Camera, options: RenderOptions) -> Window:
    """What must be rendered so that `window` can be compressed as a part of the whole picture."""
    return block_window(window, camera) if options.has("compression") else window


def sees_whole(weather: Weather, options: RenderOptions) -> bool:
    """Whether glass or lens bring light from elsewhere in the picture."""
    return _is_wet(weather, options) or (options.has("glare") and glare_share(weather) > 0)


def _is_wet(weather: Weather, options: RenderOptions) -> bool:
    drawn = any(options.has(name) for name in LENS_EFFECTS)
    return drawn and (weather.lens_drops > 0 or weather.wipers > 0)


def taken(
    image: UInt8,
    frame: Frame,
    stage: Stage,
    fields: Sequence[ParticleField],
    layers: Layers | None,
) -> Taken:
    """What the glass, the lens and the sensor make of a window.

    Args:
        image: (H, W, 3) sRGB of the stage's window, as light meets the glass.
        frame: The recorded frame.
        stage: That rendered the window.
        fields: Particles of the weather.
        layers: Of the frame; may be None unless `sees_whole`.
    """
    weather, options = stage.weather, stage.options
    lens = [options.has(name) for name in LENS_EFFECTS]
    sensor = [options.has(name) for name in SENSOR_EFFECTS]
    whole = None
    if layers is not None and sees_whole(weather, options):
        whole = _whole(frame, stage, fields, layers)
    glass = None
    if whole is not None and _is_wet(weather, options):
        glass = through_glass(
            image,
            whole,
            window=stage.window,
            camera=frame.camera,
            weather=weather,
            seed=stage.seed,
            time_s=frame.time_s,
            glass=frame.key.camera,
            drops=lens[0],
            wipers=lens[1],
            veil=lens[2],
        )
        image = glass.image
    if any(sensor):
        image = exposed(
            image,
            whole,
            window=stage.window,
            camera=frame.camera,
            weather=weather,
            seed=stage.seed,
            frame_key=frame.key,
            noise=sensor[0],
            glare=sensor[1],
            compression=sensor[2],
        )
    return Taken(image, glass)


def _whole(frame: Frame, stage: Stage, fields: Sequence[ParticleField], layers: Layers) -> Float32:
    """(h, w, 3) linear light of the whole picture, shrunk, with all particles as a veil."""
    small, small_layers = shrunk(frame, layers)
    window = (0, 0, *small.image.shape[:2])
    options = replace(stage.options, max_particles=0, multiple_scattering=False)
    surface = background_of(small, stage.weather, stage.ambience, window, small_layers, options)
    small_stage = replace(
        stage, surface=surface, window=window, camera=small.camera, options=options
    )
    image = small_stage.shaded(fields, None, frame.time_s).image
    return cv2.LUT(image, SRGB_LEVELS_LINEAR.astype(np.float32))
