"""What a manifest may say of backgrounds, from whomever it is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tinting_editor import Tinting
from tiny_clip import TinyClip

from weather_aug import _files
from weather_aug.clip.types import FrameKey
from weather_aug.errors import IntegrityError, SceneError
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import background_path
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather

Entry = dict[str, Any]
FIRST = background_path("snow", FrameKey(0, "front"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    folder = tmp_path_factory.mktemp("record") / "scene"
    clip = TinyClip(frames=1, width=32, height=24)
    return WeatherScene.build(clip, folder, editor=Tinting(), weathers=("snow", "rain"))


@pytest.fixture
def folder(scene: WeatherScene, tmp_path: Path) -> Path:
    """A copy that a test may harm."""
    return Path(shutil.copytree(scene.path, tmp_path / "scene"))


def rewrite(folder: Path, change: Callable[[Entry], object]) -> None:
    """Edit the manifest as JSON and seal it again, as somebody would on purpose."""
    path = folder / store.MANIFEST
    content = json.loads(path.read_text())
    change(content)
    content.pop("sha256", None)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps(content | {"sha256": _files.sha256_of(text.encode())}))


def entry(**changes: Any) -> Callable[[Entry], object]:
    return lambda content: content["backgrounds"].update(changes)


HARMS: dict[str, Callable[[Entry], object]] = {
    "a text": lambda content: content.update(backgrounds="snow"),
    "a list": lambda content: content.update(backgrounds=["snow"]),
    "a number": lambda content: content.update(backgrounds=1),
    "empty": lambda content: content.update(backgrounds={}),
    "no card": lambda content: content["backgrounds"].pop("card"),
    "no styles": lambda content: content["backgrounds"].pop("styles"),
    "a card of text": entry(card="diffusion"),
    "a card of a list": entry(card=[1]),
    "no card at all": entry(card=None),
    "a card of a book": entry(card={"text": "x" * 70_000}),
    "styles as a text": entry(styles="snow"),
    "styles as an object": entry(styles={"snow": 1}),
    "styles of nothing": entry(styles=[]),
    "a style twice": entry(styles=["snow", "snow"]),
    "a style of numbers": entry(styles=[1]),
    "a style of lists": entry(styles=[["snow"]]),
    "an unknown style": entry(styles=["hail"]),
    "a style that is a way out": entry(styles=["../../etc"]),
    "a style without pictures": entry(styles=["snow", "rain", "fog"]),
    "a picture that is not listed": lambda content: content["files"].pop(FIRST),
}


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_a_malformed_entry_is_a_scene_error(folder: Path, harm: Callable[[Entry], object]) -> None:
    rewrite(folder, harm)
    with pytest.raises(SceneError):
        WeatherScene.load(folder)


def test_an_untouched_entry_is_read(folder: Path) -> None:
    """What the harms above are done to is whole."""
    rewrite(folder, lambda content: None)
    scene = WeatherScene.load(folder)
    assert scene.manifest.styles == ("snow", "rain")
    rewrite(folder, lambda content: content.pop("backgrounds"))
    old = WeatherScene.load(folder)
    assert old.manifest.styles == () and old.manifest.backgrounds is None
    assert old.render(old.keys[0], Weather.clear()).image.shape == (24, 32, 3)


def test_lost_and_changed_pictures_are_found(folder: Path) -> None:
    path = folder / FIRST
    data = path.read_bytes()
    path.write_bytes(data[:-1] + b"\0")
    with pytest.raises(IntegrityError, match="snow"):
        WeatherScene.load(folder, verify=True)
    path.write_bytes(data[:-1])
    with pytest.raises(IntegrityError, match="bytes"):
        WeatherScene.load(folder)
    path.unlink()
    with pytest.raises(IntegrityError, match="missing"):
        WeatherScene.load(folder)
    path.symlink_to(folder / FIRST.replace("snow", "rain"))
    with pytest.raises(IntegrityError, match="link"):
        WeatherScene.load(folder)


def test_a_bomb_of_pixels_is_not_decoded(folder: Path) -> None:
    """A small PNG that claims another size than the camera's."""
    from weather_aug._png import png_bytes

    data = png_bytes(np.zeros((4000, 4000, 3), np.uint8))
    (folder / FIRST).write_bytes(data)
    record = {"size": len(data), "sha256": _files.sha256_of(data)}
    rewrite(folder, lambda content: content["files"].update({FIRST: record}))
    scene = WeatherScene.load(folder, verify=True)
    with pytest.raises(SceneError, match="32x24"):
        scene.background(scene.keys[0], "snow")
