"""A sample is made again from its recipe, and encoded by the one encoder."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_export import TinyClip

from weather_aug._png import png_bytes
from weather_aug.errors import ArgumentError
from weather_aug.render.options import DEFAULT_OPTIONS
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.view.sheet import write_png
from weather_aug.weather import Weather
from weather_aug.writers.sample import encoded_parts, render_recipe


def _recipe(scene: WeatherScene, **fields: Any) -> Any:
    """As it comes out of JSON, in which a window is a list."""
    recipe = {
        "scene_digest": scene.digest,
        "time_index": 1,
        "camera": "front",
        "weather": Weather.snow("heavy").to_dict(),
        "seed": 5,
        "options": asdict(DEFAULT_OPTIONS),
    }
    return json.loads(json.dumps(recipe | fields))


def test_a_recipe_with_a_window_gives_that_window(scene: WeatherScene) -> None:
    whole = render_recipe(scene, _recipe(scene))
    part = render_recipe(scene, _recipe(scene, window=(5, 7, 11, 13)))
    assert part.image.shape == (11, 13, 3)
    np.testing.assert_array_equal(whole.image[5:16, 7:20], part.image)
    assert whole.label is not None
    assert part.label is not None
    np.testing.assert_array_equal(whole.label[5:16, 7:20], part.label)


def test_a_recipe_whose_window_is_null_gives_the_whole(scene: WeatherScene) -> None:
    whole = render_recipe(scene, _recipe(scene, window=None))
    np.testing.assert_array_equal(render_recipe(scene, _recipe(scene)).image, whole.image)


def test_every_stage_encodes_alike(scene: WeatherScene, tmp_path: Path) -> None:
    frame = TinyClip().frame(scene.keys[1])
    expected = cv2.imencode(
        ".png", frame.image[..., ::-1].copy(), [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )[1].tobytes()
    assert png_bytes(frame.image) == expected
    assert store.encode_frame(frame)["image"] == expected
    clear = render_recipe(scene, _recipe(scene, weather=Weather.clear().to_dict()))
    assert encoded_parts(clear)["image"] == expected
    write_png(tmp_path / "a" / "picture.png", frame.image)
    assert (tmp_path / "a" / "picture.png").read_bytes() == expected


@pytest.mark.parametrize("writable", [False, True])
def test_a_label_and_a_read_only_picture_come_back(writable: bool) -> None:
    for shape in ((5, 7), (5, 7, 3)):
        image = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
        image.flags.writeable = writable
        way = cv2.IMREAD_GRAYSCALE if len(shape) == 2 else cv2.IMREAD_COLOR_RGB
        decoded = cv2.imdecode(np.frombuffer(png_bytes(image), np.uint8), way)
        np.testing.assert_array_equal(image, decoded)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((0, 5, 3), np.uint8),
        np.zeros((5, 5, 4), np.uint8),
        np.zeros((5, 5, 3, 3), np.uint8),
        np.zeros(5, np.uint8),
        np.zeros((5, 5), np.float32),
    ],
    ids=["empty", "four channels", "four axes", "one axis", "floats"],
)
def test_what_is_no_picture_is_refused(image: Any) -> None:
    with pytest.raises(ArgumentError, match="a picture must be uint8"):
        png_bytes(image)
