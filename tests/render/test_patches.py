"""Patches: the noise is standard normal at every place, and the fog keeps its mean."""

import numpy as np
import pytest
from render_scene import make_camera

from weather_aug.render import fog, patches
from weather_aug.render.patches import lattice, noise_at

SIDE = 34


@pytest.fixture(scope="module")
def points():
    box = np.empty((SIDE, SIDE, SIDE), np.float32)
    lattice(np.uint64(77), np.array([-9, 4, 1000]), fog._normal_quantiles(), box)
    return box


def noise(points, x, y, z):
    strides = (np.uint64(SIDE * SIDE), np.uint64(SIDE))
    lowest = (np.float32(0), np.float32(0), np.float32(0))
    flat = points.reshape(-1)
    return noise_at(flat, lowest, strides, np.float32(x), np.float32(y), np.float32(z))


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.2, 0.7, 0.05)])
def test_noise_is_standard_normal_at_every_place(points, offset):
    """On a lattice point, in the middle of a cell and anywhere else: mean 0, variance 1."""
    corner = np.arange(0, SIDE - 1, 2)
    values = np.array(
        [
            noise(points, i + offset[0], j + offset[1], k + offset[2])
            for i in corner
            for j in corner
            for k in corner
        ]
    )
    assert values.mean() == pytest.approx(0.0, abs=4 / np.sqrt(len(values)))
    assert values.var() == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(values)))


def test_noise_is_smooth_over_the_faces_of_cells(points):
    rng = np.random.default_rng(0)
    for x, y, z in rng.uniform(2, SIDE - 3, (200, 3)):
        face = np.floor(x)
        step = np.float32(1e-3)
        before, at, after = (noise(points, face + d, y, z) for d in (-step, 0, step))
        assert abs(after - before) < 0.02
        assert abs(after - 2 * at + before) < 2e-3  # no kink: the slope is 0 on both sides


def test_a_box_is_a_window_of_the_endless_lattice(points):
    part = np.empty((5, 6, 7), np.float32)
    lattice(np.uint64(77), np.array([-6, 8, 1010]), fog._normal_quantiles(), part)
    np.testing.assert_array_equal(points[3:8, 4:10, 10:17], part)


def mean_share(kappa, seeds=60, **changes):
    """(SLICES,) mean over places; a long lens, lest octaves fade that the grid cannot hold."""
    camera = make_camera(64, 48, focal_px=200.0)
    arguments = {
        "fog_per_m": 0.03,
        "scale_height_m": np.inf,
        "puff_share": 0.0,
        "axes_world": np.eye(3),
    } | changes
    shares = [
        fog.fog_volume(
            camera,
            (0, 0, 48, 64),
            patchiness=kappa,
            seed=seed,
            drift_world_m=1000.0 * seed * np.array([1.0, 1.0, 0.2]),
            **arguments,
        ).share
        for seed in range(seeds)
    ]
    return np.mean(shares, axis=0).mean(axis=(1, 2))


@pytest.mark.parametrize(("kappa", "changes"), [(0.8, {}), (0.5, {"scale_height_m": 20.0})])
def test_patches_keep_the_mean(kappa, changes):
    """Over the long rays of many seeds, so that the mean is known to about 2 %."""
    assert np.abs(mean_share(kappa, **changes)[20:] - 1).max() < 0.06


def test_patches_without_their_correction_are_noticed(monkeypatch):
    """Planted fault: exp(kappa n) without - kappa^2 / 2 thickens the fog by a third."""
    add = patches.add_patches

    def without(noise, half_variance, *rest):
        add(noise, np.zeros_like(half_variance), *rest)

    monkeypatch.setattr(patches, "add_patches", without)
    assert mean_share(0.8)[20:33].min() > 1.2


def test_patchiness_makes_fog_patchy():
    camera = make_camera(64, 48)
    spreads = [
        fog.fog_volume(
            camera,
            (0, 0, 48, 64),
            fog_per_m=0.03,
            scale_height_m=np.inf,
            patchiness=kappa,
            puff_share=0.0,
            seed=1,
            axes_world=np.eye(3),
            drift_world_m=np.zeros(3),
        )
        .share[16]
        .std()
        for kappa in (0.1, 0.4, 0.8)
    ]
    assert 0.01 < spreads[0] < spreads[1] < spreads[2]
