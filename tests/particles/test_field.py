from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from weather_aug.clip.types import Camera
from weather_aug.particles import kernels, statistics
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import FAR_M, NEAR_M

AXES = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""world_from_camera rotation of a camera that looks along x, with z up."""


def camera(yaw_deg=0.0, centre=(0, 0, 1.5), speed=0.0, width=160, height=96, **kwargs):
    yaw = np.radians(yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ FORWARD
    pose[:3, 3] = centre
    focal = 0.75 * width
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    kwargs = {"velocity_m_per_s": np.array([speed, 0.0, 0.0])} | kwargs
    return Camera(intrinsics, pose, width, height, **kwargs)


def field(population, seed=1, wind=(0.0, 0.0, 0.0)):
    return ParticleField(population, seed, np.array(wind), AXES)


def whole(cam):
    return (0, 0, cam.height, cam.width)


def world(particles, cam):
    pose = cam.world_from_camera
    return particles[:, :3].astype(float) @ pose[:3, :3].T + pose[:3, 3]


def inside(particles, cam):
    u = cam.focal_px[0] * particles[:, 0] / particles[:, 2] + cam.principal_px[0]
    v = cam.focal_px[1] * particles[:, 1] / particles[:, 2] + cam.principal_px[1]
    return (u >= -0.5) & (u < cam.width - 0.5) & (v >= -0.5) & (v < cam.height - 0.5)


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


def test_budget_is_kept_and_used():
    cam = camera(width=1024, height=512)
    for budget in (5_000, 50_000):
        resolved = field(statistics.snow(4.0)).resolve(cam, budget)
        assert 0.95 * budget < resolved.expected_count <= budget


@pytest.mark.parametrize("budget", [10_000, 50_000, 200_000])
@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_optical_depth_of_resolved_particles_is_their_area(kind, budget):
    """The table equals the sum of silhouettes of everything drawn, whatever the budget."""
    population = getattr(statistics, kind)(4.0)
    cam = camera(width=1024, height=512, exposure_s=0.002)
    resolved = field(population).resolve(cam, budget)
    per_size = population.density_per_m3[:, None] / population.diameters_m.shape[1]
    bins = len(resolved.optical_depth) - 1
    for index in (85, 341, bins):
        depth_m = index * FAR_M / bins
        to = np.clip(np.minimum(resolved.reach_m, depth_m) - NEAR_M, 0, None)
        expected = (per_size * np.pi / 4 * population.diameters_m**2 * to).sum()
        actual = resolved.optical_depth[index]
        total = population.extinction_per_m * depth_m
        assert actual == pytest.approx(expected, rel=1e-4)
        assert 0 < actual < total


def test_uniform_in_the_world_at_any_time():
    """Counts in cubes of a fixed box are Poisson at t = 0, 1.3 and 37.2 s, also while driving."""
    population = statistics.snow(4.0)
    cells = np.array([5, 5, 5])
    for time_s, x in ((0.0, 0.0), (1.3, 11.0), (37.2, 400.0)):
        counts = np.zeros(cells)
        for seed in range(6):
            this = field(population, seed, wind=(1.0, 2.0, 0.0))
            cam = camera(centre=(x, 0, 1.5), width=400, height=400)
            resolved = this.resolve(cam, 60_000)
            # Only the largest class, which is drawn far out: its box lies inside its reach.
            reach = np.where(np.arange(len(resolved.reach_m))[:, None] == 11, resolved.reach_m, 0)
            resolved = replace(resolved, reach_m=reach.astype(np.float32))
            points = world(this.particles(cam, time_s, resolved, whole(cam)), cam)
            box = (points - (x + 6.0, -2.0, -0.5)) / (4.0, 4.0, 4.0) * cells
            index = np.floor(box).astype(int)
            index = index[((index >= 0) & (index < cells)).all(axis=1)]
            np.add.at(counts, tuple(index.T), 1)
        mean = counts.mean()
        assert mean > 2
        chi2 = ((counts - mean) ** 2 / mean).sum()
        assert 1e-4 < stats.chi2(counts.size - 1).cdf(chi2) < 1 - 1e-4


def test_particles_move_with_fall_speed_and_wind_and_nothing_else():
    population = replace(statistics.rain(20.0), sway_m=0.0)
    wind = np.array([0.5, 1.5, 0.0])
    this, cam = field(population, wind=wind), camera()
    resolved = this.resolve(cam, 5_000)
    before = this.particles(cam, 5.0, resolved, whole(cam))
    after = this.particles(cam, 5.01, resolved, whole(cam))
    moved = world(before, cam) + before[:, 3:6] @ cam.world_from_camera[:3, :3].T * 0.01
    distance = np.linalg.norm(moved[:, None] - world(after, cam)[None], axis=-1)
    stays = inside(before, cam) & (before[:, 2] > 1) & (before[:, 2] < 4)
    assert stays.sum() > 20
    assert np.quantile(distance.min(axis=1)[stays], 0.97) < 1e-4
    fall = -(before[:, 3:6] @ cam.world_from_camera[:3, :3].T - wind)[:, 2]
    assert set(np.round(fall, 3)) <= set(np.round(population.fall_speed_m_per_s, 3))


def test_any_time_can_be_asked_for_alone():
    this, cam = field(statistics.snow(2.0)), camera()
    resolved = this.resolve(cam, 5_000)
    sequence = [this.particles(cam, 0.1 * k, resolved, whole(cam)) for k in range(12)]
    alone = field(statistics.snow(2.0)).particles(cam, 0.1 * 7, resolved, whole(cam))
    np.testing.assert_array_equal(sequence[7], alone)


def test_two_cameras_see_the_same_particles():
    """Positions in the world of all that both cameras see agree to float32 precision."""
    this = field(statistics.snow(2.0), wind=(0.3, 0.1, 0))
    front, side = camera(), camera(yaw_deg=40, centre=(0.1, 0.3, 1.5))
    seen = []
    for cam, other in ((front, side), (side, front)):
        resolved = this.resolve(cam, 50_000)
        # One reach for both: what a camera resolves depends on where it stands.
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 4.0))
        points = world(this.particles(cam, 2.0, resolved, whole(cam)), cam)
        pose = other.world_from_camera
        in_other = (points - pose[:3, 3]) @ pose[:3, :3]
        both = in_other[:, 2] > NEAR_M
        both &= inside(np.where(both[:, None], in_other, (0, 0, -1.0)), other)
        in_own = (points - cam.world_from_camera[:3, 3]) @ cam.world_from_camera[:3, :3]
        both &= inside(in_own, cam) & (in_own[:, 2] > 1) & (in_other[:, 2] > 1)
        both &= (in_own[:, 2] < 3) & (in_other[:, 2] < 3)
        seen.append(points[both])
    assert len(seen[0]) > 30
    assert abs(len(seen[0]) - len(seen[1])) <= 0.01 * len(seen[0])
    distance = np.linalg.norm(seen[0][:, None] - seen[1][None], axis=-1).min(axis=1)
    assert np.mean(distance < 1e-5) > 0.99


@pytest.mark.parametrize(("rate", "reference"), [(2.5, 17_000), (10.0, 68_000), (50.0, 308_000)])
def test_drops_that_a_driving_camera_resolves(rate, reference):
    """KITTI's camera at 10 m/s, counted before by integrating over the mean image streak."""
    cam = camera(speed=10.0, width=1242, height=375, exposure_s=0.002)
    focal = np.diag([721.0, 721.0, 1.0]) + np.array([[0, 0, 621], [0, 0, 187], [0, 0, 0.0]])
    cam = replace(cam, intrinsics=focal)
    resolved = field(statistics.rain(rate)).resolve(cam, 500_000)
    assert resolved.alpha_min == 0.01
    assert 0.5 * reference < resolved.expected_count < 1.6 * reference


