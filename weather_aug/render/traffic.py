"""Other vehicles in bad weather: the spray they raise and the lamps they drive with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import Frame, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.vehicles import Vehicle, vehicles_of
from weather_aug.particles.field import ParticleField
from weather_aug.render.lamp_light import add_lamps
from weather_aug.render.lamps import lamps_of, seen_lamps
from weather_aug.render.options import RenderOptions
from weather_aug.render.spray import spray_particles
from weather_aug.taxonomy import GROUND
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Traffic:
    """The vehicles of a frame, as far as the weather makes them shine or splash."""

    frame: Frame
    weather: Weather
    ambience: Ambience
    seed: int
    vehicles: tuple[Vehicle, ...]
    splashes: bool
    shines: bool

    def spray(self, air: Air) -> Float32 | None:
        """(N, 13) particles of spray, as `render.project` takes them; None if there is none."""
        if not self.splashes:
            return None
        return spray_particles(
            self.vehicles,
            self.frame.camera,
            self.frame.time_s,
            wetness=self.weather.wetness,
            air=air,
            axes_world=self.ambience.axes_world,
            seed=self.seed,
        )

    def lit(self, image: UInt8, window: Window, fields: Sequence[ParticleField]) -> UInt8:
        """A window's picture (H, W, 3) with the lamps that are seen through the air."""
        if not self.shines:
            return image
        weather, frame = self.weather, self.frame
        assert frame.depth_m is not None
        falling = sum(field.population.extinction_per_m for field in fields)
        seen = seen_lamps(
            lamps_of(self.vehicles, weather.lamps, self.seed, self.ambience.axes_world[2]),
            frame.camera,
            frame.depth_m,
            extinction_per_m=weather.fog_per_m + weather.mist_per_km * 1e-3 + falling,
            wetness=weather.wetness,
            airlight=self.ambience.airlight,
            camera_height_m=self.ambience.camera_height_m,
        )
        if not seen:
            return image
        return add_lamps(image, seen, window=window, ground=_ground(frame, window))


def traffic_of(
    frame: Frame, weather: Weather, ambience: Ambience, seed: int, options: RenderOptions
) -> Traffic:
    """Look for vehicles, if the weather makes anything of them."""
    splashes = options.has("spray") and weather.wetness > 0
    shines = options.has("lamps") and weather.lamps > 0
    vehicles: tuple[Vehicle, ...] = ()
    if splashes or shines:
        axes_world, height_m = ambience.axes_world, ambience.camera_height_m
        vehicles = vehicles_of(frame, frame.label, axes_world, height_m)
    found = bool(vehicles)
    return Traffic(frame, weather, ambience, seed, vehicles, splashes and found, shines and found)


def _ground(frame: Frame, window: Window) -> NDArray[np.bool_] | None:
    """Where a window shows ground, (H, W); None where nobody labelled."""
    if frame.label is None:
        return None
    top, left, height, width = window
    is_ground = np.zeros(256, bool)
    is_ground[list(GROUND)] = True
    return is_ground[frame.label[top : top + height, left : left + width]]
