"""From one moment to the next particles move on, fade and turn; in the view none pops up.

Particles are followed over a tenth of a millisecond, in which they move by a millimetre, over
changing gusts, from a parked and from a moving car: every one in the view stands where its own
velocity has carried it, and its opacity has changed by no more than the fades allow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tiny_clip import TinyClip

from weather_aug.air import Air, air_of
from weather_aug.clip.types import Camera, FrameKey
from weather_aug.particles.resolve import FADE_SHARE, NEAR_FULL_M, NEAR_M
from weather_aug.render.fields import fields_of
from weather_aug.render.options import RenderOptions
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

Float64 = NDArray[np.float64]

STEP_S = 1e-4
BUDGET = 3000
SAME_M = 1e-3
"""Far less than particles are apart; more than the steps of the sine's table."""
FASTEST_REACH_PER_S = 1.0
"""Gusts lengthen streaks and so bring the reach nearer, but by no more than this share."""
SEED = 5
AXES = np.eye(3)


@dataclass(frozen=True)
class Moment:
    """Particles of a moment (N, 13), the camera that sees them, and the reach of each size."""

    particles: Float64
    camera: Camera
    reach_m: Float64

    def in_view(self, points: Float64) -> NDArray[np.bool_]:
        """Which of (N, 3) lie well inside the picture: none comes in over the edge in a step."""
        (fx, fy), (cx, cy) = self.camera.focal_px, self.camera.principal_px
        x = points[:, 0] / points[:, 2] * fx + cx
        y = points[:, 1] / points[:, 2] * fy + cy
        inside = (abs(x - cx) < 0.45 * self.camera.width) & (
            abs(y - cy) < 0.45 * self.camera.height
        )
        return np.asarray(inside)


def moment(
    weather: Weather | WeatherTimeline,
    time_s: float,
    speed_m_per_s: float,
    *,
    air: Callable[[Weather, float, int], Air] = air_of,
    seed: int = SEED,
) -> Moment:
    """What a camera sees that drives at a constant speed."""
    camera = TinyClip(width=960, height=720).camera(FrameKey(0, "front"))
    pose = camera.world_from_camera.copy()
    pose[0, 3] += speed_m_per_s * time_s
    velocity = np.array([speed_m_per_s, 0, 0])
    camera = replace(camera, world_from_camera=pose, velocity_m_per_s=velocity)
    if isinstance(weather, WeatherTimeline):
        now, blown = weather.at(time_s), weather.air(time_s, seed)
    else:
        now, blown = weather, air(weather, time_s, seed)
    (field,) = fields_of(now, seed, blown, AXES, RenderOptions(), None)
    resolved = field.resolve(camera, BUDGET)
    window = (0, 0, camera.height, camera.width)
    found = field.particles(camera, time_s, resolved, window).astype(np.float64)
    return Moment(found, camera, resolved.reach_m.astype(np.float64))


def pops(
    before: Moment, after: Moment, step_s: float = STEP_S, arriving: float = 0.0
) -> tuple[int, int]:
    """How many particles of `after` pop up, of how many in the view.

    A particle may be new, or brighter, by what it moves along the fade at its depth: 0.2 m long at
    the near limit, and a share of its reach (at least its depth) at the far end; by what the
    reach itself moved; and by `arriving` while the rate grows.
    """
    carried = before.particles[:, :3] + before.particles[:, 3:6] * step_s
    seen = after.particles[after.in_view(after.particles)]
    apart, index = cKDTree(carried).query(seen[:, :3])
    old = np.where(apart < SAME_M, before.particles[index, 12], 0.0)
    near_fade_m = NEAR_FULL_M - NEAR_M
    fade_m = np.where(seen[:, 2] < NEAR_FULL_M, near_fade_m, FADE_SHARE * seen[:, 2])
    drawn = before.reach_m > 0
    stretched = np.abs(after.reach_m[drawn] / before.reach_m[drawn] - 1).max()
    moved = min(stretched, FASTEST_REACH_PER_S * step_s) / FADE_SHARE
    # Opacities are float32, and a place is known to a step of the sine's table.
    allowed = 1.1 * np.abs(seen[:, 5]) * step_s / fade_m + moved + SAME_M / fade_m + arriving
    return int((np.abs(seen[:, 12] - old) > allowed).sum()), len(seen)


