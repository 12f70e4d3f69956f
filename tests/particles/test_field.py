from dataclasses import replace

import numpy as np
import pytest
from particle_scene import (
    AXES,
    camera,
    field,
    inside,
    nearest,
    seen,
    steady,
    whole,
)
from scipy import stats

from weather_aug.air import Air
from weather_aug.errors import ArgumentError
from weather_aug.particles import kernels, statistics
from weather_aug.particles import resolve as resolving
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import NEAR_M


@pytest.mark.parametrize("population", [statistics.rain(50.0), statistics.snow(2.0)])
def test_count_in_view_is_the_integral_of_the_density(population):
    cam = camera()
    counts, expected = [], []
    for seed in range(8):
        this = field(population, seed)
        resolved = this.resolve(cam, 20_000)
        counts.append(inside(this.particles(cam, 1.0, resolved, whole(cam)), cam).sum())
        expected.append(resolved.expected_count)
    total, mean = np.sum(counts), np.sum(expected)
    assert abs(total - mean) < 4 * np.sqrt(mean)
    # Poisson: the variance of the counts is their mean (chi2 with 7 degrees of freedom).
    chi2 = ((np.array(counts) - np.array(expected)) ** 2 / np.array(expected)).sum()
    assert stats.chi2(8).ppf(1e-6) < chi2 < stats.chi2(8).ppf(1 - 1e-6)


def test_kinds_are_different_fields():
    """Snow is not rain's places with other sizes."""
    cam = camera()
    rain = field(statistics.rain(20.0))
    other = field(replace(statistics.rain(20.0), kind="snow"))
    resolved = rain.resolve(cam, 5_000)
    first, second = (f.particles(cam, 0.0, resolved, whole(cam)) for f in (rain, other))
    assert not {tuple(r) for r in first[:, :3]} & {tuple(r) for r in second[:, :3]}


def test_rare_particles_are_as_rare_as_they_should_be():
    """Cubes that hold 1e-4 particles on average: their rarity is drawn finely enough."""
    population = statistics.rain(100.0)
    thin = replace(population, density_per_m3=np.full(14, 1e-4) / population.cell_m**3)
    cam = camera(width=600, height=600)
    counts = []
    reach = np.zeros((14, 16), np.float32)
    reach[13] = 60.0
    for seed in range(60):
        resolved = replace(field(population).resolve(cam, 10), reach_m=reach)
        counts.append(
            inside(field(thin, seed).particles(cam, 0.0, resolved, whole(cam)), cam).sum()
        )
    (fx, fy) = cam.focal_px
    volume = 600 * 600 / (fx * fy) * (60.0**3 - NEAR_M**3) / 3
    expected = 60 * volume * thin.density_per_m3[13]
    assert expected > 20
    assert abs(np.sum(counts) - expected) < 4 * np.sqrt(expected)


def test_higher_rain_rates_add_drops_and_move_none():
    cam = camera()
    light, heavy = field(statistics.rain(5.0)), field(statistics.rain(60.0))
    resolved = heavy.resolve(cam, 50_000)
    few = light.particles(cam, 1.0, resolved, whole(cam))
    many = heavy.particles(cam, 1.0, resolved, whole(cam))
    assert 20 < len(few) < 0.1 * len(many)
    places = {tuple(row) for row in np.round(many[:, :3], 5)}
    kept = [tuple(row) in places for row in np.round(few[:, :3], 5)]
    # Sizes inside a class shift by less than its width with the rate, so a few fall out of reach.
    assert np.mean(kept) > 0.95


def test_a_new_draw_for_each_severity_would_not_nest():
    """Planted fault against `higher rates add drops`: of re-rolled fields no drop stays."""
    cam = camera()
    light, heavy = statistics.rain(5.0), statistics.rain(60.0)
    resolved = field(heavy).resolve(cam, 50_000)
    many = {tuple(r) for r in np.round(seen(heavy, cam, 1.0, resolved)[:, :3], 5)}

    def kept(seed):
        few = np.round(seen(light, cam, 1.0, resolved, seed=seed)[:, :3], 5)
        return np.mean([tuple(row) in many for row in few])

    assert kept(seed=1) > 0.95
    assert kept(seed=2) < 0.05


