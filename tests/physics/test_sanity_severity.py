"""Checks 11 and 16: severity only ever adds, and what particles do to a sky and to a black wall."""

import numpy as np
import pytest
from air_only import air_only
from oracles import faults
from oracles import reference_render as reference
from particles.particle_scene import whole
from physics_scene import layer, measured, splats_of_records
from render_scene import make_camera, make_frame

from weather_aug.air import Air, air_of
from weather_aug.render.compose import render
from weather_aug.render.fields import fields_of
from weather_aug.render.light import rain_colour, snow_colour
from weather_aug.render.options import DEFAULT_OPTIONS
from weather_aug.weather import Weather

GRID = np.linspace(0, 1, 101)
KINDS = ("rain", "snow", "fog")


def weather_at(kind, severity):
    return getattr(Weather, kind)(severity)


def extinction_per_m(weather):
    """Of all that is in the air at camera height, 1/m; spray at the road."""
    total = weather.fog_per_m + 1e-3 * (weather.mist_per_km + weather.spray_per_km)
    axes = np.eye(3)
    for field in fields_of(weather, 0, Air.held(weather), axes, DEFAULT_OPTIONS, None):
        total += field.population.extinction_per_m
    return total


def mean_transmittance(weather, seed, ambience, budget):
    """Of a wall at 50 m."""
    frame = make_frame(make_camera(160, 96, 300.0, exposure_s=0.001), 60, 50.0)
    options = air_only(budget)
    shot = render(frame, weather, seed=seed, ambience=ambience, options=options)
    return float(shot.transmittance.mean())


def check_monotone(kind, ambience, weather_of=weather_at, seed_of=lambda s: 1, budget=3_000):
    """Extinction, covers, 1 - mean T at 50 m and wetness never fall along 101 severities."""
    weathers = [weather_of(kind, s) for s in GRID]
    rows = [
        (
            extinction_per_m(weather),
            weather.snow_cover,
            weather.wetness,
            weather.overcast,
            1 - mean_transmittance(weather, seed_of(s), ambience, budget),
        )
        for s, weather in zip(GRID, weathers, strict=True)
    ]
    steps = np.diff(rows, axis=0)
    measured(f"11: {kind}: smallest steps {steps.min(axis=0)}")
    assert (steps >= 0).all()
    # The air thickens, and is seen to, at every step.
    assert (steps[:, 0] > 0).all()
    assert (steps[:, 4] > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_11_monotone(kind, ambience):
    check_monotone(kind, ambience)


@pytest.mark.slow
@pytest.mark.parametrize("budget", [0, 20_000])
@pytest.mark.parametrize("kind", KINDS)
def test_11_monotone_at_any_budget(kind, budget, ambience):
    check_monotone(kind, ambience, budget=budget)


def check_identity(weather_of, ambience):
    """s = 0 gives the recorded picture back: the largest difference is 0."""
    rng = np.random.default_rng(2)
    camera = make_camera(96, 64, velocity=(12.0, 0, 0), exposure_s=0.005)
    image = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8)
    depth = rng.uniform(0.6, 200, (64, 96)).astype(np.float32)
    depth[:16] = np.inf
    label = rng.integers(0, 19, (64, 96), dtype=np.uint8)
    frame = make_frame(camera, image, depth, label)
    for kind in KINDS:
        shot = render(frame, weather_of(kind, 0.0), seed=1, ambience=ambience)
        assert np.abs(shot.image.astype(int) - image).max() == 0
        assert np.array_equal(shot.label, label)
        assert (shot.transmittance == 1).all()


def test_11_identity(ambience):
    check_identity(weather_at, ambience)


def layer_of(kind, severity, seed, ambience):
    """Optical depth (H, W) of the particles alone, in air that has not drifted."""
    frame = make_frame(make_camera(160, 96, 300.0, exposure_s=0.001), 60, 20.0)
    weather = weather_at(kind, severity)
    shots = [
        render(
            frame,
            weather,
            seed=seed,
            ambience=ambience,
            air=Air.held(weather),
            options=air_only(budget),
        )
        for budget in (0, 20_000)
    ]
    return np.log(shots[0].transmittance / shots[1].transmittance)


