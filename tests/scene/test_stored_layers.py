"""What the editor knows of a frame stays with the scene, and is what it would find out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_clip import TinyClip, digests_of

from weather_aug import _files
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.edit.physical.layers import LATERAL_M, NAMES, Layers, layers_of, thumbnail_of
from weather_aug.edit.physical.site import site_of
from weather_aug.errors import DataError, IntegrityError, SceneError
from weather_aug.render.background import looked_at
from weather_aug.render.compose import render
from weather_aug.scene import layers as storing
from weather_aug.scene import scene as scenes
from weather_aug.scene import store
from weather_aug.scene.arrays import npy_bytes
from weather_aug.scene.route import part_near, route_of
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import IGNORE
from weather_aug.weather import Weather

FIRST = "frames/000000_front"
STORM = Weather.mix(Weather.rain("heavy"), Weather.snow("moderate"))
SHAPE = (20, 48, 64)


@pytest.fixture
def folder(tiny_scene: WeatherScene, tmp_path: Path) -> Path:
    """A copy of the tiny scene that a test may harm."""
    return Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Edit the manifest and seal it again, as somebody would on purpose."""
    path = folder / store.MANIFEST
    content = json.loads(path.read_text())
    change(content)
    content.pop("sha256", None)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps(content | {"sha256": _files.sha256_of(text.encode())}))


def plant(folder: Path, relative: str, data: bytes) -> None:
    """Replace a file together with its digest in the manifest."""
    (folder / relative).write_bytes(data)
    record = {"size": len(data), "sha256": _files.sha256_of(data)}
    rewrite(folder, lambda m: m["files"].update({relative: record}))


def of_before(folder: Path) -> None:
    """Make a scene one of before layers were stored."""

    def older(content: dict[str, Any]) -> None:
        for entry in content["frames"]:
            del entry["layers"]
            for part in storing.PARTS:
                relative = entry["files"].pop(part, None)
                if relative is not None:
                    del content["files"][relative]
                    (folder / relative).unlink()

    rewrite(folder, older)


def assert_same(expected: Layers, actual: Layers) -> None:
    for name in ("maps", "tint", "plane", "classes", "thumbnail"):
        here, there = getattr(expected, name), getattr(actual, name)
        assert (here.dtype, here.shape) == (there.dtype, there.shape), name
        assert here.tobytes() == there.tobytes(), name
        assert not there.flags.writeable, name
    assert (expected.step, expected.illumination) == (actual.step, actual.illumination)


def found_out(scene: WeatherScene, key: FrameKey, *, with_route: bool = True) -> Layers:
    """By hand, from the frame and the places of its camera."""
    frame, ambience = scene.frame(key), scene.ambience(key)
    site = site_of(frame, ambience.axes_world, ambience.camera_height_m)
    same = [r.camera for r in scene.manifest.frames if r.key.camera == key.camera]
    route = route_of(np.array([(ambience.axes_world @ c.centre_world)[:2] for c in same]))
    assert route is not None
    return layers_of(site, part_near(route, site.origin[:2]) if with_route else None)


# Stored


@pytest.mark.parametrize("index", range(8))
def test_stored_layers_are_those_found_out(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene, index: int
) -> None:
    for scene in (tiny_scene, unlabelled_scene):
        key = scene.keys[index]
        assert_same(found_out(scene, key), scene.layers(key))


def test_the_way_driven_matters_to_a_camera_that_looks_aside(tiny_scene: WeatherScene) -> None:
    """Else the test above would not tell a scene that forgot the way: a planted fault."""
    key = FrameKey(1, "right")
    straight = found_out(tiny_scene, key, with_route=False)
    stored = tiny_scene.layers(key)
    assert np.abs(straight.maps[LATERAL_M] - stored.maps[LATERAL_M]).max() > 3
    with pytest.raises(AssertionError):
        assert_same(straight, stored)


def test_the_road_left_of_the_way_is_left_of_it(tiny_scene: WeatherScene) -> None:
    """The right camera looks 30 degrees to the right: its lower right corner lies there."""
    lateral_m = tiny_scene.layers(FrameKey(0, "right")).maps[LATERAL_M]
    assert lateral_m[-1, -1] < -1 < 1 < tiny_scene.layers(FrameKey(0, "front")).maps[11, -10, 0]


