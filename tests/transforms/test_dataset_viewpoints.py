"""WeatherDataset from beside the recorded cameras."""

from __future__ import annotations

import json
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from test_dataset import digest_of, digests, forks, loader_of

from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint, ViewpointJitter
from weather_aug.taxonomy import SKY
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.writers.sample import render_recipe

POLICY = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.5, 1.0), falling=1.0)
JITTER = ViewpointJitter(lateral_m=1.5, yaw_deg=20.0)
STILL = ViewpointJitter(lateral_m=0.0, height_m=0.0, yaw_deg=0.0, pitch_deg=0.0)
CROP = (32, 48)


def dataset_of(scene: WeatherScene, **choices: Any) -> WeatherDataset:
    return WeatherDataset([scene], POLICY, seed=4, **choices)


def test_without_jitter_items_are_as_before(gaussian_scene: WeatherScene) -> None:
    """A scene's Gaussians change nothing unless they are asked for."""
    item = dataset_of(gaussian_scene, viewpoint_jitter=None)[2]
    draw = POLICY.draw(4, 0, 2)
    shot = gaussian_scene.render(gaussian_scene.keys[2], draw.weather, seed=draw.seed)
    assert (item["image"].permute(1, 2, 0).numpy() == shot.image).all()
    assert (item["label"].numpy() == shot.label).all()
    assert "viewpoint" not in json.loads(item["recipe"])
    assert list(json.loads(item["recipe"])) == [
        *("scene", "scene_digest", "time_index", "camera", "weather", "seed", "window", "options")
    ]


def test_viewpoints_are_drawn_for_seed_epoch_and_item(gaussian_scene: WeatherScene) -> None:
    dataset = dataset_of(gaussian_scene, viewpoint_jitter=JITTER)
    items = [dataset[index] for index in range(3)]
    found = [json.loads(item["recipe"])["viewpoint"] for item in items]
    assert len({json.dumps(viewpoint) for viewpoint in found}) == 3
    assert digest_of(items[1]) == digest_of(dataset[1])
    dataset.set_epoch(1)
    assert json.loads(dataset[1]["recipe"])["viewpoint"] != found[1]
    plain = dataset_of(gaussian_scene)
    for index, item in enumerate(items):
        recipe, other = json.loads(item["recipe"]), json.loads(plain[index]["recipe"])
        assert recipe["weather"] == other["weather"]
        assert recipe["seed"] == other["seed"]


def test_recipes_are_rendered_again(gaussian_scene: WeatherScene) -> None:
    dataset = dataset_of(gaussian_scene, viewpoint_jitter=JITTER, crop=CROP)
    item = dataset[1]
    shot = render_recipe(gaussian_scene, json.loads(item["recipe"]))
    assert (item["image"].permute(1, 2, 0).numpy() == shot.image).all()
    assert (item["label"].numpy() == shot.label).all()
    assert (item["depth"].numpy() == shot.depth).all()
    assert (item["invalid"].numpy() == shot.invalid).all()


def test_no_jitter_at_all_stays_close_to_the_recording(gaussian_scene: WeatherScene) -> None:
    still = dataset_of(gaussian_scene, viewpoint_jitter=STILL)
    plain = dataset_of(gaussian_scene)
    for index in range(2):
        one, other = still[index], plain[index]
        assert json.loads(one["recipe"])["viewpoint"] == Viewpoint().to_dict()
        error = (one["image"].float() - other["image"].float()).square().mean()
        assert 10 * torch.log10(255**2 / error) > 28
        known = one["label_full"] != 255
        assert (one["label"] == other["label"])[known].float().mean() > 0.95


def test_what_was_never_seen_is_invalid_and_ignored(gaussian_scene: WeatherScene) -> None:
    far = ViewpointJitter(
        lateral_m=0, height_m=0, forward_m=(-4, -4), yaw_deg=(25, 25), pitch_deg=0
    )
    item = dataset_of(gaussian_scene, viewpoint_jitter=far)[2]
    viewpoint = Viewpoint(forward_m=-4, yaw_deg=25)
    unseen = torch.from_numpy(~gaussian_scene.frame_from(gaussian_scene.keys[2], viewpoint).seen)
    assert unseen.any()
    assert (item["label"][unseen] == 255).all()
    assert (item["label_full"][unseen] == 255).all()
    assert (item["invalid"][unseen] == 1).all()


@forks
@pytest.mark.parametrize(("workers", "method"), [(1, "fork"), (2, "spawn")])
def test_items_do_not_depend_on_workers(
    gaussian_scene: WeatherScene, workers: int, method: str
) -> None:
    dataset = dataset_of(gaussian_scene, viewpoint_jitter=JITTER, crop=CROP)
    expected = [digest_of(dataset[index]) for index in range(len(dataset))]
    assert digests(loader_of(dataset, workers, method)) == expected


def test_it_pickles(gaussian_scene: WeatherScene) -> None:
    dataset = dataset_of(gaussian_scene, viewpoint_jitter=JITTER)
    dataset[0]
    assert len(pickle.dumps(dataset)) < 20_000
    assert digest_of(pickle.loads(pickle.dumps(dataset))[1]) == digest_of(dataset[1])


def test_a_scene_without_gaussians_names_the_cure(tiny_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="reconstruct=True"):
        dataset_of(tiny_scene, viewpoint_jitter=JITTER)


@pytest.mark.parametrize("jitter", [1.0, (1, 2), Viewpoint(), True])
def test_what_is_no_jitter_is_refused(gaussian_scene: WeatherScene, jitter: Any) -> None:
    with pytest.raises(ArgumentError, match="viewpoint_jitter must be a ViewpointJitter"):
        dataset_of(gaussian_scene, viewpoint_jitter=jitter)


def test_depth_is_the_views(gaussian_scene: WeatherScene) -> None:
    item = dataset_of(gaussian_scene, viewpoint_jitter=JITTER)[0]
    viewpoint = Viewpoint.from_dict(json.loads(item["recipe"])["viewpoint"])
    frame = gaussian_scene.frame_from(gaussian_scene.keys[0], viewpoint).frame
    assert frame.depth_m is not None
    # Where the label is the sky, items are endlessly far, as those of recorded frames are.
    ground = frame.label != SKY
    assert (item["depth"].numpy() == np.asarray(frame.depth_m, np.float32))[ground].all()
