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
