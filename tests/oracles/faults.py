"""Planted faults: what others do wrong, or we might, each in the place of the right thing."""

import zlib

import numpy as np
from oracles import reference_render as reference

from weather_aug.air import Air, air_of
from weather_aug.weather import Weather


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
        own = zlib.crc32(camera.world_from_camera.tobytes())
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


def seed_of_severity(severity):
    """Another draw for each severity."""
    return int(1e6 * severity)


def dipping(weather_of):
    """A scale with a dip of a hundredth between moderate and heavy."""
    return lambda kind, s: weather_of(kind, s - 0.015 * (0.6 < s < 0.62))


def grey(level_srgb):
    """(3,) linear light of a fixed sRGB grey, in [0, 1]."""
    return np.full(3, float(reference.linear(255 * level_srgb)))


def _in_gamma(draw):
    """Fog blended as the picture is stored, in sRGB."""

    def wrong(frame, weather, ambience):
        camera = frame.camera
        slant = np.sqrt(1 + (reference.rays(camera) ** 2).sum(-1))
        through = np.exp(-weather.fog_per_m * frame.depth_m * slant)[..., None]
        veil = reference.srgb(ambience.airlight)
        return reference.linear(through * frame.image + (1 - through) * veil)

    return wrong


def _quadratic(draw):
    """The paper's fog: each Gaussian 1 - exp(-beta d) opaque, so that depth counts twice."""

    def wrong(frame, weather, ambience):
        camera = frame.camera
        slant = np.sqrt(1 + (reference.rays(camera) ** 2).sum(-1))
        path = frame.depth_m * slant
        tau = weather.fog_per_m * path**2 / 40.0
        through = np.exp(-tau)[..., None]
        light = reference.linear(frame.image)
        return through * light + (1 - through) * ambience.airlight

    return wrong


def _two_percent(draw):
    """The visibility of Koschmieder's 2 % for that of 5 %."""

    def wrong(frame, weather, ambience):
        other = weather.visibility_m * np.log(0.05) / np.log(0.02)
        return draw(frame, Weather(visibility_m=other), ambience)

    return wrong


FOGS = {"in gamma": _in_gamma, "quadratic": _quadratic, "two percent": _two_percent}


def _even(form):
    """Fog without a top."""
    return lambda ray, depth_m, up, fog, height: form(ray, depth_m, up, fog, 1e12)


def _density_of_the_surface(form):
    """The fog where the surface is, along the whole ray."""

    def wrong(ray, depth_m, up, fog, height):
        rise = depth_m * (ray @ up[:2] + up[2])
        return form(ray, depth_m, up, fog * np.exp(-rise / height), 1e12)

    return wrong


def _by_depth(form):
    """Depth for range."""
    return lambda ray, *args: form(ray, *args) / np.sqrt(1 + ray @ ray)


LAYERS = {"even": _even, "surface": _density_of_the_surface, "by depth": _by_depth}


def without_slant(kernel):
    """Depth for range, in the kernel's place."""

    def wrong(camera, *args):
        return kernel(camera, *args) / np.sqrt(1 + (reference.rays(camera) ** 2).sum(-1))

    return wrong


def sky_at_80_m(camera, weather, ambience):
    """The paper's fog ends with its box; behind it the sky is clear."""
    return np.full((camera.height, camera.width), np.exp(-weather.fog_per_m * 80.0))
