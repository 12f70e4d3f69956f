import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from weather_aug.errors import ArgumentError
from weather_aug.particles import statistics

RATES = (0.25, 1.0, 5.0, 25.0, 100.0)


@pytest.mark.parametrize("rate", RATES)
def test_rain_extinction_follows_the_marshall_palmer_power_law(rate):
    """0.182 R^0.63 per km, derived from the distribution; the cut at 6 mm costs little."""
    assert 1e3 * statistics.rain_extinction_per_m(rate) == pytest.approx(
        0.182 * rate**0.63, rel=0.01
    )


@pytest.mark.parametrize(
    ("rate", "number"), [(0.25, 94), (1, 251), (2.5, 436), (10, 894), (50, 1801), (100, 2354)]
)
def test_drops_above_half_a_millimetre(rate, number):
    assert statistics.rain(rate).density_per_m3.sum() == pytest.approx(number, rel=0.01)


@pytest.mark.parametrize("kind", ["rain", "snow"])
@pytest.mark.parametrize("rate", [0.4, 2.0, 4.0])
def test_classes_carry_the_cross_section_of_the_distribution(kind, rate):
    """Sixteen equally frequent sizes stand for the whole class to 0.2 % of its silhouette area."""
    population = getattr(statistics, kind)(rate)
    area = population.density_per_m3 * (math.pi / 4 * population.diameters_m**2).mean(axis=1)
    edges = statistics.RAIN_EDGES_MM if kind == "rain" else statistics.SNOW_EDGES_MM

    def per_mm(d):
        if kind == "rain":
            slope = statistics.marshall_palmer_slope_per_mm(rate)
            return 8000 * math.exp(-slope * d) * math.pi / 4 * (d * 1e-3) ** 2
        slope, intercept = statistics.gunn_marshall(rate)
        return intercept * math.exp(-slope * d) * math.pi / 4 * d**3 / 0.17 * 1e-6

    expected = [quad(per_mm, a, b)[0] for a, b in pairwise(edges)]
    np.testing.assert_allclose(expected, area, rtol=2e-3)


@pytest.mark.parametrize(
    ("diameter_mm", "speed"),
    [(0.05, 0.14), (0.5, 2.13), (1, 3.95), (1.5, 5.40), (2, 6.54), (3, 8.05), (4, 8.82), (5, 9.12)],
)
def test_rain_falls_as_brandes_measured(diameter_mm, speed):
    assert statistics.brandes_fall_speed_m_per_s(np.array([diameter_mm]))[0] == pytest.approx(
        speed, abs=0.01
    )


@pytest.mark.parametrize(
    ("diameter_mm", "speed"), [(0.05, 0.0), (0.5, 2.02), (1, 4.00), (2, 6.55), (3, 7.95), (5, 9.14)]
)
def test_rain_falls_as_atlas_fitted(diameter_mm, speed):
    assert statistics.atlas_fall_speed_m_per_s(np.array([diameter_mm]))[0] == pytest.approx(
        speed, abs=0.01
    )


def test_the_law_of_fall_speed_can_be_chosen():
    brandes, atlas = statistics.rain(5.0), statistics.rain(5.0, fall_speed="atlas")
    np.testing.assert_array_equal(brandes.diameters_m, atlas.diameters_m)
    assert 0 < np.abs(brandes.fall_speed_m_per_s - atlas.fall_speed_m_per_s).max() < 0.2
    with pytest.raises(ArgumentError, match="fall_speed must be one of brandes, atlas"):
        statistics.rain(5.0, fall_speed="best")


@pytest.mark.parametrize("wetness", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_wet_snow_keeps_rate_and_extinction_consistent(rate, wetness):
    """Drawn flakes carry 1.5 W / C3 of their own water W, and bring down the same rate."""
    population, dry = statistics.snow(rate, wetness), statistics.snow(rate)
    melted_mm = (dry.diameters_m * 1e3) ** (2 / 3) * 0.17 ** (1 / 3)
    mass_g = math.pi / 6 * 1e-3 * melted_mm**3
    water = population.density_per_m3[:, None] * mass_g / mass_g.shape[1]
    c3_g_per_cm2 = 0.1 * (0.17 + wetness * (0.72 - 0.17))
    area = population.density_per_m3[:, None] * math.pi / 4 * population.diameters_m**2 / 16
    np.testing.assert_allclose(area, 1.5 * water / (c3_g_per_cm2 * 1e4), rtol=1e-9)
    # What the classes leave out (under 0.5 mm, over 3.37 mm melted) stays the same share.
    whole = population.extinction_per_m / dry.extinction_per_m
    assert area.sum() / (dry.density_per_m3 @ (math.pi / 4 * dry.diameters_m**2).mean(axis=1)) == (
        pytest.approx(whole)
    )
    flux = (water.sum(axis=1) * population.fall_speed_m_per_s * (1 + wetness)).sum()
    dry_water = (dry.density_per_m3[:, None] * mass_g / 16).sum(axis=1)
    assert flux == pytest.approx((dry_water * dry.fall_speed_m_per_s).sum())


def test_wet_snow_takes_the_light_that_rasmussen_says():
    """2.46 S per km dry, 0.29 S wet (Q = 1): the ratio 8.5 follows from 2 m/s and C3 = 0.072."""
    ratio = statistics.snow_extinction_per_m(1.0) / statistics.snow_extinction_per_m(1.0, 1.0)
    assert ratio == pytest.approx(4.92 / 0.58, rel=0.01)


def test_wetness_is_checked_and_halves_the_sway():
    dry, wet = statistics.snow(1.0), statistics.snow(1.0, wetness=1.0)
    np.testing.assert_allclose(wet.sway_m, 0.5 * dry.sway_m)
    np.testing.assert_array_equal(wet.cell_m, dry.cell_m)
    np.testing.assert_array_equal(wet.fall_speed_m_per_s, dry.fall_speed_m_per_s)
    for bad in (-0.1, 1.5, float("nan")):
        with pytest.raises(ArgumentError, match="wetness must be"):
            statistics.snow(1.0, wetness=bad)


def test_a_class_falls_at_one_speed_at_any_rate():
    """Else a drop would jump when the severity changes."""
    for kind in (statistics.rain, statistics.snow):
        slow, fast = kind(0.5), kind(4.0)
        np.testing.assert_array_equal(slow.fall_speed_m_per_s, fast.fall_speed_m_per_s)
        np.testing.assert_array_equal(slow.cell_m, fast.cell_m)
