"""Each layout as its readers look for it: suffixes, flat folders, equal stems, 16-bit planes."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_export import POLICY, TinyClip, tree_of

from weather_aug import _files
from weather_aug.clip.folder import read_depth
from weather_aug.clip.open import open_clip
from weather_aug.render.compose import RenderedFrame
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import SKY
from weather_aug.writers.export import export
from weather_aug.writers.layout import LAYOUTS, PARTS, Layout
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.sample import encoded_parts, render_recipe
from weather_aug.writers.verify import verify_export

ALL = tuple(LAYOUTS)
COUNT = 5


def planned(scene: WeatherScene, layout: str, parts: tuple[str, ...] | None = None) -> ExportPlan:
    """A few samples, three of them in a tar where there are tars."""
    plan = plan_export([scene], POLICY, count=COUNT, seed=3, layout=layout, parts=parts)
    if plan.layout.tar is None:
        return plan
    return replace(plan, layout=replace(plan.layout, items_per_unit=3))


def exported(scene: WeatherScene, folder: Path, layout: str, parts: Any = None) -> Path:
    out = folder / "out"
    export(planned(scene, layout, parts), out)
    return out


def entries(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def bytes_of(out: Path, entry: dict[str, Any]) -> dict[str, bytes]:
    """The parts of a sample, from files or by the offsets in its tar."""
    if "members" not in entry:
        return {part: (out / file["path"]).read_bytes() for part, file in entry["files"].items()}
    tar = (out / entry["files"]["tar"]["path"]).read_bytes()
    return {
        part: tar[member["offset"] : member["offset"] + member["size"]]
        for part, member in entry["members"].items()
    }


def scanned(folder: Path, suffix: str) -> list[str]:
    """Relative paths as the trainers' recursive scan gives them, links followed."""
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob(f"*{suffix}"))


@pytest.mark.parametrize("layout", ALL)
def test_all_parts_come_again_from_their_recipe(
    scene: WeatherScene, tmp_path: Path, layout: str
) -> None:
    out = exported(scene, tmp_path, layout, PARTS)
    assert verify_export(out) == []
    for entry in entries(out):
        made = encoded_parts(render_recipe(scene, entry["recipe"]), PARTS)
        assert bytes_of(out, entry) == made
        stored = entry.get("members", entry["files"])
        assert {part: file["sha256"] for part, file in stored.items()} == {
            part: _files.sha256_of(data) for part, data in made.items()
        }


@pytest.mark.parametrize("layout", ALL)
def test_without_a_choice_the_layout_decides_the_parts(
    scene: WeatherScene, tmp_path: Path, layout: str
) -> None:
    out = exported(scene, tmp_path, layout)
    assert all(tuple(bytes_of(out, entry)) == LAYOUTS[layout].parts for entry in entries(out))
    has_stats = (out / "samples_with_class.json").exists()
    assert has_stats == LAYOUTS[layout].has_class_stats == (layout in ("cityscapes", "gta"))


def test_acdc_is_found_by_its_suffixes(scene: WeatherScene, tmp_path: Path) -> None:
    out = exported(scene, tmp_path, "acdc")
    images = scanned(out / "rgb_anon" / "train", "_rgb_anon.png")
    assert len(images) == COUNT
    for image in images:
        for suffix in ("_gt_labelTrainIds.png", "_gt_invIds.png"):
            path = out / "gt" / "train" / image.replace("_rgb_anon.png", suffix)
            plane = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert (plane.shape, plane.dtype) == ((32, 48), np.uint8)
    invalid = [encoded(out, entry, "invalid") for entry in entries(out)]
    assert set(np.unique(invalid)) <= {0, 1}