def test_layers_are_files_that_anybody_can_read(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene
) -> None:
    maps = np.load(tiny_scene.path / f"{FIRST}.layers.npy", mmap_mode="r")
    assert (maps.dtype, maps.shape) == (np.float16, SHAPE)
    small = np.load(tiny_scene.path / f"{FIRST}.small.npy")
    assert (small == thumbnail_of(tiny_scene.frame(tiny_scene.keys[0]).image)).all()
    assert not list(tiny_scene.path.rglob("*classes*")), "the label says it"
    assert len(list(unlabelled_scene.path.rglob("*.classes.npy"))) == 8
    assert len(NAMES) == SHAPE[0]


@dataclass(frozen=True)
class Gapped(TinyClip):
    """Nobody labelled a narrow line across the street."""

    def frame(self, key: FrameKey) -> Frame:
        frame = super().frame(key)
        label = frame.label.copy()
        label[30:33] = IGNORE
        return replace(frame, label=label)


def test_closed_gaps_are_stored(tmp_path: Path) -> None:
    scene = WeatherScene.build(Gapped(frames=1), tmp_path / "scene")
    key = scene.keys[0]
    label, layers = scene.frame(key).label, scene.layers(key)
    assert label is not None
    assert (label == IGNORE).any()
    assert not (layers.classes == IGNORE).any()
    assert (scene.path / f"{FIRST}.classes.npy").is_file()


@pytest.mark.parametrize("kind", ["stood", "pictures"])
def test_without_a_way_it_goes_straight_ahead(tmp_path: Path, kind: str) -> None:
    clip = TinyClip(frames=1 if kind == "stood" else 4)
    if kind == "pictures":
        object.__setattr__(clip, "is_drive", False)
    scene = WeatherScene.build(clip, tmp_path / "scene")
    key = scene.keys[1]
    assert_same(looked_at(scene.frame(key), scene.ambience(key)), scene.layers(key))


# Rendered


def test_a_render_reads_what_is_stored(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "layers_seen", lambda *_: pytest.fail("looked"))
    scene = WeatherScene.load(tiny_scene.path)
    key = scene.keys[3]
    shot = scene.render(key, STORM, seed=1)
    layers = found_out(scene, key)
    frame, ambience = scene.frame(key), scene.ambience(key)
    by_hand = render(frame, STORM, seed=1, ambience=ambience, layers=layers)
    assert by_hand.image.tobytes() == shot.image.tobytes()
    assert by_hand.transmittance.tobytes() == shot.transmittance.tobytes()


def test_clear_weather_reads_no_layers(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "read_layers", lambda *_: pytest.fail("read"))
    tiny_scene.render(tiny_scene.keys[0], Weather.clear())


def test_an_old_scene_renders_the_same_picture(tiny_scene: WeatherScene, folder: Path) -> None:
    of_before(folder)
    assert not list(folder.rglob("*layers*"))
    old = WeatherScene.load(folder, verify=True)
    for key in old.keys[:2]:
        assert old.manifest.by_key[key].layers is None
        assert_same(tiny_scene.layers(key), old.layers(key))
        expected = tiny_scene.render(key, STORM, seed=2, window=(5, 7, 30, 40))
        actual = old.render(key, STORM, seed=2, window=(5, 7, 30, 40))
        assert expected.image.tobytes() == actual.image.tobytes()


# Written by somebody else


def _maps(place: float) -> bytes:
    maps = np.zeros(SHAPE, np.float16)
    maps[3, 4, 5] = place
    return npy_bytes(maps, "<f2")


MALFORMED: dict[str, tuple[str, bytes]] = {
    "NaN": ("layers", _maps(np.nan)),
    "negative NaN": ("layers", _maps(-np.nan)),
    "infinity": ("layers", _maps(-np.inf)),
    "beyond the range": ("layers", _maps(-5000.0)),
    "another shape": ("layers", npy_bytes(np.zeros((20, 64, 48), np.float16), "<f2")),
    "one layer less": ("layers", npy_bytes(np.zeros((19, 48, 64), np.float16), "<f2")),
    "another type": ("layers", npy_bytes(np.zeros(SHAPE, np.float32), "<f4")),
    "cut": ("layers", _maps(0.0)[:-2]),
    "empty": ("layers", b""),
    "a thumbnail of another shape": ("small", npy_bytes(np.zeros((64, 48, 3), np.uint8), "|u1")),
    "a thumbnail cut": ("small", npy_bytes(np.zeros((48, 64, 3), np.uint8), "|u1")[:-9]),
    "classes of another type": ("classes", npy_bytes(np.zeros((48, 64), np.int16), "<i2")),
    "classes cut": ("classes", npy_bytes(np.zeros((48, 64), np.uint8), "|u1")[:-1]),
}


