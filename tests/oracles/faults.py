"""Planted faults: what others do wrong, or we might, each in the place of the right thing."""

import numpy as np


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
