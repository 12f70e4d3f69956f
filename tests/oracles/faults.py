"""Planted faults: what others do wrong, or we might, each in the place of the right thing."""

import numpy as np

from weather_aug.air import Air, air_of


def opacity_of_the_papers_fog(alpha, tau, z):
    """1 - exp(-beta d) for each Gaussian: what all the fog before it would take."""
    return 1 - np.exp(-tau * z / 10.0)


def _no_veil(veil):
    return lambda *args: 0.0


def _twice_the_efficiency(veil):
    """Q = 2 for what is not drawn, 1 for what is."""
    return lambda population, resolved, depth_m: 2 * veil(population, resolved, depth_m)


def _whole_veil(veil):
    """All particles in the veil, those that are drawn as well."""
    return lambda population, resolved, depth_m: population.extinction_per_m * depth_m


VEILS = {"none": _no_veil, "Q = 2": _twice_the_efficiency, "whole": _whole_veil}


def stock_dilation(project):
    """A splat that the pixel filter widens and nothing thins, as stock rasterisers draw it."""
    return lambda *args: project(*args[:-1], False)


def doubled(gunn_marshall):
    """The intercept that two published codes use: 7600 instead of 3800."""

    def wrong(rate_mm_per_h):
        slope, intercept = gunn_marshall(rate_mm_per_h)
        return slope, 2 * intercept

    return wrong


def melted(melted_mm, wetness=0.0):
    """Flakes as large as the drops they melt to."""
    return 1.0 * melted_mm


def extinction_of_the_endless_size_law(rate_mm_per_h):
    """1/m, of Gunn and Marshall's law to infinity."""
    slope, intercept = 2.55 * rate_mm_per_h**-0.48, 3800.0 * rate_mm_per_h**-0.87
    return np.pi / 4 * 1e-6 * 6 * intercept / slope**4 / 0.17


def extinction_of_flakes_up_to_15_mm(rate_mm_per_h):
    """1/m, of Gunn and Marshall's law up to 3.37 mm of melted water."""
    slope = 2.55 * rate_mm_per_h**-0.48
    x = 3.3693 * slope
    share = 1 - np.exp(-x) * (1 + x + x**2 / 2 + x**3 / 6)
    return extinction_of_the_endless_size_law(rate_mm_per_h) * share


def even_depths(particles, near_m, far_m):
    """Particles at depths drawn evenly, instead of evenly in the volume."""
    moved = particles.copy()
    share = (particles[:, 2] ** 3 - near_m**3) / (far_m**3 - near_m**3)
    moved[:, 2] = near_m + share * (far_m - near_m)
    return moved


def windless(records):
    """Particles that only fall."""
    still = records.copy()
    still[:, 3] = 0.0
    return still


def without_ego_motion(records):
    """Streaks as from a parked car: the ego speed of 15 m/s along the view taken back."""
    parked = records.copy()
    parked[:, 5] += 15.0
    return parked


def opacity_without_exposure(drawn):
    """Streaks as opaque as the still particle: their length costs nothing."""

    def wrong(records, camera, *args, **kwargs):
        still = records.copy()
        still[:, 3:6] = 0.0
        peak = drawn(still, camera)[0, 6]
        splats = drawn(records, camera, *args, **kwargs)
        splats[:, 6] = peak
        return splats

    return wrong


def recycled_points(time_s, x, yaw_deg, count=20_000, step_s=0.1, speed_m_per_s=3.0):
    """The paper's rule: what has left below starts again at the top, its overshoot forgotten."""
    low, high = np.array([4.0, -1.6, -0.1]), np.array([7.2, 1.6, 3.1])
    places = np.random.default_rng(1).uniform(low, high, (count, 3))
    for _ in range(round(time_s / step_s)):
        places[:, 2] -= speed_m_per_s * step_s
        places[places[:, 2] < low[2], 2] = high[2] - 1e-9
    return places


class FieldOfAStream:
    """Draws from one stream of random numbers, as numpy's global one: each call another field."""

    def __init__(self, make_field, seed):
        self.make_field, self.stream = make_field, np.random.default_rng(seed)

    def particles(self, camera, time_s, kind):
        return self.make_field(int(self.stream.integers(2**32))).particles(camera, time_s, kind)


class FieldOfSteps:
    """Moves on by a step with each frame that is asked for, whatever its time."""

    def __init__(self, make_field, seed):
        self.field, self.time_s = make_field(seed), 0.0

    def particles(self, camera, time_s, kind):
        found = self.field.particles(camera, self.time_s, kind)
        self.time_s += 0.1
        return found


class FieldOfEachCamera:
    """Seeds the field by the camera, so that each sees air of its own."""

    def __init__(self, make_field, seed):
        self.make_field, self.seed = make_field, seed

    def particles(self, camera, time_s, kind):
        own = abs(hash(camera.world_from_camera.tobytes())) % 2**32
        return self.make_field(self.seed + own).particles(camera, time_s, kind)


def wrapped(at, box_m=1.9):
    """Particles that are wrapped in a box which the camera looks into."""

    def wrong(weather, population, time_s):
        camera, records = at(weather, population, time_s)
        inside = records.copy()
        inside[:, 1] = np.mod(records[:, 1], box_m) - 0.5 * box_m
        return camera, inside

    return wrong


def air_of_wind_times_time(weather, time_s, seed):
    """The drift of a changing wind as its value of now times the time."""
    right = air_of(weather, time_s, seed)
    return Air(right.wind_m_per_s, tuple(time_s * v for v in right.wind_m_per_s), right.wet_s)


def pose_of_now(world_from_first, world_from_now):
    """T_t^-1 for T_0 T_t^-1: a field carried from the world's origin."""
    return np.linalg.inv(world_from_now)


def turned_about_the_origin(world_from_first, world_from_now):
    """The released code: R_t R_0^T about the world's origin, then C_t - C_0."""
    motion = np.eye(4)
    motion[:3, :3] = world_from_now[:3, :3] @ world_from_first[:3, :3].T
    motion[:3, 3] = world_from_now[:3, 3] - world_from_first[:3, 3]
    return np.linalg.inv(motion)
