"""Particles on the picture: energy, shape, occlusion, and agreement with the reference."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import AIR_ONLY, air_only
from oracles import reference_render as reference
from render_scene import make_camera, make_frame

from weather_aug.air import air_of
from weather_aug.edit.surface import surface_of
from weather_aug.render.compose import render
from weather_aug.render.fields import fields_of
from weather_aug.render.froxels import even_fog
from weather_aug.render.light import particle_colour, rain_colour, snow_colour
from weather_aug.render.medium import Medium
from weather_aug.render.options import DEFAULT_OPTIONS
from weather_aug.render.project import BAND_ROWS, FAINTEST, log, sorted_in_blocks, split_by_band
from weather_aug.render.project import project as project_kernel
from weather_aug.render.shade import shade
from weather_aug.render.stage import optics_of
from weather_aug.weather import Weather

UP = np.array([0.0, 0, 1])
CLEAR_AIR = Medium(*(np.float32(v) for v in (0, 0, 0, 0, 60 / 1024, 0, 3)))
NOTHING_RESOLVED = np.zeros(1025, np.float32)


def solid(particles):
    """Records (N, 13) of solid spheres given as (N, 7): position, velocity, diameter."""
    particles = np.asarray(particles, np.float32)
    records = np.zeros((len(particles), 13), np.float32)
    records[:, :6] = particles[:, :6]
    records[:, [6, 9, 11]] = particles[:, 6:] ** 2 / 8
    records[:, 12] = 1
    return records


def project(records, camera, window=None):
    if np.shape(records)[1] == 7:
        records = solid(records)
    window = window or (0, 0, camera.height, camera.width)
    white = np.ones((1, 3), np.float32)
    optics = optics_of(camera, UP)
    blocks, kinds = sorted_in_blocks(np.asarray(records, np.float32), np.array([len(records)]))
    return project_kernel(
        blocks,
        kinds,
        white,
        optics,
        CLEAR_AIR,
        NOTHING_RESOLVED,
        white[0],
        window,
        True,
    )


def transmittance(particles, camera, depth_m=1000.0):
    """Of particles alone, in clear air."""
    height, width = camera.height, camera.width
    window = (0, 0, height, width)
    splats = project(particles, camera)
    splats, band_starts = split_by_band(splats, window, -(-height // BAND_ROWS))
    through = np.empty((height, width), np.float32)
    zero = np.float32(0)
    frame = make_frame(camera, 0, depth_m)
    shade(
        surface_of(frame),
        even_fog(),
        window,
        optics_of(camera, UP),
        CLEAR_AIR,
        NOTHING_RESOLVED,
        np.zeros(256, np.float32),
        False,
        np.ones(3, np.float32),
        splats,
        band_starts,
        (zero, zero),
        np.empty((height, width, 3), np.uint8),
        through,
        np.empty((height, width), np.uint8),
        np.zeros((height, width), np.uint8),
    )
    return through


def discs(camera, count, diameter_m, near_m, far_m, seed):
    """Still discs, uniform in the padded frustum."""
    rng = np.random.default_rng(seed)
    z = (near_m**3 + rng.random(count) * (far_m**3 - near_m**3)) ** (1 / 3)
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    x = (rng.uniform(-2, camera.width + 1, count) - cx) / fx * z
    y = (rng.uniform(-2, camera.height + 1, count) - cy) / fy * z
    still = np.zeros((count, 3))
    return np.column_stack([x, y, z, still, np.full(count, diameter_m)])


def frustum_m3(camera, near_m, far_m):
    (fx, fy) = camera.focal_px
    return (camera.width + 3) * (camera.height + 3) / (fx * fy) * (far_m**3 - near_m**3) / 3


@pytest.mark.parametrize("tau", [0.5, 1.0, 2.0])
def test_poisson_discs_obey_beer_and_lambert(tau):
    """Mean transmittance of randomly placed discs is exp(-n A z) (Campbell's theorem)."""
    camera = make_camera(width=200, height=120)
    near_m, far_m, diameter_m = 2.0, 10.0, 0.03
    area = np.pi / 4 * diameter_m**2
    density = tau / (area * (far_m - near_m))
    count = round(density * frustum_m3(camera, near_m, far_m))
    mean = np.mean(
        [
            transmittance(discs(camera, count, diameter_m, near_m, far_m, seed), camera).mean()
            for seed in range(3)
        ]
    )
    # Paths are longer off the axis, by 1 / cos of the angle.
    norm = np.sqrt(1 + (reference.rays(camera) ** 2).sum(-1))
    assert mean == pytest.approx(np.exp(-tau * norm).mean(), rel=0.03)


def test_opacity_adds_up_to_the_silhouette():
    """Opacity integrated over the picture is the disc's area in pixels, streaked or not."""
    camera = make_camera(width=300, height=300, focal_px=800.0, aperture_m=0.0)
    area_px = np.pi / 4 * (0.004 * 800 / 3.0) ** 2
    for velocity in ((0, 0, 0), (3.0, 5.0, 0), (0, 9.0, -12.0)):
        for exposure_s in (0.001, 0.005):
            moved = make_camera(300, 300, 800.0, exposure_s=exposure_s, aperture_m=0.0)
            particle = [[0.01, -0.02, 3.0, *velocity, 0.004]]
            missing = 1 - transmittance(particle, moved)
            assert missing.sum() == pytest.approx(area_px, rel=0.02)
    assert (1 - transmittance([[0, 0, 3.0, 0, 0, 0, 0.004]], camera)).max() > 0.15


def test_a_turning_camera_streaks_still_particles():
    camera = make_camera(
        400, 300, 400.0, exposure_s=0.01, angular_velocity_rad_per_s=np.array([0.0, 0.5, 0.0])
    )
    splat = project([[0.0, 0.0, 5.0, 0, 0, 0, 0.002]], camera)[0].astype(float)
    still = project([[0.0, 0.0, 5.0, 0, 0, 0, 0.002]], make_camera(400, 300, 400.0))[0]
    assert splat[2] < 0.5 * still[2]  # wider along u
    assert splat[4] == pytest.approx(still[4], rel=1e-3)


def test_turning_and_driving_add_up_with_the_right_signs():
    """The streak against the exact projection of the particle at shutter opening and closing."""
    exposure_s = 0.004
    position, velocity = np.array([0.5, -0.3, 4.0]), np.array([0.8, 5.0, -9.0])
    turning = np.array([0.3, -0.9, 0.5])
    camera = make_camera(
        400, 300, 400.0, exposure_s=exposure_s, angular_velocity_rad_per_s=turning, aperture_m=0.0
    )
    splat = project([[*position, *velocity, 0.001]], camera)[0].astype(float)

    def at(time_s):
        """Picture of the point after the camera has turned for a while."""
        angle = np.linalg.norm(turning) * time_s
        axis = turning / np.linalg.norm(turning)
        point = position + velocity * time_s
        cosine, sine = np.cos(-angle), np.sin(-angle)
        turned = point * cosine + np.cross(axis, point) * sine
        turned += axis * (axis @ point) * (1 - cosine)
        return 400 * turned[:2] / turned[2]

    sweep = at(exposure_s / 2) - at(-exposure_s / 2)
    a, b, c = splat[2:5]
    inverse = np.linalg.inv(np.array([[a, b], [b, c]]))
    expected = np.outer(sweep, sweep) / 12 + 0.3 * np.eye(2)
    np.testing.assert_allclose(inverse, expected, rtol=0.03, atol=0.02)


@pytest.mark.parametrize("velocity", [(0, 0, 0), (40.0, 30.0, -60.0)])
def test_long_exposures_and_fast_turns_stay_finite(velocity):
    """Sweeps of thousands of pixels: every number finite, every row inside the picture."""
    rng = np.random.default_rng(8)
    turning = np.array([4.0, 4.0, 1.0])
    camera = make_camera(
        700, 96, 4000.0, exposure_s=0.1, angular_velocity_rad_per_s=turning, aperture_m=0.01
    )
    position = np.column_stack(
        [rng.normal(0, 1, 5000), rng.normal(0, 1, 5000), rng.uniform(0.5, 60, 5000)]
    )
    particles = np.column_stack(
        [position, np.broadcast_to(velocity, (5000, 3)), rng.uniform(5e-4, 0.015, 5000)]
    )
    for window in ((0, 0, 96, 700), (10, 600, 16, 16), (95, 699, 1, 1)):
        splats = project(particles, camera, window)
        assert np.isfinite(splats).all()
        bands = -(-window[2] // BAND_ROWS)
        by_band, starts = split_by_band(splats, window, bands)
        assert starts[0] == 0
        assert starts[-1] == len(by_band) >= len(splats)
        assert {tuple(s) for s in by_band} == {tuple(s) for s in splats}


def test_the_kernel_s_logarithm():
    x = np.geomspace(0.5, 255, 500).astype(np.float32)
    np.testing.assert_allclose([log(v) for v in x], np.log(x), atol=1e-4)


def test_a_long_wide_streak_is_drawn_in_parts_that_sum_to_the_same():
    """Flat along the sweep, where one Gaussian would rise in the middle; nothing lost or added."""
    camera = make_camera(64, 400, 1000.0, exposure_s=0.01, aperture_m=0.0)
    drop = [[0, 0, 2.0, 0, 20.0, 0, 0.006]]
    splats = project(drop, camera)
    assert len(splats) == 16
    missing = 1 - transmittance(drop, camera)
    assert missing.sum() == pytest.approx(np.pi / 4 * 3.0**2, rel=0.03)
    middle = missing.sum(axis=1)[165:236]
    # The cut of faint footprints leaves a ripple of a tenth; one Gaussian would fall by a third.
    assert np.ptp(middle) < 0.2 * middle.mean()
    short = project([[0, 0, 2.0, 0, 1.0, 0, 0.006]], camera)
    assert len(short) == 1
    assert short[0, 6] > FAINTEST


def fields_of_now(weather, seed, ambience, time_s=1.0):
    air = air_of(weather, time_s, seed)
    return fields_of(weather, seed, air, ambience.axes_world, DEFAULT_OPTIONS, None)


def blown(field):
    """Horizontal velocity of the field's particles, world axes."""
    falls = field.population.fall_speed_m_per_s[:, None] * field.axes_world[2]
    return (field.velocity_world_m_per_s + falls)[0]


def test_wind_blows_to_the_left_of_the_street(ambience):
    """A Weather's wind, through its fields, in world axes: heading x, left y."""
    weather = Weather(rain_mm_per_h=5.0, wind_m_per_s=(1.0, 3.0, 0.0))
    (field,) = fields_of_now(weather, 0, ambience)
    np.testing.assert_allclose(blown(field), [1.0, 3.0, 0.0])
    turned = replace(ambience, axes_world=np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    (field,) = fields_of_now(weather, 0, turned)
    np.testing.assert_allclose(blown(field), [-3.0, 1.0, 0.0])


def test_large_near_flakes_cover_the_label(ambience):
    """In a snowstorm some flake hides a thousandth of a small picture: its middle is ignored."""
    camera = make_camera(320, 240, 900.0, exposure_s=0.0005, aperture_m=0.0)
    label = np.zeros((240, 320), np.uint8)
    covered = 0
    for seed in range(40):
        frame = make_frame(camera, 60, 8.0, label)
        weather = Weather(snow_mm_per_h=4.0)
        shot = render(frame, weather, seed=seed, ambience=ambience, options=AIR_ONLY)
        ignored = shot.label == 255
        covered += ignored.sum()
        assert (shot.transmittance[ignored] < 0.5).all()
        np.testing.assert_array_equal(ignored, shot.invalid == 1)
    assert 0 < covered < 0.05 * 40 * label.size


def test_two_kinds_share_the_budget(ambience):
    camera = make_camera(640, 360, 500.0, exposure_s=0.002)
    storm = Weather(rain_mm_per_h=75.0, snow_mm_per_h=4.0)
    frame = make_frame(camera, 60, 100.0)
    counts = []
    for weather in (Weather(snow_mm_per_h=4.0), storm):
        shot = render(frame, weather, seed=1, ambience=ambience, options=air_only(4_000))
        assert shot.image.shape == (360, 640, 3)
        fields = fields_of_now(weather, 1, ambience)
        counts.append(sum(f.resolve(camera, 4_000 // len(fields)).expected_count for f in fields))
    assert max(counts) <= 4_000


def test_near_flakes_are_bigger_than_far_ones():
    camera = make_camera(400, 300, 400.0, aperture_m=0.0)
    sizes = [(1 - transmittance([[0, 0, z, 0, 0, 0, 0.01]], camera)).sum() for z in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(np.divide(sizes[:2], sizes[1:]), 4, rtol=0.05)


def test_surfaces_hide_the_particles_behind_them():
    camera = make_camera(60, 60, 200.0)
    particle = [[0, 0, 5.0, 0, 0, 0, 0.02]]
    assert transmittance(particle, camera, depth_m=4.8).min() == 1.0
    assert transmittance(particle, camera, depth_m=5.2).min() < 0.9
    half = 1 - transmittance(particle, camera, depth_m=5.0)
    whole = 1 - transmittance(particle, camera, depth_m=9.0)
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-6)


@pytest.mark.parametrize("weather", [Weather.rain("heavy"), Weather.snow("moderate")])
def test_whole_frame_agrees_with_the_reference(weather, ambience):
    """PSNR of at least 55 dB and at most 4 levels, through all stages."""
    rng = np.random.default_rng(9)
    camera = make_camera(200, 120, 400.0, velocity=(9.0, 0, 0), exposure_s=0.001)
    depth = rng.uniform(3, 60, (120, 200)).astype(np.float32)
    image = rng.integers(20, 200, (120, 200, 3), dtype=np.uint8)
    frame = make_frame(camera, image, depth)
    weather = replace(weather, overcast=0.0, spray_per_km=0.0)
    options = air_only(2_000)
    shot = render(frame, weather, seed=4, ambience=ambience, options=options)

    (field,) = fields_of_now(weather, 4, ambience)
    resolved = field.resolve(camera, options.max_particles)
    particles = field.particles(camera, frame.time_s, resolved, (0, 0, 120, 200))
    bins = len(resolved.optical_depth) - 1

    def carried(z):
        return resolved.optical_depth[np.minimum(z / 60 * bins, bins).astype(int)]

    def air(z, ray):
        extinction = field.population.extinction_per_m
        up = np.array([0, -1.0, 0])
        haze = weather.mist_per_km * 1e-3
        return np.exp(-optical_depth(z, ray, up, 0.0, 0.0, haze, extinction, carried))

    optical_depth = reference.optical_depth
    colour = particle_colour(field.population.kind, ambience)

    def colour_at(position):
        ray = position[:2] / position[2]
        through = air(position[2], ray)
        return through * colour + (1 - through) * ambience.airlight

    through = air(depth.astype(float), reference.rays(camera))
    light = through[..., None] * reference.linear(image)
    light += (1 - through[..., None]) * ambience.airlight
    expected_through = through.copy()
    reference.splat(light, expected_through, depth, particles.astype(float), camera, colour_at)
    expected = np.round(reference.srgb(light))
    error = expected - shot.image
    assert len(particles) > 300
    assert np.abs(error).max() <= 4
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 55
    np.testing.assert_allclose(expected_through, shot.transmittance, atol=0.02)


def test_drops_and_flakes_are_darker_than_the_sky_and_brighter_than_a_black_wall(ambience):
    for colour in (rain_colour(ambience), snow_colour(ambience)):
        assert (colour < 0.98 * ambience.sky + 1e-9).all()
        assert (colour > ambience.ground).all()


def test_bands_do_not_show(ambience):
    """A picture is the same whether a row is the first or the last of its band."""
    camera = make_camera(96, 80, exposure_s=0.003)
    frame = make_frame(camera, 60, 30.0)
    weather = Weather.snow("heavy")
    whole = render(frame, weather, seed=1, ambience=ambience)
    for top in (1, 7, 15, 16, 40):
        part = render(frame, weather, seed=1, ambience=ambience, window=(top, 3, 33, 80))
        np.testing.assert_array_equal(whole.image[top : top + 33, 3:83], part.image)
        np.testing.assert_array_equal(whole.transmittance[top : top + 33, 3:83], part.transmittance)
        np.testing.assert_array_equal(whole.invalid[top : top + 33, 3:83], part.invalid)
