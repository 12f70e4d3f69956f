"""The compiled enumeration of cubes against slow, plain references."""

from dataclasses import replace

import numpy as np
import pytest
from particle_scene import AXES, camera, field, seen, steady, whole
from scipy import stats

from weather_aug._keys import key_of
from weather_aug.particles import field as fields
from weather_aug.particles import kernels, statistics
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import NEAR_M

WORD = 2**64 - 1


def mixed(word):
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & WORD
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & WORD
    return word ^ (word >> 31)


def reference(population, seed, cam, time_s, reach_m):
    """Places, camera axes, of all particles of class 2 without sway, one cube after the other."""
    c = 2
    cell = population.cell_m[c]
    mean = population.density_per_m3[c] * cell**3
    class_key = key_of(population.kind, seed, c) % 2**64
    pose = cam.world_from_camera
    fallen = np.array([0, 0, -population.fall_speed_m_per_s[c] * time_s])
    middle = np.floor((pose[:3, 3] - fallen) / cell).astype(int)
    half = int(np.ceil(2 * reach_m / cell)) + 1
    found = []
    for ix, iy, iz in np.ndindex(*[2 * half + 1] * 3):
        index = [int(v) for v in middle + np.array([ix, iy, iz]) - half]
        key = (class_key + index[0] * 0xD6E8FEB86659FD93) & WORD
        key = mixed(key) + index[1] * 0xA0761D6478BD642F & WORD
        key = mixed(mixed(key) + index[2] * 0xE7037ED1A0B428DB & WORD)
        many = int(stats.poisson.ppf(key / 2**64, mean)) if key / 2**64 > np.exp(-mean) else 0
        for slot in range(1, many + 1):
            word = mixed((key + slot * 0x9E3779B97F4A7C15) & WORD)
            inside = np.array([word >> s & 0xFFFFF for s in (4, 24, 44)]) / 2**20
            point = (index + inside) * cell + fallen
            found.append((point - pose[:3, 3]) @ pose[:3, :3])
    return np.array(found)


def still(population):
    none = np.zeros_like(population.sway_m)
    return replace(population, sway_m=none, sway_per_wind_s=none)


def test_the_kernel_finds_what_a_plain_loop_finds():
    """Every particle in view, each at its place, to float32 precision."""
    population, time_s, reach_m = still(statistics.rain(20.0)), 3.7, 1.5
    cam = camera(yaw_deg=33.0, centre=(120.0, -40.0, 1.5))
    reach = np.zeros(population.diameters_m.shape, np.float32)
    reach[2] = reach_m
    resolved = replace(field(population).resolve(cam, 10), reach_m=reach)
    found = seen(population, cam, time_s, resolved)[:, :3]
    expected = reference(population, 1, cam, time_s, reach_m)
    (fx, fy), (cx, cy) = cam.focal_px, cam.principal_px
    x, y, z = expected.T
    u, v = fx * x / z + cx, fy * y / z + cy
    clear = (z > NEAR_M) & (z < reach_m) & (u > 0) & (u < cam.width) & (v > 0) & (v < cam.height)
    expected = expected[clear]
    assert len(expected) > 30
    distance = np.linalg.norm(expected[:, None] - found[None], axis=-1)
    assert distance.min(axis=1).max() < 4e-7
    # And what it finds besides lies just outside the picture.
    assert len(expected) <= len(found) < 4 * len(expected)


@pytest.mark.parametrize("population", [statistics.rain(50.0), statistics.snow(2.0)])
@pytest.mark.parametrize("yaw_deg", [0.0, 45.0, 200.0])
def test_culling_of_cubes_loses_nothing(monkeypatch, population, yaw_deg):
    """With planes and bounds moved out by metres the same particles come, bit for bit."""
    cam = camera(yaw_deg=yaw_deg, speed=10.0, angular_velocity_rad_per_s=np.array([0, 0.5, 0]))
    air = steady((4.0, -9.0, 0.0), 2.0)
    this = ParticleField(population, 3, air, AXES)
    resolved = this.resolve(cam, 10)
    resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 3.0))
    tight = this.particles(cam, 2.0, resolved, (30, 50, 24, 40))
    exact = fields._planes_and_bounds

    def moved(by_m):
        def planes_and_bounds(*args):
            planes, bounds = exact(*args)
            planes[:, :, 3] += by_m
            bounds += by_m * np.array([-1.0, 1.0])[None, :, None]
            return planes, bounds

        return planes_and_bounds

    monkeypatch.setattr(fields, "_planes_and_bounds", moved(2.0))
    np.testing.assert_array_equal(tight, this.particles(cam, 2.0, resolved, (30, 50, 24, 40)))
    # Planted fault: planes without the half cube cut particles off.
    monkeypatch.setattr(fields, "_planes_and_bounds", moved(-0.3))
    assert len(this.particles(cam, 2.0, resolved, (30, 50, 24, 40))) < len(tight)


def test_counts_of_cubes_are_poisson():
    """The distribution function against scipy's, from rare to crowded cubes."""
    means = (1e-5, 0.3, 7.0, 300.0)
    counts = fields._counts(means)
    for row, mean in zip(counts, means, strict=True):
        shares = row[:-1].astype(float) / 2**64
        expected = stats.poisson(mean).cdf(np.arange(len(shares)))
        np.testing.assert_allclose(shares, expected, atol=1e-13)
        assert (np.diff(row.astype(object)) >= 0).all() and row[-1] == WORD


def test_a_higher_mean_never_takes_a_particle_away():
    """At every word the count rises with the mean: what nests severities."""
    counts = fields._counts(tuple(np.geomspace(0.01, 50, 40)))
    words = np.random.default_rng(0).integers(0, 2**64, 500, dtype=np.uint64)
    many = (words[:, None, None] > counts[None]).sum(axis=2)
    assert (np.diff(many, axis=1) >= 0).all()
    assert many.max() > 40


def test_one_compiled_kernel_serves_all_fields():
    """Rain, snow, carried fields, windows: else a worker compiles again in the middle of a run."""
    cam = camera()
    for population in (statistics.rain(20.0), statistics.snow(2.0, wetness=0.4)):
        for motion in (None, np.eye(4)):
            this = field(population, field_from_world=motion)
            resolved = this.resolve(cam, 1_000)
            this.particles(cam, 1.0, resolved, whole(cam))
            this.particles(cam, 1, resolved, (10, 20, 30, 40))
    for kernel in (kernels.scatter, kernels.solve_reach, kernels.resolved_optical_depth):
        assert len(kernel.signatures) == 1
