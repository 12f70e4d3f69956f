"""Uneven fog in torch: the same shares as the compiled look-up, bit by bit."""

import numpy as np
import pytest
import torch
from render_scene import make_camera

from weather_aug._compiled import compiled
from weather_aug.render.batch_fog import fog_shares
from weather_aug.render.fog import fog_volume
from weather_aug.render.froxels import share_row

SIZES = [(96, 64), (41, 97)]


@compiled
def looked_up(volume, depth, out):
    nodes = np.empty(volume.share.shape[0] * volume.share.shape[2], np.float32)
    place = np.empty(depth.shape[1], np.uint32)
    for y in range(depth.shape[0]):
        share_row(volume, y, 0, depth[y], nodes, place, out[y])


def scene(width, height):
    """A volume, and depths from the lens to the end of the weather's layer."""
    camera = make_camera(width, height)
    volume = fog_volume(
        camera,
        (0, 0, height, width),
        fog_per_m=0.03,
        scale_height_m=25.0,
        patchiness=0.6,
        puff_share=0.3,
        seed=5,
        axes_world=np.eye(3),
        drift_world_m=np.zeros(3),
    )
    rng = np.random.default_rng(1)
    depth = np.exp(rng.uniform(np.log(0.05), np.log(20_000), (height, width)))
    depth[:4] = [[160.0], [159.99], [160.01], [1.125]]
    return volume, depth.astype(np.float32)


@pytest.mark.parametrize("size", SIZES)
def test_shares_are_those_of_the_kernel(size):
    volume, depth = scene(*size)
    expected = np.empty_like(depth)
    looked_up(volume, depth, expected)
    found = fog_shares(volume, torch.from_numpy(depth)).numpy()
    np.testing.assert_array_equal(expected, found)
    assert expected.std() > 0.05
    stepped = in_steps(volume)
    assert np.abs(fog_shares(stepped, torch.from_numpy(depth)).numpy() - expected).max() > 0.01


def in_steps(volume):
    """A planted fault: every depth takes the value of the slice before it."""
    return volume._replace(per_step=np.zeros_like(volume.per_step))


def test_double_depth_gives_double_shares():
    volume, depth = scene(*SIZES[0])
    wide = fog_shares(volume, torch.from_numpy(depth).double())
    assert wide.dtype == torch.float64
    assert torch.equal(wide.float(), fog_shares(volume, torch.from_numpy(depth)))
