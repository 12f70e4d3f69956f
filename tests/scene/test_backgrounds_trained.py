"""A scene keeps what its editor was trained on, or says nothing of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from recorded_editor import Recorded, record
from test_backgrounds import failing_at
from test_backgrounds_record import entry, rewrite
from tinting_editor import Tinting
from tiny_clip import TinyClip, digests_of

from weather_aug import _files
from weather_aug.errors import ArgumentError, IntegrityError, SceneError
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import TRAINED_ON
from weather_aug.scene.scene import WeatherScene

CLIP = TinyClip(frames=2, width=32, height=24)
RAIN, SNOW = record("a", "b"), record("b", "c")


def built(out: Path, editor: Tinting, *weathers: str) -> WeatherScene:
    return WeatherScene.build(CLIP, out, editor=editor, weathers=weathers)


@pytest.fixture
def scene(tmp_path: Path) -> WeatherScene:
    """Two styles, each of an adapter of its own."""
    editor = Recorded(records={"rain": RAIN, "snow": SNOW, "fog": record("d")})
    return built(tmp_path / "scene", editor, "rain", "snow")


def test_a_scene_keeps_the_records_of_its_styles_as_one(scene: WeatherScene) -> None:
    """The fog's adapter made nothing here."""
    kept = scene.manifest.backgrounds
    assert kept is not None
    assert kept.recorded == ("rain", "snow") and kept.unrecorded == ()
    assert store.read_trained_on(scene.path, scene.manifest) == record("a", "b", "c")
    data = (scene.path / TRAINED_ON).read_bytes()
    stored = scene.manifest.files[TRAINED_ON]
    assert (stored.size, stored.sha256) == (len(data), _files.sha256_of(data))
    assert WeatherScene.load(scene.path, verify=True).damaged_files() == []


def test_styles_that_nobody_recorded_are_told_apart(tmp_path: Path) -> None:
    scene = built(tmp_path / "scene", Recorded(records={"snow": SNOW}), "rain", "snow")
    kept = scene.manifest.backgrounds
    assert kept is not None
    assert kept.recorded == ("snow",) and kept.unrecorded == ("rain",)
    assert store.read_trained_on(scene.path, scene.manifest) == SNOW


def test_without_a_record_the_scene_is_what_it_was(tmp_path: Path) -> None:
    """Not a byte differs from the scene of an editor that cannot tell."""
    mute = built(tmp_path / "mute", Tinting(), "rain", "snow")
    untold = built(tmp_path / "untold", Recorded(), "rain", "snow")
    assert digests_of(mute.path) == digests_of(untold.path)
    content = json.loads((mute.path / store.MANIFEST).read_text())
    assert list(content["backgrounds"]) == ["card", "styles"]
    assert TRAINED_ON not in content["files"]
    assert store.read_trained_on(mute.path, mute.manifest) is None


def test_a_continued_build_keeps_it_too(scene: WeatherScene, tmp_path: Path) -> None:
    editor = failing_at(5)
    with pytest.raises(RuntimeError, match="power cut"):
        built(tmp_path / "again", editor, "rain", "snow")
    built(tmp_path / "again", Recorded(records={"rain": RAIN, "snow": SNOW}), "rain", "snow")
    assert digests_of(tmp_path / "again") == digests_of(scene.path)


def test_a_record_of_a_build_that_lost_it_does_not_stay(tmp_path: Path) -> None:
    """Cut short behind the record, and continued by an editor that cannot tell any more."""
    out = tmp_path / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("weather_aug.scene.publish.publish", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            built(out, Recorded(records={"snow": SNOW}), "snow")
    assert (out.with_name("scene.building") / TRAINED_ON).exists()
    built(out, Tinting(), "snow")
    assert not (out / TRAINED_ON).exists()


def test_what_is_no_record_is_refused_before_work(tmp_path: Path) -> None:
    editor: Any = Recorded(records={"snow": "everything"})  # type: ignore[dict-item]
    with pytest.raises(ArgumentError, match="must be TrainedOn or None, got str"):
        built(tmp_path / "scene", editor, "snow")
    assert list(tmp_path.iterdir()) == []


def flip(path: Path) -> None:
    """Another digit in one digest; the order of lines stays."""
    path.write_text(path.read_text().replace("c" * 64, "c" * 63 + "d"))


def test_one_flipped_digit_is_found(scene: WeatherScene) -> None:
    flip(scene.path / TRAINED_ON)
    again = WeatherScene.load(scene.path)
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        store.read_trained_on(again.path, again.manifest)
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        WeatherScene.load(scene.path, verify=True)


HARMS: dict[str, Callable[[dict[str, Any]], object]] = {
    "a text": entry(recorded="rain"),
    "nothing in it": entry(recorded=[]),
    "a style twice": entry(recorded=["rain", "rain"]),
    "a style without backgrounds": entry(recorded=["rain", "fog"]),
    "a list in it": entry(recorded=[["rain"]]),
    "no file": lambda content: content["files"].pop(TRAINED_ON),
}


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_a_malformed_entry_is_a_scene_error(
    scene: WeatherScene, harm: Callable[[dict[str, Any]], object]
) -> None:
    rewrite(scene.path, harm)
    with pytest.raises(SceneError):
        WeatherScene.load(scene.path)


def test_a_lost_record_is_found(scene: WeatherScene) -> None:
    (scene.path / TRAINED_ON).unlink()
    with pytest.raises(IntegrityError, match=r"trained_on\.txt is missing"):
        WeatherScene.load(scene.path)