def test_motion_along_the_view_hides_no_drops():
    """Twice the speed towards drops must not cost most of them, as twice the streak would."""
    still, fast = (
        field(statistics.rain(20.0)).resolve(camera(speed=v, exposure_s=0.005), 500_000)
        for v in (0.0, 15.0)
    )
    assert fast.expected_count > 0.2 * still.expected_count


def test_wind_given_as_drift_changes_streaks_but_no_place():
    """The same air under another wind: a severity sweep adds drops and moves none."""
    cam = camera()
    drift = np.array([1.0, 2.0, 0.0])
    calm, storm = (
        ParticleField(statistics.rain(20.0), 1, np.array(wind), AXES, drift)
        for wind in ((0.0, 0.0, 0.0), (0.0, 9.0, 0.0))
    )
    resolved = calm.resolve(cam, 5_000)
    before = calm.particles(cam, 7.0, resolved, whole(cam))
    after = storm.particles(cam, 7.0, resolved, whole(cam))
    places = {tuple(row) for row in np.round(after[:, :3], 5)}
    assert np.mean([tuple(row) in places for row in np.round(before[:, :3], 5)]) == 1.0
    assert not np.array_equal(before[:, 3:6], after[: len(before), 3:6])


def test_drift_is_wind_times_time_where_it_is_not_given():
    cam, wind = camera(), np.array([0.5, 1.5, 0.0])
    plain = field(statistics.rain(20.0), wind=wind)
    given = replace(plain, drift_world_m=wind * 4.0)
    resolved = plain.resolve(cam, 5_000)
    np.testing.assert_array_equal(
        plain.particles(cam, 4.0, resolved, whole(cam)),
        given.particles(cam, 4.0, resolved, whole(cam)),
    )


