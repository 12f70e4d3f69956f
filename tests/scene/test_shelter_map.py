"""The map of covers: a bridge is found where it is, and nothing else is taken for one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_street import CARS, CROWNS, DECK, FACADES, BoxStreet
from numpy.typing import NDArray
from tiny_clip import digests_of

from weather_aug import _files
from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import Clip
from weather_aug.edit.ambience import CAMERA_HEIGHT_M, camera_height_m
from weather_aug.errors import IntegrityError, SceneError
from weather_aug.particles.shelter import Shelter
from weather_aug.scene import shelter as module
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.shelter import View, shelter_of
from weather_aug.taxonomy import BUILDING

SCENERY = (*FACADES, *CARS, *CROWNS)
UP = np.array([0.0, 0.0, 1.0])


def views(clip: Clip) -> Iterator[View]:
    for key in clip.keys:
        frame = clip.frame(key)
        assert frame.depth_m is not None
        yield View(frame.camera, frame.depth_m, frame.label)


def map_of(clip: Clip) -> Shelter | None:
    return shelter_of(views(clip), np.eye(3))


def cover_at(shelter: Shelter, x: float, y: float) -> float:
    """Height over the world's 0, inf where the sky is open."""
    i, j = np.floor((np.array([x, y]) - shelter.origin_m[:2]) / shelter.cell_m).astype(int)
    rows, columns = shelter.cover_m.shape
    if not (0 <= i < rows and 0 <= j < columns):
        return np.inf
    return float(shelter.cover_m[i, j] + shelter.origin_m[2])


@pytest.fixture(scope="module")
def bridge_scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    folder = tmp_path_factory.mktemp("bridge") / "scene"
    return WeatherScene.build(BoxStreet((DECK, *SCENERY)), folder)


@pytest.fixture(scope="module")
def street_views() -> list[View]:
    return list(views(StreetClip(frames=6, width=256, height=144)))


# What is found


@pytest.mark.parametrize("labelled", [True, False])
def test_a_bridge_is_found_where_it_is(labelled: bool) -> None:
    shelter = map_of(BoxStreet((DECK, *SCENERY), labelled=labelled))
    assert shelter is not None
    for x in (31.0, 36.0, 41.0):
        for y in (-2.5, 0.0, 2.5):
            assert cover_at(shelter, x, y) == pytest.approx(5.0, abs=0.2)
    # Never outside; a cell is half a metre.
    covered = np.argwhere(np.isfinite(shelter.cover_m)) * shelter.cell_m + shelter.origin_m[:2]
    assert covered[:, 0].min() >= 29.5
    assert covered[:, 0].max() <= 42.0
    assert np.abs(covered[:, 1] + 0.25).max() <= 12.25


def test_a_bridge_is_found_in_noisy_depth() -> None:
    shelter = map_of(BoxStreet((DECK, *SCENERY), noise=0.03))
    assert shelter is not None
    assert cover_at(shelter, 36.0, 0.0) == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize("noise", [0.02, 0.1])
@pytest.mark.parametrize("labelled", [True, False])
def test_facades_crowns_and_cars_are_no_cover(labelled: bool, noise: float) -> None:
    assert map_of(BoxStreet(SCENERY, labelled=labelled, noise=noise)) is None


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("labelled", [True, False])
def test_a_street_without_bridges_is_open(
    street_views: list[View], labelled: bool, noise: float
) -> None:
    rng = np.random.default_rng(5)
    seen = []
    for view in street_views:
        factor = np.maximum(1 + noise * rng.standard_normal(view.depth_m.shape), 0.1)
        label = view.label if labelled else None
        seen.append(View(view.camera, view.depth_m * factor, label))
    assert shelter_of(seen, np.eye(3)) is None


def _greatest_heights(table: Any) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Planted fault: the greatest height in each cell, whatever is below it."""
    high = table.key[table.covers > 0]
    cells, start = np.unique(high >> 16, return_index=True)
    last = np.append(start[1:], len(high)) - 1
    return cells, (high[last] & 0xFFFF) * 0.5 - 0.5 * (1 << 15)


def test_the_greatest_height_of_a_cell_makes_holes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_covered", _greatest_heights)
    assert map_of(BoxStreet(SCENERY, noise=0.1)) is not None


def test_without_labels_a_crown_must_not_pass_as_small_cover(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Planted fault: the rules for labels where there are none."""
    monkeypatch.setattr(module, "LEAST_UNLABELLED_AREA_M2", 0.5 * module.LEAST_AREA_M2)
    assert map_of(BoxStreet(SCENERY, labelled=False, noise=0.02)) is not None


def test_one_look_is_not_enough() -> None:
    clip = BoxStreet((DECK,), frames=1)
    assert map_of(clip) is None
    assert shelter_of([], np.eye(3)) is None


def test_what_is_narrow_is_no_cover() -> None:
    """A gantry over the road, called a building by a teacher."""
    gantry = (BUILDING, (30.0, 31.0), (-12.0, 12.0), (5.0, 6.2))
    assert map_of(BoxStreet((gantry,))) is None