def test_seed_and_kind_choose_the_field():
    cam = camera()
    this = field(statistics.rain(20.0), seed=1)
    resolved = this.resolve(cam, 5_000)
    first = this.particles(cam, 0.0, resolved, whole(cam))
    other = field(statistics.rain(20.0), seed=2).particles(cam, 0.0, resolved, whole(cam))
    assert not {tuple(r) for r in first[:, :3]} & {tuple(r) for r in other[:, :3]}


@pytest.mark.parametrize("population", [statistics.snow(2.0), statistics.rain(20.0)])
def test_a_window_draws_a_subset_in_the_same_order(population):
    cam = camera(speed=10.0)
    this = field(population, wind=(2.0, 5.0, 0.0))
    resolved = this.resolve(cam, 5_000)
    everything = [tuple(r) for r in this.particles(cam, 1.0, resolved, whole(cam))]
    part = [tuple(r) for r in this.particles(cam, 1.0, resolved, (30, 50, 24, 40))]
    assert 0 < len(part) < len(everything)
    positions = [everything.index(row) for row in part]
    assert positions == sorted(positions)


def test_hash_of_neighbouring_cells_is_balanced():
    """Each output bit of the cell hash is fair and independent of a step in any index."""
    indices = np.arange(-8, 8)
    keys = np.array(
        [
            kernels.cell_key(np.uint64(7), x, y, z)
            for x in indices
            for y in indices
            for z in indices
        ],
        np.uint64,
    )
    assert len(np.unique(keys)) == len(keys)
    bits = (keys[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    deviation = np.abs(bits.mean(axis=0) - 0.5) * 2 * np.sqrt(len(keys))
    assert deviation.max() < 5
    steps = keys.reshape(16, 16, 16)
    for axis in range(3):
        flipped = (np.diff(steps, axis=axis) * 0 + 1) * (
            np.take(steps, range(1, 16), axis) ^ np.take(steps, range(15), axis)
        )
        share = np.bitwise_count(flipped).mean() / 64
        assert abs(share - 0.5) < 0.01


def still(population):
    """The population without its sways."""
    none = np.zeros_like(population.sway_m)
    return replace(population, sway_m=none, sway_per_wind_s=none)


def test_without_sway_a_class_falls_at_one_speed_and_drifts_with_the_wind():
    population = still(statistics.rain(20.0))
    cam, wind = camera(), np.array([0.5, 1.5, 0.0])
    resolved = field(population, wind=wind).resolve(cam, 5_000)
    particles = seen(population, cam, 5.0, resolved, wind=wind)
    velocity = particles[:, 3:6] @ cam.world_from_camera[:3, :3].T - wind
    np.testing.assert_allclose(velocity[:, :2], 0, atol=1e-5)
    assert set(np.round(-velocity[:, 2], 3)) <= set(np.round(population.fall_speed_m_per_s, 3))


def test_drops_stray_from_their_class_by_a_tenth_of_the_wind():
    """Standard deviation 0.1 |w| + 0.1 m/s along each horizontal axis, none upwards."""
    population, cam = statistics.rain(20.0), camera()
    for wind in ((0.0, 0.0, 0.0), (3.0, 4.0, 0.0)):
        resolved = field(population, wind=wind).resolve(cam, 10)
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 4.0))
        particles = seen(population, cam, 2.0, resolved, wind=wind)
        stray = particles[:, 3:6] @ cam.world_from_camera[:3, :3].T - wind
        sigma = 0.1 + 0.1 * np.hypot(*wind[:2])
        np.testing.assert_allclose(stray[:, :2].std(axis=0), sigma, rtol=0.03)
        np.testing.assert_allclose(stray[:, :2].mean(axis=0), 0, atol=0.03 * sigma)
        fall = set(np.round(population.fall_speed_m_per_s, 3))
        assert set(np.round(-stray[:, 2], 3)) <= fall
        assert (population.sway_m + 5 * population.sway_per_wind_s).max() < 0.11