WEATHERS = {
    "rain": Weather.rain("heavy"),
    "snow": Weather.snow("heavy"),
    "wet snow": Weather.snow("moderate", snow_wetness=0.6),
    "gale": Weather.rain("moderate", wind_m_per_s=(-10, 8, 0), gustiness=0.6),
}


@pytest.mark.parametrize("speed_m_per_s", [0.0, 14.0])
@pytest.mark.parametrize("weather", WEATHERS.values(), ids=WEATHERS.keys())
def test_nothing_pops_up(weather: Weather, speed_m_per_s: float) -> None:
    for time_s in (0.0, 2.7, 600.0):
        before = moment(weather, time_s, speed_m_per_s)
        after = moment(weather, time_s + STEP_S, speed_m_per_s)
        popped, seen = pops(before, after)
        assert seen > 200
        assert popped == 0, (time_s, seen)


@pytest.mark.parametrize("weather", WEATHERS.values(), ids=WEATHERS.keys())
def test_nothing_pops_out(weather: Weather) -> None:
    """Backwards in time, what fades out fades in."""
    after, before = moment(weather, 2.7, 8.0), moment(weather, 2.7 + STEP_S, 8.0)
    reversed_time = replace(before, particles=before.particles * ([1] * 3 + [-1] * 3 + [1] * 7))
    popped, seen = pops(reversed_time, after)
    assert (popped, seen > 200) == (0, True)


def by_the_wind_now(weather: Weather, time_s: float, seed: int) -> Air:
    """Planted fault: drift as the wind of the moment times time."""
    air = air_of(weather, time_s, seed)
    along, left, up = air.wind_m_per_s
    return replace(air, drift_m=(along * time_s, left * time_s, up * time_s))


def test_particles_that_leap_with_the_gusts_would_be_seen() -> None:
    before = moment(WEATHERS["gale"], 600.0, 0.0, air=by_the_wind_now)
    after = moment(WEATHERS["gale"], 600.0 + STEP_S, 0.0, air=by_the_wind_now)
    popped, seen = pops(before, after)
    assert popped > 0.5 * seen


def test_a_draw_for_each_picture_would_be_seen() -> None:
    before = moment(WEATHERS["snow"], 2.7, 0.0)
    popped, seen = pops(before, moment(WEATHERS["snow"], 2.7 + STEP_S, 0.0, seed=SEED + 1))
    assert popped > 0.5 * seen


def test_particles_without_fades_would_be_seen() -> None:
    """From a moving car some come into reach in every step, even one so short."""
    popped = 0
    for k in range(20):
        before, after = (moment(WEATHERS["rain"], 1.0 + 0.05 * k + s, 14.0) for s in (0.0, STEP_S))
        for shot in (before, after):
            shot.particles[:, 12] = 1.0
        popped += pops(before, after)[0]
    assert popped > 0


@pytest.mark.parametrize("arriving", [0.05, 0.0])
def test_more_snow_lets_flakes_appear_gently(arriving: float) -> None:
    """From light to heavy snow in a minute: in 20 ms none gains more than a twentieth."""
    step_s = 0.02
    growing = WeatherTimeline.transition(Weather.snow("light"), Weather.snow("heavy"), 0, 60)
    popped = 0
    for time_s in np.arange(15.0, 35.0).tolist():
        shots = [moment(growing, t, 0.0) for t in (time_s, time_s + step_s)]
        popped += pops(*shots, step_s, arriving)[0]
    assert (popped == 0) == (arriving > 0)
