"""Checks 1, 3 and 4: how much light particles take, at any budget and resolution."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import AIR_ONLY, air_only
from oracles import faults, size_laws
from oracles import reference_render as reference
from particles.particle_scene import camera, field
from physics_scene import layer, measured, solid, splats_of_records
from render_scene import make_camera, make_frame

from weather_aug.particles import resolve as resolving
from weather_aug.particles import statistics
from weather_aug.particles.resolve import FAR_M
from weather_aug.render import fields, stage
from weather_aug.render.compose import render
from weather_aug.render.froxels import even_fog
from weather_aug.render.medium import Medium, optical_depth
from weather_aug.weather import Weather

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def puffs(cam, tau, alpha, opacity, seed):
    """Gaussians of 1.2 px and more, scattered evenly between 5 and 10 m, of optical depth tau."""
    near_m, far_m, sigma_m = 5.0, 10.0, 0.0125
    (fx, fy), (cx, cy), edge = cam.focal_px, cam.principal_px, 30
    cross_section_m2 = 2 * np.pi * sigma_m**2 * alpha
    density = tau / (cross_section_m2 * (far_m - near_m))
    width, height = cam.width + 2 * edge, cam.height + 2 * edge
    volume = width * height / (fx * fy) * (far_m**3 - near_m**3) / 3
    rng = np.random.default_rng(seed)
    count = rng.poisson(density * volume)
    z = (near_m**3 + rng.random(count) * (far_m**3 - near_m**3)) ** (1 / 3)
    x = (rng.uniform(-edge, cam.width + edge, count) - cx) / fx * z
    y = (rng.uniform(-edge, cam.height + edge, count) - cy) / fy * z
    place = np.column_stack([x, y, z])
    return solid(place, 0.0, sigma_m * 2 * np.sqrt(2), opacity(alpha, tau, z))


def constant(alpha, tau, z):
    return alpha


def check_beer_lambert(opacity, tau, alpha, draws=4):
    """Mean T within 3 % of exp(-tau), its scatter within 10 % of sqrt(exp(tau alpha / 2) - 1).

    Source:
        Campbell's theorem; rays off the axis are longer by 1 / cos.
    """
    cam = make_camera(600, 400, 1600.0, aperture_m=0.0)
    slant = np.sqrt(1 + (reference.rays(cam) ** 2).sum(-1))
    ratios = []
    for seed in range(draws):
        records = puffs(cam, tau, alpha, opacity, seed)
        _, through = layer(splats_of_records(records, cam), cam)
        ratios.append(through.astype(float) / np.exp(-tau * slant))
    ratio = np.array(ratios)
    assert ratio.size >= 5_000
    mean, scatter = ratio.mean(), ratio.std() / ratio.mean()
    # The pixel filter widens a Gaussian and thins it by the same factor: so much less scatter.
    z = np.linspace(5, 10, 200)
    variance = (1600 * 0.0125 / z) ** 2
    thinner = (variance / (variance + 0.3)).mean()
    expected = np.sqrt(np.expm1(tau * slant.mean() * alpha * thinner / 2))
    measured(f"1: tau {tau} alpha {alpha}: T {mean - 1:+.4f}, CV {scatter / expected - 1:+.4f}")
    assert abs(mean - 1) < 0.03
    assert abs(scatter / expected - 1) < 0.10


@pytest.mark.parametrize("tau", [0.5, 1.0, 2.0, 3.0])
def test_1_beer_lambert(tau):
    check_beer_lambert(constant, tau, 0.2)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.05, 0.8])
@pytest.mark.parametrize("tau", [0.5, 1.0, 2.0, 3.0])
def test_1_beer_lambert_of_fainter_and_denser_puffs(tau, alpha):
    check_beer_lambert(constant, tau, alpha, draws=12)


def test_1_opacity_that_grows_with_depth_is_found_out():
    """The paper's fog: each Gaussian as opaque as all the fog before it."""
    with pytest.raises(AssertionError):
        check_beer_lambert(faults.opacity_of_the_papers_fog, 1.0, 0.2)


def drawn_at(resolved, depth_m):
    """What drawn particles carry on the axis up to a depth."""
    depths = np.linspace(0, FAR_M, len(resolved.optical_depth))
    return np.interp(depth_m, depths, resolved.optical_depth)