def test_a_gust_changes_streaks_but_no_place():
    """At equal drift; of rain the sway grows with the wind, by no more than it says."""
    cam, drift = camera(), (1.0, 2.0, 0.0)
    for population in (statistics.snow(2.0), statistics.rain(20.0)):
        calm, storm = (
            ParticleField(population, 1, Air(wind, drift), AXES)
            for wind in ((0.0, 0.0, 0.0), (0.0, 9.0, 0.0))
        )
        resolved = calm.resolve(cam, 5_000)
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 4.0))
        before = calm.particles(cam, 7.0, resolved, whole(cam))
        after = storm.particles(cam, 7.0, resolved, whole(cam))
        clear = inside(before, cam) & (before[:, 2] < 3) & (before[:, 2] > 1)
        moves = 9.0 * population.sway_per_wind_s.max() * np.sqrt(2)
        assert nearest(before[clear, :3], after[:, :3]).max() <= moves + 1e-6
        assert abs(after[:, 3].mean() - before[:, 3].mean()) > 5


def test_wet_snow_has_fallen_further_by_the_integral_of_its_wetness():
    """Dry speed times the integral; rain does not listen to it."""
    cam = camera()
    for population, wet_s in ((statistics.snow(2.0, wetness=0.5), 0.7), (statistics.rain(9.0), 0)):
        population = still(population)
        resolved = field(population).resolve(cam, 5_000)
        # A second later the same flakes, except for those of wet_s: undone by a falling camera.
        for k, speed in enumerate(population.fall_speed_m_per_s):
            one = np.where(np.arange(len(resolved.reach_m))[:, None] == k, resolved.reach_m, 0)
            only = replace(resolved, reach_m=one.astype(np.float32))
            first = seen(population, cam, 3.0, only)
            lower = camera(centre=(0, 0, 1.5 - wet_s * speed))
            air = Air((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.7)
            wet = ParticleField(population, 1, air, AXES)
            second = wet.particles(lower, 3.0, only, whole(cam))
            assert first.shape == second.shape
            np.testing.assert_allclose(first, second, atol=1e-5)


def test_wet_snow_is_fewer_of_the_same_flakes():
    """A class keeps its places when the wetness changes: at time 0 the wet are among the dry."""
    cam = camera()
    dry, wet = still(statistics.snow(2.0)), still(statistics.snow(2.0, wetness=1.0))
    resolved = field(dry).resolve(cam, 20_000)
    many, few = (seen(p, cam, 0.0, resolved) for p in (dry, wet))
    assert len(few) == pytest.approx(0.5 * len(many), rel=0.1)
    # Wet flakes are quicker, hence streak further into the picture's edge.
    assert nearest(few[inside(few, cam), :3], many[:, :3]).max() < 1e-6


def test_far_from_the_origin_and_late_the_field_is_as_precise():
    """1e6 m and 1e6 s away, particles still move by v dt."""
    population = still(statistics.rain(20.0))
    cam = camera(centre=(1e6, -2e6, 50.0))
    resolved = field(population).resolve(cam, 5_000)
    before = seen(population, cam, 1e6, resolved)
    after = seen(population, cam, 1e6 + 0.01, resolved)
    moved = before[:, :3] + 0.01 * before[:, 3:6]
    stays = inside(before, cam) & (before[:, 2] > 1) & (before[:, 2] < 4)
    stays &= before[:, 12] > 0.05
    assert stays.sum() > 20
    assert nearest(moved[stays], after[:, :3]).max() < 1e-3


def test_particles_fade_before_they_end(monkeypatch):
    """Opacity falls to 0 at the reach and at the near limit, and is 1 between."""
    monkeypatch.setattr(resolving, "ARRIVALS", (1e-12, 0.0))
    population, cam = statistics.snow(2.0), camera(width=400, height=300)
    resolved = field(population).resolve(cam, 50_000)
    resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 4.0))
    found = seen(population, cam, 2.0, resolved)
    depth, opacity = found[:, 2], found[:, 12]
    expected = np.minimum(np.minimum((depth - 0.5) / 0.2, (4.0 - depth) / 0.6), 1.0)
    np.testing.assert_allclose(opacity, expected, atol=1e-5)
    assert opacity.min() < 0.02 and (opacity == 1).mean() > 0.5


