from dataclasses import replace

import numpy as np
import pytest
from particle_scene import camera, field, inside, seen

from weather_aug.particles import resolve as resolving
from weather_aug.particles import statistics
from weather_aug.particles.resolve import FAR_M, NEAR_FULL_M, NEAR_M


def test_budget_is_kept_and_used():
    cam = camera(width=1024, height=512)
    for budget in (5_000, 50_000):
        resolved = field(statistics.snow(4.0)).resolve(cam, budget)
        assert 0.95 * budget < resolved.expected_count <= budget


@pytest.mark.parametrize("rate", [5.0, 20.0, 50.0])
@pytest.mark.parametrize("budget", [300, 3_000])
def test_a_small_budget_is_used_in_dense_snow(rate, budget):
    """Near flakes are equally opaque, so that no threshold lets in only some of them."""
    resolved = field(statistics.snow(rate)).resolve(camera(), budget)
    assert 0.95 * budget < resolved.expected_count <= budget


@pytest.mark.parametrize(("rate", "reference"), [(2.5, 17_000), (10.0, 68_000), (50.0, 308_000)])
def test_drops_that_a_driving_camera_resolves(rate, reference):
    """KITTI's camera at 10 m/s, counted before by integrating over the mean image streak.

    With an even threshold; ours asks more of what is far.
    """
    cam = camera(speed=10.0, width=1242, height=375, exposure_s=0.002)
    focal = np.diag([721.0, 721.0, 1.0]) + np.array([[0, 0, 621], [0, 0, 187], [0, 0, 0.0]])
    cam = replace(cam, intrinsics=focal)
    resolved = field(statistics.rain(rate)).resolve(cam, 500_000)
    assert resolved.alpha_min == 0.01
    assert 0.3 * reference < resolved.expected_count < 1.1 * reference


def test_motion_along_the_view_hides_no_drops():
    """Twice the speed towards drops must not cost most of them, as twice the streak would."""
    still, fast = (
        field(statistics.rain(20.0)).resolve(camera(speed=v, exposure_s=0.005), 500_000)
        for v in (0.0, 15.0)
    )
    assert fast.expected_count > 0.2 * still.expected_count


def at(resolved, depth_m):
    """Optical depth of drawn particles up to a depth, between the table's entries."""
    depths = np.linspace(0, FAR_M, len(resolved.optical_depth))
    return np.interp(depth_m, depths, resolved.optical_depth)


def opacity(depth_m, reach_m):
    """Of a particle that fades in and out: written down once more, as a reference."""
    rise = np.clip((depth_m - NEAR_M) / (NEAR_FULL_M - NEAR_M), 0, 1)
    return rise * np.clip((reach_m - depth_m) / (0.15 * reach_m), 0, 1)


def test_the_table_is_exact_for_its_own_sizes():
    population = statistics.rain(20.0)
    cam = camera(speed=5.0, width=1024, height=512)
    resolved = field(population).resolve(cam, 50_000)
    per_size = population.density_per_m3 / 16
    depths = np.linspace(0, FAR_M, len(resolved.optical_depth))
    fine = np.linspace(0, FAR_M, 120_001)
    for k in (3, 9, 13):
        alone = replace(population, density_per_m3=np.where(np.arange(14) == k, per_size * 16, 0))
        table = resolving.kernels.resolved_optical_depth(
            alone.diameters_m,
            alone.density_per_m3 / 16,
            resolved.reach_m.astype(float),
            NEAR_M,
            NEAR_FULL_M,
            0.15,
            FAR_M,
            len(depths) - 1,
        )
        rate = np.zeros_like(fine)
        for d, limit in zip(population.diameters_m[k], resolved.reach_m[k], strict=True):
            if limit > 0:
                rate += per_size[k] * np.pi / 4 * d**2 * opacity(fine, float(limit))
        steps = 0.5 * (rate[1:] + rate[:-1]) * (fine[1] - fine[0])
        expected = np.interp(depths, fine, np.concatenate([[0], np.cumsum(steps)]))
        np.testing.assert_allclose(table, expected, atol=2e-5 * expected[-1])


@pytest.mark.parametrize(
    "population", [statistics.rain(20.0), statistics.snow(4.0), statistics.snow(4.0, wetness=0.6)]
)
def test_drawn_particles_carry_the_optical_depth_of_the_table(population):
    """Monte Carlo: sum of opacity times silhouette over the area of the view at its depth."""
    cam = camera(width=320, height=192)
    resolved = field(population).resolve(cam, 20_000)
    near_m, far_m = 2.0, 20.0
    (fx, fy) = cam.focal_px
    solid = cam.width * cam.height / (fx * fy)
    sums = []
    for seed in range(12):
        found = seen(population, cam, 1.0, resolved, seed=seed).astype(float)
        found = found[inside(found, cam)]
        found = found[(found[:, 2] > near_m) & (found[:, 2] < far_m)]
        tx, ty = found[:, 0] / found[:, 2], found[:, 1] / found[:, 2]
        # Shadow on the plane of equal depth: the covariance projected along the line of sight.
        xx, xy, xz, yy, yz, zz = found[:, 6:12].T
        a, c = xx - 2 * tx * xz + tx**2 * zz, yy - 2 * ty * yz + ty**2 * zz
        b = xy - tx * yz - ty * xz + tx * ty * zz
        shadow = 2 * np.pi * np.sqrt(a * c - b * b) / np.sqrt(1 + tx**2 + ty**2)
        sums.append((found[:, 12] * shadow / (solid * found[:, 2] ** 2)).sum())
    expected = at(resolved, far_m) - at(resolved, near_m)
    error = np.std(sums, ddof=1) / np.sqrt(len(sums))
    assert error < 0.02 * expected
    assert abs(np.mean(sums) - expected) < 4 * error


def test_the_same_camera_and_weather_are_solved_once():
    """And another number that matters is another solution."""
    resolving._resolved.cache_clear()
    cam, population = camera(speed=5.0), statistics.rain(7.0)
    first = field(population).resolve(cam, 5_000)
    moved = camera(speed=5.0, centre=(30.0, 2.0, 1.5))
    assert field(statistics.rain(7.0), seed=9).resolve(moved, 5_000) is first
    with pytest.raises(ValueError, match="read-only"):
        first.reach_m[0, 0] = 1.0
    others = [
        field(statistics.rain(7.1)).resolve(cam, 5_000),
        field(population).resolve(camera(speed=5.1), 5_000),
        field(population).resolve(cam, 5_001),
        field(population).resolve(replace(cam, exposure_s=0.004), 5_000),
        field(population).resolve(cam.resized(320, 192), 5_000),
        field(population, wind=(0.0, 1.0, 0.0)).resolve(cam, 5_000),
    ]
    assert len({id(r) for r in (first, *others)}) == 7
    assert resolving._resolved.cache_info().misses == 7