def encoded(out: Path, entry: dict[str, Any], part: str) -> np.ndarray:
    data = np.frombuffer(bytes_of(out, entry)[part], np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def rare_class_indices(out: Path) -> set[int]:
    """Which samples rare-class sampling of a GTADataset can draw: by path below labels/."""
    pictures = scanned(out / "images", ".png")
    labels = [picture.replace(".png", "_labelTrainIds.png") for picture in pictures]
    assert all((out / "labels" / label).is_file() for label in labels)
    index_of = {label: index for index, label in enumerate(labels)}
    by_class = json.loads((out / "samples_with_class.json").read_text())
    return {index_of[file.split("/")[-1]] for files in by_class.values() for file, _ in files}


def large(folder: Path) -> WeatherScene:
    """A scene in which a class has more than 3,000 pixels."""
    return WeatherScene.build(TinyClip(width=96, height=64), folder / "large")


def test_gta_is_flat_so_that_rare_classes_are_found(tmp_path: Path) -> None:
    out = exported(large(tmp_path), tmp_path, "gta")
    assert rare_class_indices(out) == set(range(COUNT))


def test_gta_in_folders_is_not_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gta = LAYOUTS["gta"]
    nested = {part: path.replace("/", "/{scene}/") for part, path in gta.paths.items()}
    monkeypatch.setitem(LAYOUTS, "gta", replace(gta, paths=nested))
    out = exported(large(tmp_path), tmp_path, "gta")
    with pytest.raises(KeyError):
        rare_class_indices(out)


def test_folders_are_a_clip_again(scene: WeatherScene, tmp_path: Path) -> None:
    out = exported(scene, tmp_path, "folders", ("image", "label", "depth"))
    options = "images=images&labels=labels&depth=depth&taxonomy=train_ids&focal_px=48"
    clip = open_clip(f"folder:{out}?{options}")
    assert len(clip.keys) == COUNT
    shots = {e["files"]["image"]["path"]: render_recipe(scene, e["recipe"]) for e in entries(out)}
    for key, path in zip(clip.keys, sorted(shots), strict=True):
        frame, shot = clip.frame(key), shots[path]
        np.testing.assert_array_equal(shot.image, frame.image)
        np.testing.assert_array_equal(shot.label, frame.label)
        assert frame.depth_m is not None
        near = shot.depth < 255
        assert near.any()
        np.testing.assert_allclose(frame.depth_m[near], shot.depth[near], atol=1 / 512)
        assert np.isinf(frame.depth_m[np.isinf(shot.depth) & (shot.label == SKY)]).all()


def test_a_scene_is_built_of_exported_folders(scene: WeatherScene, tmp_path: Path) -> None:
    out = exported(scene, tmp_path, "folders", ("image", "label", "depth"))
    clip = open_clip(f"folder:{out}?images=images&labels=labels&depth=depth&taxonomy=train_ids")
    again = WeatherScene.build(clip, tmp_path / "again")
    assert len(again.keys) == COUNT


@dataclass
class Planes:
    """What `encoded_parts` reads of a rendered frame."""

    transmittance: np.ndarray
    depth: np.ndarray


def decoded(part: str, plane: np.ndarray) -> np.ndarray:
    shot: Any = Planes(plane, plane)
    png = encoded_parts(shot, (part,))[part]
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint16
    return found


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=50))
def test_transmittance_is_kept_to_half_a_step_of_16_bits(values: list[float]) -> None:
    shares = np.array([values], np.float32)
    # A float32 product adds a few thousandths of a step.
    assert np.abs(decoded("transmittance", shares) / 65535 - shares).max() <= 0.51 / 65535


@given(st.lists(st.floats(0, 1e6, width=32) | st.just(np.inf), min_size=1, max_size=50))
def test_depth_is_kept_to_half_a_step_or_unknown(values: list[float]) -> None:
    depth = np.array([values], np.float32)
    steps = decoded("depth", depth)
    fits = depth < 255.99
    assert np.abs(steps[fits] / 256 - depth[fits]).max(initial=0) <= 1 / 512
    assert not steps[depth >= 256].any()


def test_the_clip_reader_and_the_exporter_mean_the_same_depth(tmp_path: Path) -> None:
    depth = np.array([[0.5, 12.25, 255.75, 300.0, np.inf]], np.float32)
    shot: Any = Planes(depth, depth)
    (tmp_path / "a.png").write_bytes(encoded_parts(shot, ("depth",))["depth"])
    expected = np.array([[0.5, 12.25, 255.75, np.nan, np.nan]], np.float32)
    np.testing.assert_array_equal(expected, read_depth(tmp_path / "a.png"))


def test_eight_bits_of_transmittance_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    from weather_aug.writers import sample

    def coarse(shot: RenderedFrame) -> np.ndarray:
        return (np.rint(shot.transmittance * 255) * 257).astype(np.uint16)

    monkeypatch.setitem(sample._PLANES, "transmittance", coarse)
    with pytest.raises(AssertionError):
        test_transmittance_is_kept_to_half_a_step_of_16_bits()


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=ALL)
def test_no_two_parts_share_a_path(layout: Layout) -> None:
    paths = {layout.path(part, split="s", scene="c", base="b") for part in layout.paths}
    assert len(paths) == len(PARTS)
    assert set(layout.parts) <= set(layout.paths) == set(PARTS)


@pytest.mark.parametrize("layout", ["acdc", "gta", "folders"])
def test_an_unlabelled_scene_has_no_folder_of_labels(tmp_path: Path, layout: str) -> None:
    scene = WeatherScene.build(TinyClip(labelled=False), tmp_path / "scene")
    out = exported(scene, tmp_path, layout, ("image", "label"))
    pictures = {path for path in tree_of(out) if path.endswith(".png")}
    assert len(pictures) == COUNT
    assert not any("abel" in path for path in pictures)
    assert not (out / "labels").exists()