def test_bridges_too_far_apart_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_CELLS", 50)
    with pytest.raises(SceneError, match=r"too far for one map; build it in parts"):
        map_of(BoxStreet((DECK,)))


# What is stored


def test_a_scene_keeps_the_map(bridge_scene: WeatherScene) -> None:
    shelter = bridge_scene.shelter
    assert shelter is not None
    assert cover_at(shelter, 36.0, 0.0) == pytest.approx(5.0, abs=0.2)
    assert shelter is bridge_scene.shelter
    assert (shelter.axes_world == bridge_scene.manifest.axes_world).all()
    assert store.SHELTER in bridge_scene.manifest.files
    assert WeatherScene.load(bridge_scene.path, verify=True).damaged_files() == []
    assert np.load(bridge_scene.path / store.SHELTER).dtype == np.float32


def test_a_build_that_is_continued_makes_the_same_map(
    bridge_scene: WeatherScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(data: bytes) -> None:
        raise RuntimeError("power cut")

    clip = BoxStreet((DECK, *SCENERY))
    with monkeypatch.context() as patch:
        patch.setattr(store, "manifest_bytes", cut)
        with pytest.raises(RuntimeError, match="power cut"):
            WeatherScene.build(clip, tmp_path / "scene")
    WeatherScene.build(clip, tmp_path / "scene")
    assert digests_of(tmp_path / "scene") == digests_of(bridge_scene.path)


def test_an_open_street_and_unrelated_pictures_have_no_map(tmp_path: Path) -> None:
    for name, clip in (
        ("open", BoxStreet((), frames=2)),
        ("pictures", BoxStreet((DECK,), is_drive=False)),
    ):
        scene = WeatherScene.build(clip, tmp_path / name)
        assert scene.shelter is None
        assert store.SHELTER not in digests_of(scene.path)


def _rewritten(folder: Path, change: Any) -> None:
    content = json.loads((folder / store.MANIFEST).read_text())
    change(content)
    content.pop("sha256")
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    sealed = content | {"sha256": _files.sha256_of(text.encode())}
    (folder / store.MANIFEST).write_text(json.dumps(sealed))


def test_a_scene_of_before_loads(bridge_scene: WeatherScene, tmp_path: Path) -> None:
    def older(content: dict[str, Any]) -> None:
        del content["shelter"], content["files"][store.SHELTER]
        for entry in content["frames"]:
            del entry["camera_height_m"]

    folder = Path(shutil.copytree(bridge_scene.path, tmp_path / "scene"))
    (folder / store.SHELTER).unlink()
    _rewritten(folder, older)
    scene = WeatherScene.load(folder, verify=True)
    assert scene.shelter is None
    assert scene.ambience(scene.keys[0]).camera_height_m == CAMERA_HEIGHT_M


@pytest.mark.parametrize(
    "change",
    [
        {"file": "../shelter.npy"},
        {"shape": [3]},
        {"shape": [0, 4]},
        {"shape": [10**6, 10**6]},
        {"origin_m": [0, 0]},
        {"cell_m": -1},
    ],
)
def test_a_forged_record_of_the_map_is_refused(
    bridge_scene: WeatherScene, tmp_path: Path, change: dict[str, Any]
) -> None:
    folder = Path(shutil.copytree(bridge_scene.path, tmp_path / "scene"))
    _rewritten(folder, lambda content: content["shelter"].update(change))
    with pytest.raises(SceneError, match="malformed"):
        WeatherScene.load(folder)


def test_a_damaged_map_is_found(bridge_scene: WeatherScene, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(bridge_scene.path, tmp_path / "scene"))
    data = bytearray((folder / store.SHELTER).read_bytes())
    data[-1] ^= 1
    (folder / store.SHELTER).write_bytes(data)
    with pytest.raises(IntegrityError, match=r"shelter\.npy has changed"):
        WeatherScene.load(folder, verify=True)
    data[200:204] = np.float32(np.nan).tobytes()
    (folder / store.SHELTER).write_bytes(data)
    with pytest.raises(SceneError, match="build the scene again"):
        WeatherScene.load(folder).shelter  # noqa: B018


# Height of the camera


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_height_of_the_camera_is_measured(labelled: bool, noise: float) -> None:
    clip = BoxStreet(SCENERY, labelled=labelled, noise=noise)
    frame = clip.frame(clip.keys[2])
    assert camera_height_m(frame, UP) == pytest.approx(1.6, abs=0.08)


def test_where_no_road_is_seen_the_height_is_a_guess() -> None:
    frame = BoxStreet(()).frame(BoxStreet(()).keys[0])
    nothing = replace(frame, depth_m=np.full(frame.depth_m.shape, np.inf, np.float32))
    assert camera_height_m(nothing, UP) == CAMERA_HEIGHT_M
    assert camera_height_m(replace(frame, depth_m=None), UP) == CAMERA_HEIGHT_M


def test_a_scene_keeps_the_height(bridge_scene: WeatherScene) -> None:
    height_m = bridge_scene.ambience(bridge_scene.keys[0]).camera_height_m
    assert height_m == pytest.approx(1.6, abs=0.02)
    assert {bridge_scene.ambience(key).camera_height_m for key in bridge_scene.keys} == {height_m}
