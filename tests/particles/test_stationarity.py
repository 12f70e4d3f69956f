"""The field has no memory: uniform at any time, and never the same twice along a drive."""

from dataclasses import replace

import numpy as np
from particle_scene import camera, field, seen, world
from scipy import stats

from weather_aug.particles import statistics

CELLS = 5


def uniformity(points, low, size):
    """p-value that points of a box fall evenly on its 5^3 cells."""
    index = np.floor((points - low) / size * CELLS).astype(int)
    index = index[((index >= 0) & (index < CELLS)).all(axis=1)]
    counts = np.zeros((CELLS,) * 3)
    np.add.at(counts, tuple(index.T), 1)
    mean = counts.mean()
    assert mean > 5
    return stats.chi2(counts.size - 1).sf(((counts - mean) ** 2 / mean).sum())


def test_uniform_in_the_world_at_any_time_and_along_a_turning_path():
    """Chi-squared of counts in a box before the camera at 0, 1.3 and 37.2 s."""
    population = statistics.snow(4.0)
    low, size = np.array([4.0, -1.6, -0.1]), 3.2
    for time_s, x, yaw_deg in ((0.0, 0.0, 0.0), (1.3, 11.0, 15.0), (37.2, 400.0, 77.0)):
        points = []
        for seed in range(4):
            cam = camera(yaw_deg=yaw_deg, centre=(x, 0, 1.5), width=400, height=400)
            resolved = field(population, seed).resolve(cam, 1_000)
            resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 9.0))
            found = seen(population, cam, time_s, resolved, seed=seed, wind=(1.0, 2.0, 0.0))
            turn = cam.world_from_camera[:3, :3] @ np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
            # A box in the world that stands before the camera, in the camera's own heading.
            points.append((world(found, cam) - (x, 0, 0)) @ turn)
        assert uniformity(np.concatenate(points), low, size) > 0.01


def recycled(count, box_m, speed_m_per_s, step_s, steps):
    """The paper's rule: what has left below starts again at the top, its overshoot forgotten."""
    places = np.random.default_rng(1).uniform(0, box_m, (count, 3))
    for _ in range(steps):
        places[:, 2] -= speed_m_per_s * step_s
        places[places[:, 2] < 0, 2] = box_m
    return places


def test_the_recycling_of_the_paper_is_not_uniform():
    """Planted fault: sheets of particles that left in the same frame."""
    points = recycled(20_000, 4.0, 3.0, 0.1, 60)
    assert uniformity(points, np.zeros(3), 4.0) < 1e-6
    fresh = recycled(20_000, 4.0, 3.0, 0.1, 0)
    assert uniformity(fresh, np.zeros(3), 4.0) > 0.01


def repetition(population, period_m, wrap):
    """Correlation of the layer's opacity over a drive with itself one period later."""
    speed, step_m, frames = 15.0, 4.0, 200
    layer = []
    for k in range(frames):
        x = k * step_m
        cam = camera(centre=(x % period_m if wrap else x, 0, 1.5), speed=speed)
        # Without fall or wind the air of a periodic field would come back unchanged.
        resolved = field(population).resolve(cam, 600)
        found = seen(population, cam, 0.0, resolved)
        layer.append((found[:, 12] * found[:, 6] / found[:, 2] ** 2).sum())
    layer = np.array(layer) - np.mean(layer)
    lag = round(period_m / step_m)
    return float((layer[lag:] * layer[:-lag]).mean() / layer.var())


def test_a_drive_never_meets_the_same_particles_again():
    """Autocorrelation of the particle layer at the lag of a 40 m box; a wrapped one repeats."""
    population = statistics.snow(2.0)
    assert abs(repetition(population, 40.0, wrap=False)) < 0.2
    assert repetition(population, 40.0, wrap=True) > 0.9


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
