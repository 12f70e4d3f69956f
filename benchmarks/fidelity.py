"""The kernels against the slow float64 reference renderer of the tests, on a small frame."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.overlays import RAIN, SNOW, air_only
from benchmarks.report import Row, show
from benchmarks.scene import AXES, street
from weather_aug.air import air_of
from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.particles.resolve import DEPTH_BINS, FAR_M
from weather_aug.render.compose import render
from weather_aug.render.fields import fields_of
from weather_aug.render.light import particle_colour
from weather_aug.weather import Weather

ORACLES = Path(__file__).parents[1] / "tests" / "oracles"
HEIGHT, WIDTH = 96, 192
OPTIONS = air_only(1_500)
"""The reference knows the air and its particles, and no effect besides."""
SEED = 1
WEATHERS = {"fog + rain": RAIN, "fog + snow": SNOW}


def measure() -> dict[str, Any]:
    """Print how far the picture is from the reference's."""
    oracle = _oracle()
    frame, ambience = street(HEIGHT, WIDTH, speed_m_per_s=10.0)
    rows = []
    for name, weather in WEATHERS.items():
        shot = render(frame, weather, seed=SEED, ambience=ambience, options=OPTIONS)
        expected, count = reference_image(oracle, frame, weather, ambience)
        error = np.round(expected) - shot.image
        psnr_db = 10 * np.log10(255**2 / np.mean(error**2))
        rows += [
            Row(f"{name} ({count} particles): PSNR", float(psnr_db), "dB", at_least=55),
            Row(f"{name}: largest error", float(np.abs(error).max()), "levels", at_most=4),
        ]
    return show(f"{HEIGHT} x {WIDTH}: kernels against the float64 reference renderer", rows)


def reference_image(
    oracle: ModuleType, frame: Frame, weather: Weather, ambience: Ambience
) -> tuple[Any, int]:
    """The reference's sRGB picture (H, W, 3) float64 of one falling kind, and its particles.

    Only where the particles are comes from the library, because that is random.
    """
    air = air_of(weather, frame.time_s, SEED)
    (field,) = fields_of(weather, SEED, air, ambience.axes_world, OPTIONS, None)
    resolved = field.resolve(frame.camera, OPTIONS.max_particles)
    window = (0, 0, HEIGHT, WIDTH)
    particles = field.particles(frame.camera, frame.time_s, resolved, window)

    def carried(z: Any) -> Any:
        bins = np.minimum(z / FAR_M * DEPTH_BINS, DEPTH_BINS)
        return resolved.optical_depth[bins.astype(int)]

    def through(z: Any, ray: Any) -> Any:
        depth = oracle.optical_depth(
            np.asarray(z, float),
            ray,
            AXES[2],
            weather.fog_per_m,
            1 / weather.fog_scale_height_m,
            weather.mist_per_km * 1e-3,
            field.population.extinction_per_m,
            carried,
        )
        return np.exp(-depth)

    own = particle_colour(field.population.kind, ambience)

    def colour_at(position: Any) -> Any:
        share = through(position[2], position[:2] / position[2])
        return share * own + (1 - share) * ambience.airlight

    share = through(frame.depth_m, oracle.rays(frame.camera))
    light = share[..., None] * oracle.linear(frame.image)
    light += (1 - share[..., None]) * ambience.airlight
    transmittance = share.copy()
    oracle.splat(
        light, transmittance, frame.depth_m, particles.astype(float), frame.camera, colour_at
    )
    return oracle.srgb(light), len(particles)


def _oracle() -> ModuleType:
    """The reference renderer; it lies with the tests, which are no package."""
    sys.path.insert(0, str(ORACLES))
    try:
        import reference_render
    finally:
        sys.path.remove(str(ORACLES))
    return reference_render


if __name__ == "__main__":
    measure()
