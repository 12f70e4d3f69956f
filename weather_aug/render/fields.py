"""Which particles a weather has, and how they look on a picture: splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import Camera, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.particles import statistics
from weather_aug.particles.field import ParticleField
from weather_aug.particles.published import PublishedField, field_from_world
from weather_aug.particles.published_presets import published_preset
from weather_aug.particles.resolve import DEPTH_BINS, Resolved
from weather_aug.particles.shelter import Shelter, exposed
from weather_aug.render.light import particle_colour
from weather_aug.render.medium import Medium, Optics
from weather_aug.render.options import RenderOptions
from weather_aug.render.project import project, sorted_in_blocks
from weather_aug.render.spray import spray_colour
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

EWA_LIMIT = 1.3
"""A classic splat's shape is computed no farther outside the picture than this, as in 3DGS."""


@dataclass(frozen=True, eq=False)
class RigMotion:
    """How the rig's reference camera stood at time 0 and stands now; (4, 4) each, metres."""

    world_from_first: Float64
    world_from_now: Float64

    @property
    def field_from_world(self) -> Float64:
        """(4, 4) inverse of the paper's Delta T = T_t T_0^-1."""
        return field_from_world(self.world_from_first, self.world_from_now)


def falling(weather: Weather, rain_fall_speed: str = "brandes") -> list[statistics.Population]:
    """What of the weather falls."""
    found = []
    if weather.rain_mm_per_h > statistics.TRACE_MM_PER_H:
        found.append(statistics.rain(weather.rain_mm_per_h, fall_speed=rain_fall_speed))
    if weather.snow_mm_per_h > statistics.TRACE_MM_PER_H:
        found.append(statistics.snow(weather.snow_mm_per_h, wetness=weather.snow_wetness))
    return found


def fields_of(
    weather: Weather,
    seed: int,
    air: Air,
    axes_world: Float64,
    options: RenderOptions,
    rig: RigMotion | None,
) -> list[ParticleField]:
    """The particle fields of a weather at one moment."""
    motion = None
    if rig is not None and options.alignment == "camera":
        motion = rig.field_from_world
    return [
        ParticleField(population, seed, air, axes_world, motion)
        for population in falling(weather, options.rain_fall_speed)
    ]


def resolved_of(
    fields: Sequence[ParticleField], camera: Camera, max_particles: int
) -> tuple[list[Resolved], Float32]:
    """What the camera resolves of each field, and the optical depth that all of it carries.

    Args:
        fields: Of one moment; they share the budget evenly.
        camera: Of the whole picture.
        max_particles: Expected number of drawn particles of all fields together at the most.

    Returns:
        One `Resolved` per field, and (DEPTH_BINS + 1,) the sum of their optical depths.
    """
    budget = max_particles // max(len(fields), 1)
    resolved = [field.resolve(camera, budget) for field in fields]
    carried = np.zeros(DEPTH_BINS + 1, np.float32)
    for part in resolved:
        carried = carried + part.optical_depth
    return resolved, carried


def splats_of(
    camera: Camera,
    time_s: float,
    fields: Sequence[ParticleField],
    resolved: Sequence[Resolved],
    light: Ambience,
    optics: Optics,
    medium: Medium,
    carried: Float32,
    window: Window,
    shelter: Shelter | None,
    spray: Float32 | None = None,
) -> Float32:
    """Splats (M, 16) of all fields and of spray that touch the window, far to near.

    Args:
        camera: Of the whole picture.
        time_s: Seconds since the clip's start.
        fields: Of one moment.
        resolved: What the camera resolves of each.
        light: Under the weather's sky.
        optics: Camera.
        medium: Air in front of the particles.
        carried: Optical depth of drawn particles by depth.
        window: (top, left, height, width).
        shelter: Bridges and roofs.
        spray: (N, 13) particles that vehicles raise.
    """
    clouds = [
        exposed(
            field.particles(camera, time_s, part, window),
            camera,
            field.air.wind_m_per_s,
            shelter,
        )
        for field, part in zip(fields, resolved, strict=True)
    ]
    colours = [particle_colour(field.population.kind, light) for field in fields]
    if spray is not None and len(spray):
        clouds.append(spray)
        colours.append(spray_colour(light))
    return _projected(clouds, colours, optics, medium, carried, light.airlight, window, True)


def published_kinds(weather: Weather) -> list[str]:
    """Which of the release's presets stand for a weather."""
    rates = {
        "rain": weather.rain_mm_per_h,
        "snow": weather.snow_mm_per_h,
        "fog": weather.fog_per_m,
    }
    return [kind for kind, rate in rates.items() if rate > 0]


def published_grey(weather: Weather, options: RenderOptions) -> float:
    """Mean grey of the release's particles for a weather, sRGB in [0, 1]."""
    presets = [published_preset(_dataset(options), kind) for kind in published_kinds(weather)]
    return float(np.mean([preset.grey_srgb for preset in presets])) if presets else 1.0


def _dataset(options: RenderOptions) -> str:
    return "nuscenes" if options.preset.endswith("nuscenes") else "waymo"


def published_splats(
    camera: Camera,
    time_s: float,
    weather: Weather,
    seed: int,
    axes_world: Float64,
    options: RenderOptions,
    rig: RigMotion,
    optics: Optics,
    window: Window,
) -> Float32:
    """Splats (M, 16) of WeatherEdit's release; colours are its greys, in sRGB."""
    fields = [
        PublishedField(
            published_preset(_dataset(options), kind),
            seed,
            rig.world_from_first[:3, 3],
            axes_world,
            None if options.ablation == "alignment" else rig.field_from_world,
            dynamics="none" if options.ablation == "dynamics" else "recycled",
            attributes=options.ablation != "attributes",
        )
        for kind in published_kinds(weather)
    ]
    clouds = [field.particles(camera, time_s, window) for field in fields]
    greys = [np.full(3, field.grey_srgb) for field in fields]
    still, clear = still_optics(optics, camera), Medium(*(np.float32(0.0),) * 7)
    clear = clear._replace(resolved_step_m=np.float32(1.0))
    nothing = np.zeros(2, np.float32)
    return _projected(clouds, greys, still, clear, nothing, np.zeros(3), window, False)


def still_optics(optics: Optics, camera: Camera) -> Optics:
    """The camera as a classic splat rasteriser knows it: no shutter, no lens, shapes kept sane."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    zero = np.float32(0.0)
    return optics._replace(
        exposure_s=zero,
        aperture_m=zero,
        limit_x=np.float32(EWA_LIMIT * max(cx, camera.width - cx) / fx),
        limit_y=np.float32(EWA_LIMIT * max(cy, camera.height - cy) / fy),
    )


def _projected(
    clouds: Sequence[Float32],
    colours: Sequence[Float64],
    optics: Optics,
    medium: Medium,
    carried: Float32,
    airlight: Float64,
    window: Window,
    compensate: bool,
) -> Float32:
    if not any(len(cloud) for cloud in clouds):
        return np.empty((0, 16), np.float32)
    particles = np.concatenate(clouds) if len(clouds) > 1 else clouds[0]
    blocks, kinds = sorted_in_blocks(particles, np.cumsum([len(cloud) for cloud in clouds]))
    splats: Float32 = project(
        blocks,
        kinds,
        np.array(colours, np.float32),
        optics,
        medium,
        carried,
        airlight.astype(np.float32),
        window,
        compensate,
    )
    return splats
