"""loss_weight(item): the frame's own weights, from an item or a batch of a data set."""

import json

import numpy as np
import pytest
import torch

from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.dataset import WeatherDataset, loss_weight
from weather_aug.writers.sample import render_recipe

FOG = WeatherPolicy(types={"fog": 1}, severity=(0.95, 1.0))


@pytest.mark.parametrize("labelled", [True, False])
def test_weights_are_those_of_the_rendered_frame(request, labelled):
    scene = request.getfixturevalue("tiny_scene" if labelled else "unlabelled_scene")
    dataset = WeatherDataset([scene], FOG, seed=3)
    item = dataset[0]
    expected = render_recipe(scene, json.loads(item["recipe"])).loss_weight
    found = loss_weight(item)
    assert found.dtype == torch.float32
    np.testing.assert_array_equal(expected, found.numpy())
    batch = torch.utils.data.default_collate([item, dataset[1]])
    np.testing.assert_array_equal(expected, loss_weight(batch)[0].numpy())
    assert "loss_weight" not in item


def test_arrays_give_arrays(tiny_scene):
    items = WeatherDataset([tiny_scene], FOG, seed=3, transform=lambda sample: sample)
    tensors = WeatherDataset([tiny_scene], FOG, seed=3)
    weight = loss_weight(items[0])
    assert weight.dtype == np.float32
    np.testing.assert_array_equal(loss_weight(tensors[0]).numpy(), weight)


def test_a_missing_plane_is_named(tiny_scene):
    item = WeatherDataset([tiny_scene], FOG, seed=3)[0]
    del item["invalid"]
    with pytest.raises(ArgumentError, match="no 'invalid'"):
        loss_weight(item)
