"""One window of a picture and all that is known about it, on its way through the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import Camera, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.surface import Surface, depth_of, repainted
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import DEPTH_BINS, FAR_M, shutter_turning_rad_per_s
from weather_aug.particles.shelter import Shelter
from weather_aug.render.fields import (
    RigMotion,
    published_grey,
    published_splats,
    resolved_of,
    splats_of,
)
from weather_aug.render.fog import fog_volume_of
from weather_aug.render.froxels import FogVolume, even_fog
from weather_aug.render.label import (
    HAZY_TRANSMITTANCE,
    LEAST_CONTRAST_LEVELS,
    least_linear_contrast,
)
from weather_aug.render.medium import SPRAY_HEIGHT_M, Medium, Optics, optical_depth
from weather_aug.render.options import RenderOptions
from weather_aug.render.project import BAND_ROWS, split_by_band
from weather_aug.render.scattering import scattered_background
from weather_aug.render.shade import shade
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


class Planes(NamedTuple):
    """What the kernels write about each pixel of a window."""

    image: UInt8
    """(H, W, 3) sRGB."""
    transmittance: Float32
    """(H, W) of air and particles."""
    distinct: UInt8
    """(H, W), 1 where what is left of the surface can be told from the airlight."""
    covered: UInt8
    """(H, W), 1 where a large particle hides the surface."""
    hazy_count: int
    """Surfaces so hazy that they must differ from the airlight to be seen, pixels."""


class _Air(NamedTuple):
    """What is between the camera and the surfaces."""

    medium: Medium
    carried: Float32
    """Optical depth of drawn particles by depth."""
    patches: FogVolume


@dataclass(frozen=True, eq=False)
class Stage:
    """A window of a picture, its camera, its weather and its light."""

    surface: Surface
    """With the weather's background in the window."""
    window: Window
    camera: Camera
    """Of the whole picture."""
    weather: Weather
    ambience: Ambience
    seed: int
    air: Air
    options: RenderOptions

    def shaded(
        self,
        fields: Sequence[ParticleField],
        shelter: Shelter | None,
        time_s: float,
        spray: Float32 | None = None,
    ) -> Planes:
        """The window with the weather's medium, its particles and the vehicles' spray (N, 13)."""
        weather = self.weather
        resolved, carried = resolved_of(fields, self.camera, self.options.max_particles)
        medium = medium_of(weather, fields, self.ambience)
        air = _Air(medium, carried, self._patches())
        splats = splats_of(
            self.camera,
            time_s,
            fields,
            resolved,
            self.ambience.under(weather.overcast),
            self._optics,
            medium,
            carried,
            self.window,
            shelter,
            spray,
        )
        surface = self._scattered(air) if self.options.multiple_scattering else self.surface
        return self._run(surface, air, splats)

    def published(self, rig: RigMotion, time_s: float) -> Planes:
        """The window with the particles of WeatherEdit's release, blended in sRGB."""
        splats = published_splats(
            self.camera,
            time_s,
            self.weather,
            self.seed,
            self.ambience.axes_world,
            self.options,
            rig,
            self._optics,
            self.window,
        )
        grey = published_grey(self.weather, self.options)
        return self._run(self.surface, self._clear_air, splats, grey)

    @cached_property
    def _optics(self) -> Optics:
        return optics_of(self.camera, self.ambience.axes_world[2])

    def _patches(self) -> FogVolume:
        axes = self.ambience.axes_world
        return fog_volume_of(self.weather, self.camera, self.window, self.seed, self.air, axes)

    @property
    def _clear_air(self) -> _Air:
        medium = medium_of(Weather(), (), self.ambience)
        return _Air(medium, np.zeros(DEPTH_BINS + 1, np.float32), even_fog())

    def _scattered(self, air: _Air) -> Surface:
        """The background with what lies behind thick air blurred."""
        depth = depth_of(self.surface, self.window)
        tau = optical_depth(depth, self.window, self._optics, *air)
        blurred = scattered_background(self._image(), tau, max(self.camera.focal_px))
        return repainted(self.surface, blurred, self.window)

    def _image(self) -> UInt8:
        """(H, W, 3) of the window."""
        top, left, rows, columns = self.surface.image_window
        y, x = self.window[0] - top, self.window[1] - left
        whole = self.surface.image.reshape(rows, columns, 3)
        return whole[y : y + self.window[2], x : x + self.window[3]]

    def _run(
        self, surface: Surface, air: _Air, splats: Float32, veil: float | None = None
    ) -> Planes:
        """Allocate what the kernel writes, and run it.

        Args:
            surface: The background.
            air: What is in front of it.
            splats: Particles.
            veil: Grey in sRGB that hides surfaces: colours are then blended in sRGB. Else it is
                the airlight that does, and light is linear.
        """
        _, _, height, width = self.window
        splats, band_starts = split_by_band(splats, self.window, -(-height // BAND_ROWS))
        if veil is None:
            linear, hiding = SRGB_LEVELS_LINEAR, self.ambience.airlight
            contrast = least_linear_contrast(hiding)
        else:
            linear, hiding = np.arange(256) / 255, np.full(3, veil)
            contrast = LEAST_CONTRAST_LEVELS / 255
        limits = (contrast, HAZY_TRANSMITTANCE)
        image = np.empty((height, width, 3), np.uint8)
        through = np.empty((height, width), np.float32)
        distinct = np.empty((height, width), np.uint8)
        covered = np.zeros((height, width), np.uint8)
        hazy_count = shade(
            surface,
            air.patches,
            self.window,
            self._optics,
            air.medium,
            air.carried,
            linear.astype(np.float32),
            veil is not None,
            hiding.astype(np.float32),
            splats,
            band_starts,
            tuple(np.float32(v) for v in limits),
            image,
            through,
            distinct,
            covered,
        )
        return Planes(image, through, distinct, covered, hazy_count)


def optics_of(camera: Camera, up_world: Float64) -> Optics:
    """What the kernels know of a camera."""
    up = camera.world_from_camera[:3, :3].T @ up_world
    values = (
        *camera.focal_px,
        *camera.principal_px,
        camera.exposure_s,
        camera.aperture_m,
        *shutter_turning_rad_per_s(camera),
        *up,
        camera.width * camera.height,
    )
    return Optics(*(np.float32(v) for v in values))


def medium_of(weather: Weather, fields: Sequence[ParticleField], ambience: Ambience) -> Medium:
    """What the kernels know of the air."""
    values = (
        weather.fog_per_m,
        1.0 / weather.fog_scale_height_m,
        weather.mist_per_km * 1e-3,
        sum(field.population.extinction_per_m for field in fields),
        FAR_M / DEPTH_BINS,
        weather.spray_per_km * 1e-3,
        ambience.camera_height_m / SPRAY_HEIGHT_M,
    )
    return Medium(*(np.float32(v) for v in values))