def check_thinning(kind, ambience, seed_of=lambda s: 1):
    """A hundredth more severe, the same particles are there: the layers correlate by 0.8."""
    for s in (0.3, 0.5, 0.75, 0.95):
        layers = [layer_of(kind, t, seed_of(t), ambience).ravel() for t in (s, s + 0.01)]
        correlation = np.corrcoef(layers)[0, 1]
        measured(f"11: {kind} {s}: correlation {correlation:.3f}")
        assert correlation > 0.8


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_11_severity_thins(kind, ambience):
    check_thinning(kind, ambience)


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_11_a_draw_for_each_severity_is_found_out(kind, ambience):
    with pytest.raises(AssertionError):
        check_thinning(kind, ambience, faults.seed_of_severity)


def test_11_a_scale_that_dips_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_monotone("fog", ambience, weather_of=faults.dipping(weather_at), budget=0)


def test_11_a_base_load_at_zero_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_identity(lambda kind, s: weather_at(kind, max(s, 0.01)), ambience)


COLOURS = {"rain": rain_colour, "snow": snow_colour}


def explicit_layer(kind, rate, linear_level, ambience, colour_of, seed, drawn=splats_of_records):
    """Picture over a uniform surface, with and without the particles alone: no veil."""
    camera = make_camera(480, 288, 500.0, exposure_s=0.005)
    weather = Weather(**{f"{kind}_mm_per_h": rate})
    (field,) = fields_of(
        weather, seed, air_of(weather, 1.0, seed), ambience.axes_world, DEFAULT_OPTIONS, None
    )
    resolved = field.resolve(camera, DEFAULT_OPTIONS.max_particles)
    records = field.particles(camera, 1.0, resolved, whole(camera))
    level = np.round(reference.srgb(linear_level)).astype(np.uint8)
    splats = drawn(records, camera, colour_of(ambience))
    after, through = layer(splats, camera, level)
    before, _ = layer(splats[:0], camera, level)
    assert len(records) > 50
    assert through.min() < 0.98
    return after.astype(int) - before.astype(int)


def check_sky(kind, rates, ambience, colour_of, drawn=splats_of_records):
    """Rain changes the mean of a bright sky by a level at most; neither ever brightens it.

    Over black, both always brighten.
    """
    for rate in rates:
        for seed in range(3):
            args = ambience, colour_of, seed, drawn
            over_sky = explicit_layer(kind, rate, ambience.sky, *args)
            over_black = explicit_layer(kind, rate, np.zeros(3), *args)
            if seed == 0:
                measured(
                    f"16: {kind} {rate} mm/h: sky {over_sky.mean():+.3f} (at most"
                    f" {over_sky.max():+d}), black {over_black.mean():+.3f} levels"
                )
            if kind == "rain":
                assert abs(over_sky.mean()) <= 1.0
            assert over_sky.max() <= 0
            assert over_sky.mean() < 0
            assert over_black.min() >= 0
            assert over_black.mean() > 0


RATES = {"rain": (1.5, 5.0, 20.0, 75.0), "snow": (0.4, 1.0, 2.0, 4.0)}


@pytest.mark.parametrize("kind", RATES)
def test_16_sky_rule(kind, ambience):
    check_sky(kind, RATES[kind], ambience, COLOURS[kind])


@pytest.mark.parametrize("kind", RATES)
@pytest.mark.parametrize("grey_srgb", [0.85, 0.0])
def test_16_fixed_greys_are_found_out(kind, grey_srgb, ambience):
    """The release's grey glows before this sky; black drops never brighten a wall."""
    with pytest.raises(AssertionError):
        check_sky(kind, (2.0,), ambience, lambda _: faults.grey(grey_srgb))


def test_16_stock_dilation_is_found_out(ambience):
    """Streaks that the pixel filter widens and nothing thins darken the whole sky."""

    def stock(records, camera, colour):
        return splats_of_records(records, camera, colour, compensate=False)

    with pytest.raises(AssertionError):
        check_sky("rain", (5.0,), ambience, rain_colour, stock)