@pytest.mark.parametrize(("part", "data"), MALFORMED.values(), ids=MALFORMED.keys())
def test_a_layer_that_is_none_is_a_typed_error(
    unlabelled_scene: WeatherScene, tmp_path: Path, part: str, data: bytes
) -> None:
    folder = Path(shutil.copytree(unlabelled_scene.path, tmp_path / "scene"))
    plant(folder, f"{FIRST}.{part}.npy", data)
    scene = WeatherScene.load(folder, verify=True)
    for ask in (scene.layers, lambda key: scene.render(key, STORM)):
        with pytest.raises(SceneError, match=rf"000000_front\.{part}\.npy"):
            ask(scene.keys[0])
    assert scene.layers(scene.keys[1]).maps.shape == SHAPE


def test_the_largest_layer_that_is_told_can_be_read(folder: Path) -> None:
    """So that what is built can be opened; and that the refusals above are not of the zeros."""
    for value in (storing.LARGEST, -storing.LARGEST, 0.0):
        plant(folder, f"{FIRST}.layers.npy", _maps(value))
        scene = WeatherScene.load(folder)
        assert scene.layers(scene.keys[0]).maps[3, 4, 5] == value


def _entry(field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["frames"][0]["layers"].update({field: value})


def _without(*path: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for step in ("frames", 0, *path[:-1]):
            content = content[step]
        del content[path[-1]]

    return change


FORGED: dict[str, Callable[[dict[str, Any]], None]] = {
    **{f"no {name}": _without("layers", name) for name in ("step", "tint", "plane")},
    "no illumination": _without("layers", "illumination"),
    "no record": _without("layers"),
    "no maps": _without("files", "layers"),
    "no thumbnail": _without("files", "small"),
    "a record of text": lambda m: m["frames"][0].update({"layers": "../x"}),
    "a record that is null": lambda m: m["frames"][0].update({"layers": None}),
    **{f"step {x!r}": _entry("step", x) for x in (0, -1, 1.5, "1", True, None, [1], 10**400)},
    **{f"tint {x!r}": _entry("tint", x) for x in ([0, 0], 3, "red", [1e9, 0, 0], [10**400] * 3)},
    **{f"plane {x!r}": _entry("plane", x) for x in ([0, 1e9, 0], [1e300, 0, 0], None)},
    **{f"light {x!r}": _entry("illumination", x) for x in (-1, 1e9, "1 lx", None, [])},
}


@pytest.mark.parametrize("change", FORGED.values(), ids=FORGED.keys())
def test_a_forged_record_is_refused_at_load(
    folder: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    rewrite(folder, lambda m: None)
    assert WeatherScene.load(folder).keys, "sealing again is no damage"
    rewrite(folder, change)
    with pytest.raises((SceneError, IntegrityError)) as caught:
        scene = WeatherScene.load(folder)
        scene.layers(scene.keys[0])
    assert str(caught.value).isprintable()


def test_an_unlabelled_frame_without_classes_is_refused(
    unlabelled_scene: WeatherScene, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(unlabelled_scene.path, tmp_path / "scene"))
    rewrite(folder, _without("files", "classes"))
    with pytest.raises(SceneError, match="malformed"):
        WeatherScene.load(folder)


@pytest.mark.parametrize("part", ["layers", "small"])
def test_damage_is_found(folder: Path, part: str) -> None:
    path = folder / f"{FIRST}.{part}.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(IntegrityError, match=f"{part}.npy has changed"):
        WeatherScene.load(folder, verify=True)
    scene = WeatherScene.load(folder)
    path.unlink()
    with pytest.raises(SceneError, match=f"{part}.npy cannot be read"):
        scene.layers(scene.keys[0])
    with pytest.raises(IntegrityError, match="missing"):
        WeatherScene.load(folder)


def test_surfaces_that_cannot_be_told_are_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: the editor makes a number that is none. Nothing is left behind."""
    seen = storing.layers_seen

    def spoilt(frame: Frame, street: storing.Street, mirrored: None) -> Layers:
        layers = seen(frame, street, mirrored)
        maps = np.where(np.arange(20)[:, None, None] == 7, np.float16(np.nan), layers.maps)
        return replace(layers, maps=maps)

    monkeypatch.setattr("weather_aug.scene.build.layers_seen", spoilt)
    with pytest.raises(DataError, match="000000_front: its surfaces cannot be told"):
        WeatherScene.build(TinyClip(frames=1), tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_reading_changes_nothing(folder: Path) -> None:
    before = digests_of(folder)
    scene = WeatherScene.load(folder)
    for key in scene.keys:
        scene.layers(key)
    assert digests_of(folder) == before