@pytest.mark.parametrize("arrivals", [resolving.ARRIVALS, (0.25, 0.0), (1e-12, 0.0)])
def test_what_a_rising_rate_adds_is_faint_at_first(arrivals, monkeypatch):
    """Rain 1 % heavier: no opacity rises by more than the ramp allows; without one it does."""
    monkeypatch.setattr(resolving, "ARRIVALS", arrivals)
    cam = camera(width=400, height=300)
    reach_m = np.full((14, 16), 8.0, np.float32)
    resolved = replace(field(statistics.rain(20.0)).resolve(cam, 1_000), reach_m=reach_m)
    few, many = (seen(statistics.rain(rate), cam, 2.0, resolved) for rate in (20.0, 20.2))
    before = {tuple(row[:3]): row[12] for row in few}
    rise = np.array([row[12] - before.get(tuple(row[:3]), 0.0) for row in many])
    assert len(many) > len(few)
    assert (rise.max() < 0.2) == (arrivals[1] > 0)


@pytest.mark.parametrize("population", [statistics.rain(75.0), statistics.snow(0.5)])
def test_the_arrivals_cost_the_opacity_that_the_veil_takes_over(population):
    cam = camera(width=300, height=200)
    reach_m = np.full((len(population.cell_m), 16), 6.0, np.float32)
    resolved = replace(field(population).resolve(cam, 1_000), reach_m=reach_m)
    expected = resolving.drawn_share(population.mean_per_cell)
    assert ((expected > 0.8) & (expected < 1)).all()
    found = [seen(population, cam, t, resolved) for t in (0.0, 40.0, 80.0)]
    found = np.concatenate([f[(f[:, 2] > 1) & (f[:, 2] < 5)] for f in found])
    weight = population.density_per_m3 / population.density_per_m3.sum()
    assert found[:, 12].mean() == pytest.approx(weight @ expected, abs=0.01)
    assert found[:, 12].mean() < 0.995


def test_bad_arguments_are_named():
    population, air = statistics.rain(5.0), steady((0.0, 0.0, 0.0), 0.0)
    with pytest.raises(ArgumentError, match="axes_world must be"):
        ParticleField(population, 0, air, np.eye(4))
    for bad in (np.eye(3), np.diag([1.0, 1, -1, 1]), np.diag([2.0, 1, 1, 1]), np.eye(4) * np.nan):
        with pytest.raises(ArgumentError, match="field_from_world must be"):
            ParticleField(population, 0, air, AXES, bad)


@pytest.mark.parametrize(
    ("population", "wind"),
    [
        (statistics.rain(300.0), (40.0, -40.0, 5.0)),
        (statistics.snow(50.0, wetness=1.0), (-30.0, 30.0, 0.0)),
        (statistics.rain(2e-4), (0.0, 0.0, 0.0)),
    ],
)
def test_records_stay_finite_in_any_weather(population, wind):
    cam = camera(speed=60.0, exposure_s=0.02)
    this = field(population, wind=wind, time_s=1e5)
    resolved = this.resolve(cam, 5_000)
    found = this.particles(cam, 1e5, resolved, whole(cam))
    assert np.isfinite(found).all()
    assert ((found[:, 12] >= 0) & (found[:, 12] <= 1)).all()
    assert (found[:, 2] >= NEAR_M).all()
    assert (
        np.isfinite(resolved.optical_depth).all()
        and (np.diff(resolved.optical_depth) > -1e-7).all()
    )
