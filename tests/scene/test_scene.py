"""WeatherScene: pictures are a function of (scene, key, weather, seed, window, options)."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_clip import TinyClip

from weather_aug._files import sha256_of
from weather_aug.clip.types import FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.errors import ArgumentError, SceneError
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import RenderOptions
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.weather import Weather

WEATHERS = {
    "rain": Weather.rain("heavy"),
    "extreme rain": Weather.rain("extreme"),
    "wet": Weather.rain("heavy", falling=False),
    "snow": Weather.snow("heavy"),
    "extreme snow": Weather.snow("extreme"),
    "fog": Weather.fog("heavy"),
    "extreme fog": Weather.fog("extreme"),
    "all": Weather.mix(
        Weather.mix(Weather.rain("moderate"), Weather.snow("extreme")), Weather.fog("light")
    ),
    "clear": Weather.clear(),
}
HEIGHT, WIDTH = 48, 64


def planes(shot: RenderedFrame) -> dict[str, np.ndarray[Any, Any]]:
    names = ("image", "label", "label_full", "invalid", "transmittance", "depth")
    values = {name: getattr(shot, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def assert_same(expected: RenderedFrame, actual: RenderedFrame) -> None:
    assert_equal_planes(planes(expected), planes(actual))


def assert_equal_planes(
    expected: dict[str, np.ndarray[Any, Any]], actual: dict[str, np.ndarray[Any, Any]]
) -> None:
    assert expected.keys() == actual.keys()
    for name, plane in expected.items():
        other = actual[name]
        assert (plane.dtype, plane.shape) == (other.dtype, other.shape), name
        assert plane.tobytes() == other.tobytes(), name


@st.composite
def windows(draw: st.DrawFn) -> tuple[int, int, int, int]:
    top, left = draw(st.integers(0, HEIGHT - 1)), draw(st.integers(0, WIDTH - 1))
    return top, left, draw(st.integers(1, HEIGHT - top)), draw(st.integers(1, WIDTH - left))


@pytest.fixture(scope="module")
def wide_scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    clip = TinyClip(frames=1, cameras=("front",), width=320, height=256)
    return WeatherScene.build(clip, tmp_path_factory.mktemp("wide") / "scene")


# Opening


def test_a_pickled_scene_is_small_and_usable(tiny_scene: WeatherScene) -> None:
    tiny_scene.render(tiny_scene.keys[0], WEATHERS["snow"])
    data = pickle.dumps(tiny_scene)
    assert len(data) <= 64 * 1024
    scene = pickle.loads(data)
    assert scene.digest == tiny_scene.digest
    key = tiny_scene.keys[3]
    assert_same(tiny_scene.render(key, WEATHERS["snow"]), scene.render(key, WEATHERS["snow"]))


def test_a_scene_opens_lazily(tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpickling reads nothing, loading reads the table of contents, a frame reads itself."""
    data = pickle.dumps(tiny_scene)
    with monkeypatch.context() as patched:
        patched.setattr(store, "read_manifest", lambda _: pytest.fail("read"))
        scene = pickle.loads(data)
        assert str(tiny_scene.path) in repr(scene)
    with monkeypatch.context() as patched:
        patched.setattr(store, "read_frame", lambda *_: pytest.fail("read"))
        assert WeatherScene.load(tiny_scene.path).size_of(tiny_scene.keys[0]) == (HEIGHT, WIDTH)
    assert scene.frame(scene.keys[0]).image.shape == (HEIGHT, WIDTH, 3)


def test_a_relative_path_survives_a_change_of_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = WeatherScene.build(TinyClip(frames=1), "scene")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert pickle.loads(pickle.dumps(scene)).frame(scene.keys[0]).image.any()


@pytest.mark.parametrize("key", [FrameKey(99, "front"), FrameKey(0, "rear"), (0, "a\nb")])
def test_a_frame_that_is_not_there_is_refused(tiny_scene: WeatherScene, key: FrameKey) -> None:
    for ask in (tiny_scene.frame, tiny_scene.ambience, tiny_scene.size_of):
        with pytest.raises(ArgumentError, match=r"scene tiny has no frame .* front, right"):
            ask(key)
    with pytest.raises(ArgumentError, match="no frame"):
        tiny_scene.render(key, Weather.clear())


def test_a_plain_pair_is_a_key(tiny_scene: WeatherScene) -> None:
    assert tiny_scene.frame((0, "right")).key == FrameKey(0, "right")  # type: ignore[arg-type]


# Rendering


