"""Optical depth in torch against the slow reference."""

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


def column(values):
    return AirColumn(*values, torch.from_numpy(RESOLVED), STEP_M, tuple(UP.tolist()))


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
    found = column(AIRS[name]).optical_depth(torch.from_numpy(z), *rays)
    np.testing.assert_allclose(np.exp(-found.numpy()), np.exp(-expected), atol=1e-4)
    single = pixel_rays(camera, torch.zeros(()))
    coarse = column(AIRS[name]).optical_depth(torch.from_numpy(z).float(), *single)
    np.testing.assert_allclose(np.exp(-coarse.numpy()), np.exp(-expected), atol=1e-4)