def veil(population, resolved, depth_m):
    """Optical depth that the medium's kernel adds on the axis for what is not drawn."""
    air = Medium(*(np.float32(0.0),) * 7)._replace(
        precipitation_per_m=np.float32(population.extinction_per_m),
        resolved_step_m=np.float32(FAR_M / (len(resolved.optical_depth) - 1)),
    )
    axis = stage.optics_of(make_camera(1, 1, 100.0), np.array([0.0, 0, 1]))
    depth = np.array([[depth_m]], np.float32)
    carried = np.array(resolved.optical_depth)
    return float(optical_depth(depth, (0, 0, 1, 1), axis, air, carried, even_fog())[0, 0])


def check_explicit_and_residual(kind, budget, exposure_s=0.002, *, veil=veil, fade=size_laws.fade):
    """Quadrature of what is drawn, plus the veil, is the whole to 1 % at 5, 20 and 60 m."""
    rate = 4.0
    population = getattr(statistics, kind)(rate)
    cam = camera(speed=5.0, width=1024, height=512, exposure_s=exposure_s)
    resolved = field(population).resolve(cam, budget)
    for depth_m in (5.0, 20.0, 60.0):
        drawn = size_laws.drawn_optical_depth(
            population, rate, cam, resolved.alpha_min, depth_m, fade
        )
        total = size_laws.geometric_extinction_per_m(kind, rate) * depth_m
        error = (drawn + veil(population, resolved, depth_m)) / total - 1
        measured(f"3: {kind} {budget} {depth_m} m drawn {drawn / total:.3f} error {error:+.5f}")
        assert drawn > 0.004 * total
        assert abs(error) < 0.01
    return resolved.alpha_min


@pytest.mark.parametrize("budget", [10_000, 50_000, 200_000])
@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_3_explicit_and_residual_are_the_whole(kind, budget):
    check_explicit_and_residual(kind, budget)


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_3_whatever_the_faintest_opacity(kind, monkeypatch):
    for alpha in (0.005, 0.02, 0.05):
        monkeypatch.setattr(resolving, "FAINTEST_ALPHA", alpha)
        resolving._resolved.cache_clear()
        assert check_explicit_and_residual(kind, 10**8) == alpha
    resolving._resolved.cache_clear()


@pytest.mark.parametrize("kind", ["rain", "snow"])
@pytest.mark.parametrize("fault", faults.VEILS.values(), ids=faults.VEILS)
def test_3_a_wrong_veil_is_found_out(kind, fault):
    with pytest.raises(AssertionError):
        check_explicit_and_residual(kind, 50_000, veil=fault(veil))


def test_3_forgotten_fades_are_found_out():
    with pytest.raises(AssertionError):
        check_explicit_and_residual("snow", 50_000, fade=size_laws.abrupt)


def check_rendered_walls(ambience, depth_m, budgets, seeds):
    """Mean transmittance of a wall in dense snow is Beer and Lambert's, to 1 % at any budget."""
    cam = make_camera(400, 240, 800.0, exposure_s=0.0005)
    frame = make_frame(cam, 60, depth_m)
    slant = np.sqrt(1 + (reference.rays(cam) ** 2).sum(-1))
    expected = np.exp(-2.451e-3 * 4.0 * depth_m * slant).mean()
    snow = field(statistics.snow(4.0))
    for budget in budgets:
        assert drawn_at(snow.resolve(cam, budget), depth_m) > 0.05 * 9.8e-3 * depth_m
        shots = [
            render(
                frame,
                Weather(snow_mm_per_h=4.0),
                seed=seed,
                ambience=ambience,
                options=air_only(budget),
            )
            for seed in range(seeds)
        ]
        mean = np.mean([shot.transmittance.mean() for shot in shots])
        measured(f"3: rendered {depth_m} m {budget}: {mean / expected - 1:+.5f}")
        assert abs(mean / expected - 1) < 0.01


@pytest.mark.parametrize("depth_m", [5.0, 20.0, 60.0])
def test_3_rendered_walls(ambience, depth_m):
    check_rendered_walls(ambience, depth_m, (10_000, 50_000, 200_000), seeds=4)


def test_3_rendered_without_a_veil_is_found_out(ambience, monkeypatch):
    medium_of = stage.medium_of

    def without(*args):
        return medium_of(*args)._replace(precipitation_per_m=np.float32(0))

    monkeypatch.setattr(stage, "medium_of", without)
    with pytest.raises(AssertionError):
        check_rendered_walls(ambience, 60.0, (10_000,), seeds=2)


