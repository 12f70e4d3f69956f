"""Optical depth in torch against the slow reference."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import reference_render as reference
from render_scene import make_camera

from weather_aug.render.batch_medium import AirColumn, pixel_rays

STEP_M = 60 / 1024
RESOLVED = np.minimum(np.arange(1025) * 2e-5, 0.01).astype(np.float32)
AIRS = {
    "even fog": (0.02, 0.0, 0.0, 0.0),
    "low fog": (0.05, 1 / 5.0, 0.001, 0.0),
    "high fog": (0.01, 1 / 5000.0, 0.0, 0.0),
    "rain": (0.0, 0.0, 0.002, 0.003),
    "all": (0.02, 1 / 60.0, 0.002, 0.003),
}
UP = np.array([0.05, -0.995, -0.086])


def column(values, spray_per_m=0.0, camera_heights=3.0):
    resolved = torch.from_numpy(RESOLVED)
    return AirColumn(*values, STEP_M, spray_per_m, camera_heights, resolved, tuple(UP.tolist()))


def optical_depth(air, z, rays):
    return air.optical_depth(air.reach_m(z, *rays), *rays)


def depths(camera):
    depth = np.random.default_rng(0).uniform(0.5, 250, (camera.height, camera.width))
    depth[:30] = np.inf
    return depth


@pytest.mark.parametrize("name", AIRS)
def test_agrees_with_the_slow_reference(name):
    camera = make_camera()
    z = depths(camera)

    def carried(z):
        return RESOLVED[np.minimum(z / STEP_M, 1024).astype(int)]

    expected = reference.optical_depth(z, reference.rays(camera), UP, *AIRS[name], carried)
    rays = pixel_rays(camera, torch.zeros((), dtype=torch.float64))
    found = optical_depth(column(AIRS[name]), torch.from_numpy(z), rays)
    np.testing.assert_allclose(np.exp(-found.numpy()), np.exp(-expected), atol=1e-4)
    single = pixel_rays(camera, torch.zeros(()))
    coarse = optical_depth(column(AIRS[name]), torch.from_numpy(z).float(), single)
    np.testing.assert_allclose(np.exp(-coarse.numpy()), np.exp(-expected), atol=1e-4)


@pytest.mark.parametrize("spray_height_m", [0.5, 0.8])
def test_spray_is_the_sum_of_its_density_along_the_ray(spray_height_m):
    """Density 1 at the road's plane and 0 below, thinning with 0.5 m; another height must show."""
    camera_height_m, spray_per_m = 1.4, 0.05
    climb = np.array([-0.3, -0.09, -0.02, -0.001, 0.0, 0.001, 0.05, 0.4])
    z = np.array([1.0, 6.0, 17.0, 60.0])[:, None]
    steps = (np.arange(20_000) + 0.5) / 20_000
    height_m = camera_height_m + z[..., None] * climb[:, None] * steps
    density = (np.exp(-height_m / spray_height_m) * (height_m > 0)).mean(axis=-1)
    expected = spray_per_m * density * z * np.sqrt(1 + climb**2)
    air = column((0.0, 0.0, 0.0, 0.0), spray_per_m, camera_height_m / 0.5)
    air = replace(air, up_camera=(0.0, 1.0, 0.0))
    tangents = torch.from_numpy(climb)
    found = air.optical_depth(torch.from_numpy(z), torch.zeros_like(tangents), tangents)
    error = np.abs(found.numpy() - expected).max()
    assert (error < 2e-3) == (spray_height_m == 0.5)