def test_swaying_flakes_move_with_the_velocity_they_report():
    this, cam = field(statistics.snow(2.0), wind=(0.4, 0.2, 0.0)), camera()
    resolved = this.resolve(cam, 5_000)
    before = this.particles(cam, 3.0, resolved, whole(cam))
    after = this.particles(cam, 3.02, resolved, whole(cam))
    moved = before[:, :3] + 0.02 * before[:, 3:6]
    distance = np.linalg.norm(moved[:, None] - after[None, :, :3], axis=-1).min(axis=1)
    stays = inside(before, cam) & (before[:, 2] > 1) & (before[:, 2] < 4)
    assert stays.sum() > 20
    # The sine's table has steps of 0.4 mm.
    assert np.quantile(distance[stays], 0.9) < 1.5e-3


def test_kinds_are_different_fields():
    """Snow is not rain's places with other sizes."""
    cam = camera()
    rain = field(statistics.rain(20.0))
    other = field(replace(statistics.rain(20.0), kind="snow"))
    resolved = rain.resolve(cam, 5_000)
    first, second = (f.particles(cam, 0.0, resolved, whole(cam)) for f in (rain, other))
    assert not {tuple(r) for r in first[:, :3]} & {tuple(r) for r in second[:, :3]}


def test_rare_particles_are_as_rare_as_they_should_be():
    """Cubes that hold 1e-4 particles on average: the first arrival is drawn finely enough."""
    population = statistics.rain(100.0)
    thin = replace(population, density_per_m3=np.full(14, 1e-4) / population.cell_m**3)
    cam = camera(width=600, height=600)
    counts = []
    reach = np.zeros((14, 16), np.float32)
    reach[13] = 60.0
    for seed in range(25):
        resolved = replace(field(population).resolve(cam, 10), reach_m=reach)
        counts.append(
            inside(field(thin, seed).particles(cam, 0.0, resolved, whole(cam)), cam).sum()
        )
    (fx, fy) = cam.focal_px
    volume = 600 * 600 / (fx * fy) * (60.0**3 - NEAR_M**3) / 3
    expected = 25 * volume * thin.density_per_m3[13]
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


def test_seed_and_kind_choose_the_field():
    cam = camera()
    this = field(statistics.rain(20.0), seed=1)
    resolved = this.resolve(cam, 5_000)
    first = this.particles(cam, 0.0, resolved, whole(cam))
    other = field(statistics.rain(20.0), seed=2).particles(cam, 0.0, resolved, whole(cam))
    assert not {tuple(r) for r in first[:, :3]} & {tuple(r) for r in other[:, :3]}


def test_a_window_draws_a_subset_in_the_same_order():
    this, cam = field(statistics.snow(2.0)), camera(speed=10.0)
    resolved = this.resolve(cam, 20_000)
    everything = [tuple(r) for r in this.particles(cam, 1.0, resolved, whole(cam))]
    part = [tuple(r) for r in this.particles(cam, 1.0, resolved, (30, 50, 24, 40))]
    assert 0 < len(part) < len(everything)
    positions = [everything.index(row) for row in part]
    assert positions == sorted(positions)


def test_far_from_the_origin_and_late_the_field_is_as_precise():
    """1e6 m and 1e6 s away, particles still move by v dt."""
    this = field(replace(statistics.rain(20.0), sway_m=0.0))
    cam = camera(centre=(1e6, -2e6, 50.0))
    resolved = this.resolve(cam, 5_000)
    before = this.particles(cam, 1e6, resolved, whole(cam))
    after = this.particles(cam, 1e6 + 0.01, resolved, whole(cam))
    moved = before[:, :3] + 0.01 * before[:, 3:6]
    distance = np.linalg.norm(moved[:, None] - after[None, :, :3], axis=-1).min(axis=1)
    stays = inside(before, cam) & (before[:, 2] > 1) & (before[:, 2] < 4)
    assert stays.sum() > 20
    assert np.quantile(distance[stays], 0.95) < 1e-3


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
