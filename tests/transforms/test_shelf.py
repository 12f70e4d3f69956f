"""Scenes on a shelf: frames by key, and pictures that are checked to be theirs."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, SceneError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.picture import Drawn, Weathering
from weather_aug.transforms.shelf import Shelf

KEY = FrameKey(1, "front")
DRAWN: Drawn = Weathering.of(WeatherPolicy.snow((1, 2))).draw(4)


def names_of(scene: WeatherScene) -> list[Any]:
    return [KEY, (1, "front"), [1, "front"], "000001_front", (scene.name, 1, "front")]


def test_a_frame_is_found_by_all_its_names(tiny_scene: WeatherScene) -> None:
    shelf = Shelf([tiny_scene.path])
    image = tiny_scene.frame(KEY).image
    expected = tiny_scene.render(KEY, DRAWN.weather, seed=DRAWN.seed)
    for name in names_of(tiny_scene):
        shot = shelf.render(name, image, DRAWN)
        assert (shot.image == expected.image).all(), name
        assert (shot.label == expected.label).all()


def test_of_several_scenes_the_name_decides(tiny_scene: WeatherScene, tmp_path: Path) -> None:
    other = WeatherScene.build(TinyClip(name="other", frames=2), tmp_path / "other")
    shelf = Shelf([tiny_scene.path, str(other.path)])
    assert shelf.find(("other", 1, "front")) == (shelf.by_name["other"], KEY)
    assert shelf.find((tiny_scene.name, 1, "front"))[0].path == tiny_scene.path
    with pytest.raises(ArgumentError, match="with several scenes scene_key must be"):
        shelf.find("000001_front")
    with pytest.raises(ArgumentError, match="there is no scene 'third'; there are tiny, other"):
        shelf.find(("third", 1, "front"))


def test_two_scenes_of_one_name_are_refused(tiny_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="two of the name"):
        Shelf([tiny_scene.path] * 2).find(KEY)


@pytest.mark.parametrize("key", [(99, "front"), "front", (1, "back"), (1,), (), (1, "f", "g", 2)])
def test_a_frame_that_is_not_there_is_refused(tiny_scene: WeatherScene, key: Any) -> None:
    with pytest.raises(ArgumentError, match="has no frame"):
        Shelf([tiny_scene.path]).find(key)


@pytest.mark.parametrize("key", [12, 1.5, {1, 2}])
def test_what_is_no_key_is_refused(tiny_scene: WeatherScene, key: Any) -> None:
    with pytest.raises(ArgumentError, match="scene_key must be"):
        Shelf([tiny_scene.path]).find(key)
    with pytest.raises(ArgumentError, match="there is no scene"):
        Shelf([tiny_scene.path]).find(([key], 1, "front"))


def test_an_empty_shelf_says_what_it_needs() -> None:
    with pytest.raises(ArgumentError, match=r"scene_key needs scenes: RandomWeather\(.*scenes="):
        Shelf(()).find(KEY)
    for paths in ("scenes/0000", Path("scenes/0000"), 5, None, [5]):
        with pytest.raises(ArgumentError, match="write scenes="):
            Shelf(paths)  # type: ignore[arg-type]
    with pytest.raises(SceneError):
        Shelf(["/nowhere/at/all"]).find(KEY)


def test_a_cropped_picture_is_refused(tiny_scene: WeatherScene) -> None:
    image = tiny_scene.frame(KEY).image
    with pytest.raises(ArgumentError, match="before crops and resizing"):
        Shelf([tiny_scene.path]).render(KEY, image[:-1], DRAWN)


@pytest.mark.parametrize(
    "change", [lambda image: image[:, ::-1], lambda image: image // 2, lambda image: 255 - image]
)
def test_another_picture_is_refused(tiny_scene: WeatherScene, change: Any) -> None:
    image = np.ascontiguousarray(change(tiny_scene.frame(KEY).image))
    with pytest.raises(ArgumentError, match="not the picture of frame 000001_front"):
        Shelf([tiny_scene.path]).render(KEY, image, DRAWN)


def test_another_decoders_picture_will_do(tiny_scene: WeatherScene) -> None:
    image = tiny_scene.frame(KEY).image.copy()
    image += (image < 255).astype(np.uint8)
    assert Shelf([tiny_scene.path]).render(KEY, image, DRAWN).image.shape == image.shape


def test_it_pickles_as_paths(tiny_scene: WeatherScene) -> None:
    shelf = Shelf([tiny_scene.path])
    shelf.find(KEY)
    data = pickle.dumps(shelf)
    assert len(data) < 1024
    assert pickle.loads(data).find(KEY)[1] == KEY