@pytest.mark.parametrize("index", range(4))
def test_clear_weather_gives_the_recorded_bytes(tiny_scene: WeatherScene, index: int) -> None:
    key = tiny_scene.keys[index]
    clean, shot = TinyClip().frame(key), tiny_scene.render(key, Weather.clear(), seed=5)
    assert shot.image.tobytes() == clean.image.tobytes()
    assert shot.label is not None
    assert shot.label_full is not None
    assert shot.label.tobytes() == shot.label_full.tobytes() == clean.label.tobytes()
    assert not shot.invalid.any()
    assert (shot.transmittance == 1).all()
    assert (shot.depth == clean.depth_m.astype(np.float16)).all()


def test_the_light_is_the_frames_own_and_the_airlight_the_clips(tiny_scene: WeatherScene) -> None:
    airlight = tiny_scene.manifest.airlight.tolist()
    for key in tiny_scene.keys:
        expected = ambience_of(TinyClip().frame(key), np.eye(3))
        ambience = tiny_scene.ambience(key)
        for name in ("sky", "middle", "ground"):
            assert getattr(ambience, name).tolist() == getattr(expected, name).tolist()
        assert ambience.airlight.tolist() == airlight
        frame, weather = tiny_scene.frame(key), WEATHERS["all"]
        layers = tiny_scene.layers(key)
        by_hand = render(frame, weather, seed=1, ambience=ambience, layers=layers)
        assert_same(by_hand, tiny_scene.render(key, weather, seed=1))


@pytest.mark.parametrize("name", [name for name in WEATHERS if name != "clear"])
def test_weather_changes_the_picture(tiny_scene: WeatherScene, name: str) -> None:
    key = tiny_scene.keys[0]
    shot = tiny_scene.render(key, WEATHERS[name])
    assert (shot.image != tiny_scene.frame(key).image).any()
    assert 0 <= shot.transmittance.min() <= shot.transmittance.max() <= 1


@settings(max_examples=200)
@given(windows(), st.sampled_from(sorted(WEATHERS)), st.integers(0, 7), st.booleans())
def test_a_window_is_that_part_of_the_whole(
    tiny_scene: WeatherScene,
    unlabelled_scene: WeatherScene,
    window: tuple[int, int, int, int],
    name: str,
    index: int,
    labelled: bool,
) -> None:
    scene = tiny_scene if labelled else unlabelled_scene
    key = scene.keys[index]
    whole = scene.render(key, WEATHERS[name], seed=2)
    top, left, height, width = window
    part = {
        name: np.ascontiguousarray(plane[top : top + height, left : left + width])
        for name, plane in planes(whole).items()
    }
    assert_equal_planes(part, planes(scene.render(key, WEATHERS[name], seed=2, window=window)))


@pytest.mark.parametrize("name", ["all", "extreme rain"])
def test_tiles_join_to_the_whole(wide_scene: WeatherScene, name: str) -> None:
    """At a resolution at which particles, streaks and blur lie across every edge."""
    key = wide_scene.keys[0]
    whole = planes(wide_scene.render(key, WEATHERS[name], seed=1))
    height, width = wide_scene.size_of(key)
    for top in range(0, height, 32):
        for left in range(0, width, 32):
            shot = wide_scene.render(key, WEATHERS[name], seed=1, window=(top, left, 32, 32))
            for plane, tile in planes(shot).items():
                part = whole[plane][top : top + 32, left : left + 32]
                assert np.array_equal(part, tile), (plane, top, left)


@pytest.mark.parametrize(
    "window",
    [(-1, 0, 5, 5), (0, 0, 0, 5), (0, 0, 49, 64), (40, 0, 9, 5), (0, 64, 1, 1), (0, 0, 5, -5)],
)
def test_a_window_outside_the_picture_is_refused(
    tiny_scene: WeatherScene, window: tuple[int, int, int, int]
) -> None:
    with pytest.raises(ArgumentError, match="window"):
        tiny_scene.render(tiny_scene.keys[0], WEATHERS["rain"], window=window)


@pytest.mark.parametrize("name", ["rain", "snow", "all"])
def test_a_frame_alone_is_the_frame_in_sequence(tiny_scene: WeatherScene, name: str) -> None:
    weather = WEATHERS[name]
    in_order = [tiny_scene.render(key, weather, seed=2) for key in tiny_scene.keys]
    for key, shot in reversed([*zip(tiny_scene.keys, in_order, strict=True)]):
        assert_same(shot, WeatherScene.load(tiny_scene.path).render(key, weather, seed=2))
    assert (in_order[0].image != in_order[2].image).any()