def check_resolution(ambience, weather, seeds, tolerance=0.01):
    """Mean transmittance and mean luminance at full, half and quarter resolution agree to 1 %.

    Over a wall of the scene's own middle grey: where fewer drops are resolved more are veil, whose
    colour is the airlight's, so that over a wall four times darker 50 mm/h change by 1.3 %.
    """
    full = make_camera(480, 288, exposure_s=0.002)
    means = []
    for k in (1, 2, 4):
        cam = full.resized(480 // k, 288 // k)
        # Sixty levels, equally many of each at any resolution: roundings to 8 bits average out.
        v, u = np.mgrid[: cam.height, : cam.width]
        frame = make_frame(cam, (94 + (u + 7 * v) % 60)[..., None], 25.0)
        shots = [
            render(frame, weather, seed=s, ambience=ambience, options=AIR_ONLY)
            for s in range(seeds)
        ]
        means.append(
            [
                np.mean([shot.transmittance.mean() for shot in shots]),
                np.mean([(reference.linear(shot.image) @ LUMINANCE).mean() for shot in shots]),
            ]
        )
    spread = np.ptp(means, axis=0) / means[0]
    measured(f"4: T {spread[0]:.5f}, luminance {spread[1]:.5f}")
    assert (spread < tolerance).all()


def check_resolution_of_discs(*, compensate, tolerance=0.01):
    """The same still discs of a few tenths of a pixel, optical depth 0.467, at 1, 1/2 and 1/4."""
    full = make_camera(480, 288)
    near_m, far_m, diameter_m, tau = 1.0, 12.0, 0.006, 0.467
    (fx, fy), (cx, cy) = full.focal_px, full.principal_px
    volume = (full.width + 3) * (full.height + 3) / (fx * fy) * (far_m**3 - near_m**3) / 3
    count = round(tau / (np.pi / 4 * diameter_m**2 * (far_m - near_m)) * volume)
    rng = np.random.default_rng(1)
    z = (near_m**3 + rng.random(count) * (far_m**3 - near_m**3)) ** (1 / 3)
    x = (rng.uniform(-2, full.width + 1, count) - cx) / fx * z
    y = (rng.uniform(-2, full.height + 1, count) - cy) / fy * z
    records = solid(np.column_stack([x, y, z]), 0.0, diameter_m)
    means = []
    for k in (1, 2, 4):
        cam = full.resized(480 // k, 288 // k)
        splats = splats_of_records(records, cam, (0.4, 0.4, 0.4), compensate=compensate)
        image, through = layer(splats, cam)
        means.append([through.mean(), (reference.linear(image) @ LUMINANCE).mean()])
    spread = np.ptp(means, axis=0) / means[0]
    slant = np.sqrt(1 + (reference.rays(full) ** 2).sum(-1))
    expected = np.exp(-tau * slant).mean()
    measured(f"4: {count} discs: spreads {spread}, T {means[0][0] / expected - 1:+.5f}")
    assert (spread < tolerance).all()
    assert abs(means[0][0] / expected - 1) < 0.03


def test_4_the_same_discs_at_three_resolutions():
    check_resolution_of_discs(compensate=True)
    with pytest.raises(AssertionError):
        check_resolution_of_discs(compensate=False, tolerance=0.05)


WEATHERS = {
    "rain": Weather(rain_mm_per_h=50.0),
    "snow": Weather(snow_mm_per_h=4.0),
}


@pytest.mark.parametrize("weather", WEATHERS.values(), ids=WEATHERS)
def test_4_resolution_does_not_change_the_weather(ambience, weather):
    check_resolution(ambience, weather, seeds=4)


@pytest.mark.parametrize("weather", WEATHERS.values(), ids=WEATHERS)
def test_4_stock_dilation_misses_by_more_than_five_times(ambience, weather, monkeypatch):
    monkeypatch.setattr(fields, "project", faults.stock_dilation(fields.project))
    with pytest.raises(AssertionError):
        check_resolution(ambience, weather, seeds=1, tolerance=0.05)


def test_4_holds_with_the_veil_and_the_sky_of_a_severity(ambience):
    check_resolution(ambience, replace(Weather.rain("heavy"), gustiness=0.0), seeds=4)
