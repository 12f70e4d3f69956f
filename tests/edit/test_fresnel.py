import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.edit.physical import fresnel as module
from weather_aug.edit.physical.fresnel import (
    DIFFUSE_FROM_AIR,
    WATER_INDEX,
    film_ratio,
    fresnel,
    fresnel_of_sine,
)
from weather_aug.errors import ArgumentError

TABLE = {1: 0.90, 2: 0.80, 3: 0.72, 5: 0.58, 7: 0.47, 10: 0.35, 15: 0.21, 20: 0.13, 30: 0.06}
"""Degrees of grazing angle, and the share that is mirrored, to two figures."""
FILM_TABLE = {0.05: 0.50, 0.12: 0.52, 0.3: 0.57, 0.5: 0.64}
ROUNDING = 0.005
SINES = np.linspace(0.0, 1.0, 4001).astype(np.float32)


def schlick(grazing_rad):
    normal = ((WATER_INDEX - 1) / (WATER_INDEX + 1)) ** 2
    return normal + (1 - normal) * (1 - np.sin(grazing_rad)) ** 5


def by_refraction(grazing_rad):
    """Fresnel's equations as Snell's law and the two tangent and sine ratios give them."""
    outside = np.pi / 2 - np.asarray(grazing_rad)
    inside = np.arcsin(np.sin(outside) / WATER_INDEX)
    across = np.sin(outside - inside) / np.sin(outside + inside)
    along = np.tan(outside - inside) / np.tan(outside + inside)
    return 0.5 * (across**2 + along**2)


def keeps_the_table(function):
    return all(abs(function(np.radians(a)) - r) <= ROUNDING + 0.002 for a, r in TABLE.items())


def test_water_mirrors_what_the_table_says():
    assert keeps_the_table(fresnel)
    assert abs(fresnel(np.pi / 2) - 0.0204) < 2e-4
    assert fresnel(0.0) == 1.0


def test_the_usual_approximation_would_be_found():
    assert not keeps_the_table(schlick)


@given(st.floats(1e-3, np.pi / 2 - 1e-3))
def test_it_is_snells_law(grazing_rad):
    assert abs(fresnel(grazing_rad) - by_refraction(grazing_rad)) < 1e-9


def test_rows_are_the_exact_values():
    out = np.array([fresnel_of_sine(sine) for sine in SINES])
    np.testing.assert_allclose(fresnel(np.arcsin(SINES.astype(np.float64))), out, atol=2e-6)
    assert np.abs(schlick(np.arcsin(SINES)) - out).max() > 0.03


def test_the_share_from_all_sides_is_the_mean_over_the_hemisphere():
    sine = (np.arange(20000) + 0.5) / 20000
    mean = (2 * sine * fresnel(np.arcsin(sine))).mean()
    assert abs(mean - DIFFUSE_FROM_AIR) < 1e-3


def test_a_film_darkens_by_the_table():
    for albedo, ratio in FILM_TABLE.items():
        assert abs(film_ratio(albedo) - ratio) <= ROUNDING


@given(st.floats(0, 1))
def test_a_film_is_the_sum_over_all_turns_of_the_light(albedo):
    stays = module.DIFFUSE_FROM_WATER
    light, wet = 1 - DIFFUSE_FROM_AIR, 0.0
    for _ in range(200):
        scattered = albedo * light
        wet += (1 - stays) * scattered
        light = stays * scattered
    assert abs(wet - albedo * film_ratio(albedo)) < 1e-9


def test_a_dark_surface_loses_the_larger_share():
    assert (np.diff(film_ratio(np.linspace(0, 1, 50))) > 0).all()


@pytest.mark.parametrize("angle", [-0.1, 90.0, np.nan])
def test_degrees_and_angles_below_the_surface_are_refused(angle):
    with pytest.raises(ArgumentError, match="grazing_rad"):
        fresnel([0.1, angle])


@pytest.mark.parametrize("albedo", [-0.01, 1.5, np.nan])
def test_light_is_no_albedo(albedo):
    with pytest.raises(ArgumentError, match="albedo"):
        film_ratio(albedo)
