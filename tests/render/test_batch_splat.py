"""Gaussians on the picture in torch: against the slow reference, and against sampling."""

import numpy as np
import pytest
import torch
from oracles import reference_render as reference
from render_scene import make_camera
from scipy.special import erf

from weather_aug.render import batch_project
from weather_aug.render.batch_medium import AirColumn
from weather_aug.render.batch_project import project
from weather_aug.render.batch_splat import splat

VACUUM = AirColumn(0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 3.0, torch.zeros(2), (0.0, -1.0, 0.0))
WHITE, BLACK = torch.ones(3), torch.zeros(3)


def records_of(discs):
    """(N, 13) records of (N, 7) position, velocity, diameter: solid round discs."""
    records = np.zeros((len(discs), 13), np.float32)
    records[:, :6] = discs[:, :6]
    records[:, [6, 9, 11]] = discs[:, 6:] ** 2 / 8
    records[:, 12] = 1
    return records


def discs(count, seed=0):
    """(N, 13) records of discs in front of the default camera."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.6, 12, count)
    x, y = (rng.uniform(-0.7, 0.7, (2, count))) * z
    velocity = rng.normal(0, 4, (3, count))
    diameter = rng.uniform(0.002, 0.02, count)
    return records_of(np.stack([x, y, z, *velocity, diameter], axis=1))


def projected(particles, camera, **kwargs):
    records = torch.from_numpy(particles)
    return project(records, camera, VACUUM, WHITE, BLACK, **kwargs).far_to_near()


def surfaces(camera, seed=1):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 14, (camera.height, camera.width)).astype(np.float32)
    depth[:20] = np.inf
    return depth


@pytest.mark.parametrize("motion", [(0.0, 0, 0), (0.3, -1.0, 0.5)])
def test_agrees_with_the_slow_reference(motion):
    camera = make_camera(angular_velocity_rad_per_s=np.array(motion))
    particles, depth = discs(150), surfaces(camera)
    light, through = np.zeros((96, 160, 3)), np.ones((96, 160))
    scene = (particles.astype(float), camera, lambda _: np.ones(3))
    reference.splat(light, through, depth, *scene)
    layer = splat(projected(particles, camera), torch.from_numpy(depth))
    assert through.min() < 0.7
    # The footprint's rows narrow to nothing at its ends, where the reference's are cut at 1/255.
    assert np.abs(layer.through.numpy() - through).max() < 0.01
    assert np.abs(layer.through.numpy() - through).mean() < 1e-4
    assert np.abs(layer.light.numpy() - light.transpose(2, 0, 1)).max() < 0.01
    wrong = splat(projected(particles, camera, compensate=False), torch.from_numpy(depth))
    assert np.abs(wrong.through.numpy() - through).max() > 0.1


def test_nearer_particles_cover_farther_ones():
    """Two opaque discs on the axis, of different colour: order decides."""
    camera = make_camera(aperture_m=0.0)
    near = np.array([[0, 0, 2.0, 0, 0, 0, 0.5]], np.float32)
    far = np.array([[0, 0, 6.0, 0, 0, 0, 1.5]], np.float32)
    red, blue = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1.0])
    parts = [
        project(torch.from_numpy(records_of(rows)), camera, VACUUM, colour, BLACK)
        for rows, colour in ((near, red), (far, blue))
    ]
    depth = torch.full((96, 160), torch.inf)
    layer = splat(batch_project.concatenated(parts).far_to_near(), depth)
    assert layer.light[0, 48, 80] > 0.95
    assert layer.light[2, 48, 80] < 0.05
    assert layer.covered[48, 80]
    assert not layer.covered[0, 0]
    wall = splat(batch_project.concatenated(parts).far_to_near(), torch.full((96, 160), 4.0))
    assert (wall.light[2] == 0).all()


def test_memory_bounds_do_not_change_the_picture():
    camera = make_camera()
    splats, depth = projected(discs(400), camera), torch.from_numpy(surfaces(camera))
    whole, again = splat(splats, depth), splat(splats, depth)
    assert torch.equal(whole.light, again.light)
    for limit in (1, 777):
        parts = splat(splats, depth, fragments_at_once=limit)
        torch.testing.assert_close(parts.light, whole.light, atol=1e-5, rtol=0)
        torch.testing.assert_close(parts.through, whole.through, atol=1e-5, rtol=0)
        assert torch.equal(parts.covered, whole.covered)


def test_no_splats_leave_the_picture_alone():
    camera = make_camera()
    aside = records_of(np.array([[50.0, 0, 1.0, 0, 0, 0, 0.01]], np.float32))
    layer = splat(projected(aside, camera), torch.from_numpy(surfaces(camera)))
    assert (layer.through == 1).all()
    assert (layer.light == 0).all()


def test_a_general_covariance_is_that_of_projected_points():
    """Against 2e5 points of the 3D Gaussian, each projected by itself."""
    rng = np.random.default_rng(2)
    camera = make_camera(focal_px=400.0, aperture_m=0.0)
    mean, axes = np.array([0.4, -0.3, 3.0]), rng.normal(0, 0.02, (3, 3))
    covariance = axes @ axes.T
    upper = covariance[np.triu_indices(3)]
    record = np.concatenate([mean, np.zeros(3), upper, [1.0]])[None].astype(np.float32)
    splats = project(torch.from_numpy(record), camera, VACUUM, WHITE, BLACK)
    points = mean + rng.normal(size=(200_000, 3)) @ axes.T
    pixels = 400.0 * points[:, :2] / points[:, 2:]
    a, b, c = splats.conic[0].double().tolist()
    found = np.linalg.inv([[a, b], [b, c]]) - 0.3 * np.eye(2)
    expected = np.cov(pixels.T)
    np.testing.assert_allclose(found, expected, atol=0.02 * np.trace(expected))
    assert abs(expected[0, 1]) > 0.1 * np.trace(expected)


def streak(camera, sweep_px):
    """(1, 13) record of a disc of 8 mm at 1 m that sweeps to the right, and its width in pixels."""
    speed = sweep_px / camera.exposure_s / camera.focal_px[0]
    record = records_of(np.array([[0, 0, 1, speed, 0, 0, 0.008]], np.float32))
    return torch.from_numpy(record), 0.008 / np.sqrt(8) * camera.focal_px[0]


def test_parts_of_a_streak_are_nearer_to_the_sweep_than_one_gaussian(monkeypatch):
    """The truth is a Gaussian swept uniformly: a difference of error functions."""
    camera = make_camera(640, 96, focal_px=900.0, aperture_m=0.0)
    sweep_px = 100.0
    record, sharp_px = streak(camera, sweep_px)
    width_px = np.hypot(sharp_px, np.sqrt(0.3))
    along = np.arange(640) - 319.5
    edges = (along + sweep_px / 2, along - sweep_px / 2)
    profile = np.subtract(*(erf(e / width_px / np.sqrt(2)) for e in edges)) / 2
    # Energy across the streak: a row of pixels is one unit wide.
    truth = profile * 2 * np.pi * sharp_px**2 / sweep_px
    depth = torch.full((96, 640), torch.inf)
    errors, totals = [], []
    for limit in (12.0, float("inf")):
        monkeypatch.setattr(batch_project, "LONG_SWEEP_PX", limit)
        splats = project(record, camera, VACUUM, WHITE, BLACK)
        assert (len(splats) > 1) == (limit == 12.0)
        alpha = -torch.log(splat(splats.far_to_near(), depth).through).sum(dim=0).numpy()
        errors.append(np.abs(alpha - truth).sum() / truth.sum())
        totals.append(alpha.sum() / truth.sum())
    assert errors[0] < 0.5 * errors[1]
    assert abs(totals[0] - 1) < 0.05


def test_at_most_sixteen_parts_and_only_of_wide_long_streaks():
    camera = make_camera(20_000, 96, focal_px=900.0, aperture_m=0.0)
    counts = []
    for sweep_px in (10.0, 40.0, 5000.0):
        record, _ = streak(camera, sweep_px)
        counts.append(len(project(record, camera, VACUUM, WHITE, BLACK)))
    assert counts == [1, 6, 16]
    coarse = make_camera(focal_px=200.0)
    thin, _ = streak(coarse, 40.0)
    assert len(project(thin, coarse, VACUUM, WHITE, BLACK)) == 1