_ALONE = """
import hashlib
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather
scene = WeatherScene.load({path!r})
shot = scene.render(scene.keys[5], Weather.from_json({weather!r}), seed=9)
print(hashlib.sha256(shot.image.tobytes() + shot.transmittance.tobytes()).hexdigest())
"""


def test_another_process_gives_the_same_bytes(tiny_scene: WeatherScene) -> None:
    weather = WEATHERS["all"]
    code = _ALONE.format(path=str(tiny_scene.path), weather=weather.to_json())
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    shot = tiny_scene.render(tiny_scene.keys[5], weather, seed=9)
    assert run.stdout.strip() == sha256_of(shot.image.tobytes() + shot.transmittance.tobytes())


def test_the_seed_decides_which_particles_fall(tiny_scene: WeatherScene) -> None:
    key, weather = tiny_scene.keys[0], WEATHERS["snow"]
    pictures = {
        tiny_scene.render(key, weather, seed=seed).image.tobytes()
        for seed in (0, 1, -1, 2**32, 2**63, 2**64 - 1)
    }
    assert len(pictures) == 6
    with pytest.raises(ArgumentError, match="seed"):
        tiny_scene.render(key, weather, seed=2**64)


def test_options_reach_the_renderer(tiny_scene: WeatherScene) -> None:
    key, weather = tiny_scene.keys[0], WEATHERS["extreme snow"]
    few = tiny_scene.render(key, weather, options=RenderOptions(max_particles=5))
    assert (few.image != tiny_scene.render(key, weather).image).any()
    with pytest.raises(ArgumentError, match="max_particles"):
        RenderOptions(max_particles=-1)


@pytest.mark.parametrize("name", WEATHERS)
def test_inputs_are_not_changed(tiny_scene: WeatherScene, name: str) -> None:
    """Once with arrays that cannot be written, once with arrays that can."""
    key = tiny_scene.keys[1]
    frame, ambience = tiny_scene.frame(key), tiny_scene.ambience(key)
    assert frame.label is not None
    assert frame.depth_m is not None
    frame.image.flags.writeable = False
    locked = render(frame, WEATHERS[name], seed=1, ambience=ambience)
    copies = (frame.image.copy(), frame.label.copy(), frame.depth_m.copy())
    loose = replace(frame, image=copies[0], label=copies[1], depth_m=copies[2])
    before = [array.tobytes() for array in copies]
    shot = render(loose, WEATHERS[name], seed=1, ambience=ambience)
    assert [array.tobytes() for array in copies] == before
    assert_same(locked, shot)
    for plane in planes(shot).values():
        assert plane.flags.writeable
        assert not any(np.shares_memory(plane, array) for array in copies)


@pytest.mark.parametrize("name", WEATHERS)
def test_labels_are_train_ids_of_the_recorded_frame_or_ignore(
    tiny_scene: WeatherScene, name: str
) -> None:
    for key in tiny_scene.keys:
        recorded = tiny_scene.frame(key).label
        shot = tiny_scene.render(key, WEATHERS[name], seed=3)
        assert recorded is not None
        assert shot.label is not None
        assert shot.label_full is not None
        assert set(np.unique(shot.label)) <= {*range(19), IGNORE}
        assert shot.label_full.tobytes() == recorded.tobytes()
        assert ((shot.label == recorded) | (shot.label == IGNORE)).all()
        assert (shot.invalid[(shot.label == IGNORE) & (recorded != IGNORE)] == 1).all()


def test_extreme_fog_hides_what_is_far_and_never_what_is_near(tiny_scene: WeatherScene) -> None:
    shot = tiny_scene.render(tiny_scene.keys[0], WEATHERS["extreme fog"])
    assert shot.label is not None
    surface = shot.label_full != SKY
    assert (shot.label[surface & (shot.depth > 150)] == IGNORE).all()
    assert (shot.label[shot.depth < 10] != IGNORE).all()
    assert (surface & (shot.depth > 150)).any()


def test_a_scene_without_labels_renders_without(unlabelled_scene: WeatherScene) -> None:
    for weather in WEATHERS.values():
        shot = unlabelled_scene.render(unlabelled_scene.keys[0], weather)
        assert shot.label is None
        assert shot.label_full is None
        assert shot.invalid.shape == (HEIGHT, WIDTH)


def test_render_of_a_damaged_folder_is_a_scene_error(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(frames=1), tmp_path / "scene")
    (scene.path / scene.manifest.frames[0].files["depth"]).unlink()
    with pytest.raises(SceneError, match="cannot be read"):
        scene.render(scene.keys[0], WEATHERS["rain"])
