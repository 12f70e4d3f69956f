"""The exported tree: what is in it, and what an output must be like."""

from __future__ import annotations

import json
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_export import POLICY, TinyClip, tree_of

from weather_aug import _files
from weather_aug.errors import ArgumentError, ConflictError, IntegrityError, OutputError, SceneError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import engines, lock
from weather_aug.writers.choices import FromPolicy
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.sample import encoded_parts, render_recipe


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def entries(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def refuse_to_render(*_: object) -> str:
    raise AssertionError("nothing should have been rendered")


def test_a_loader_that_swaps_suffixes_finds_every_label(plan: ExportPlan, out: Path) -> None:
    export(plan, out)
    images = sorted(out.glob("leftImg8bit/train/**/*_leftImg8bit.png"))
    assert len(images) == plan.count
    for image in images:
        relative = image.relative_to(out / "leftImg8bit").as_posix()
        swapped = relative.replace("_leftImg8bit.png", "_gtFine_labelTrainIds.png")
        label = cv2.imread(str(out / "gtFine" / swapped), cv2.IMREAD_UNCHANGED)
        assert (32, 48) == label.shape
        assert np.uint8 == label.dtype
        assert set(np.unique(label)) <= {*range(19), 255}
        assert (32, 48, 3) == cv2.imread(str(image)).shape


def test_a_recipe_renders_to_the_same_bytes(
    plan: ExportPlan, scene: WeatherScene, out: Path
) -> None:
    export(plan, out)
    for entry in entries(out):
        for part, data in encoded_parts(render_recipe(scene, entry["recipe"])).items():
            assert entry["files"][part]["sha256"] == _files.sha256_of(data)
            assert (out / entry["files"][part]["path"]).read_bytes() == data


def test_a_recipe_of_another_scene_is_refused(plan: ExportPlan, scene: WeatherScene) -> None:
    with pytest.raises(SceneError, match="not the scene of this recipe"):
        render_recipe(scene, plan.recipe(0) | {"scene_digest": "0" * 64})


def test_the_picture_written_is_the_picture_rendered(
    plan: ExportPlan, scene: WeatherScene, out: Path
) -> None:
    export(plan, out)
    item = plan.item(2)
    shot = scene.render(item.key, item.draw.weather, seed=item.draw.seed)
    paths = plan.paths(2)
    image = cv2.imread(str(out / paths["image"]), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(shot.image, image)
    label = cv2.imread(str(out / paths["label"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shot.label, label)


def test_nothing_in_the_tree_tells_where_or_when_it_was_made(plan: ExportPlan, out: Path) -> None:
    export(plan, out)
    for path in out.glob("*.json*"):
        text = path.read_text()
        for private in (str(out.parent), str(plan.scenes[0].path), socket.gethostname()):
            assert private not in text
    assert not (out / ".export").exists()


def test_the_report_counts(plan: ExportPlan, out: Path) -> None:
    seen: list[dict[str, Any]] = []
    report = export(plan, out, on_sample=seen.append)
    assert (report.samples, report.rendered, report.damaged, report.labelled) == (10, 10, 0, 10)
    assert seen == entries(out)
    sizes = [path.stat().st_size for path in out.rglob("*.png")]
    assert report.bytes == sum(sizes)


def test_a_finished_export_is_left_alone(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(plan, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr(engines, "write_unit", refuse_to_render)
    for verify in (False, True):
        assert export(plan, out, verify=verify).rendered == 0
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}


def zero(path: Path) -> None:
    path.write_bytes(b"")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def other(path: Path) -> None:
    path.write_bytes(next(p for p in path.parent.iterdir() if p != path).read_bytes())


DAMAGES = [zero, cut, flip, other, Path.unlink]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("part", ["image", "label"])
def test_damage_to_a_finished_export_is_repaired(
    plan: ExportPlan, out: Path, damage: Any, part: str, expected_tree: dict[str, str]
) -> None:
    export(plan, out)
    damage(out / plan.paths(4)[part])
    assert tree_of(out) != expected_tree
    report = export(plan, out, verify=True)
    assert (report.rendered, report.damaged) == (1, 1)
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_to_committed_samples_is_repaired_on_resume(
    plan: ExportPlan, out: Path, damage: Any, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 5)
    damage(out / plan.paths(1)["image"])
    damage(out / plan.paths(3)["label"])
    report = export(plan, out)
    assert (report.rendered, report.damaged) == (7, 2)
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("name", ["manifest.jsonl", "samples_with_class.json"])
@pytest.mark.parametrize("damage", [zero, cut, flip, Path.unlink])
def test_damage_to_the_root_files_is_repaired(
    plan: ExportPlan, out: Path, name: str, damage: Any, expected_tree: dict[str, str]
) -> None:
    export(plan, out)
    damage(out / name)
    export(plan, out)
    assert tree_of(out) == expected_tree


def test_an_export_whose_job_cannot_be_read_is_refused(plan: ExportPlan, out: Path) -> None:
    export(plan, out)
    flip(out / "export.json")
    with pytest.raises(IntegrityError, match=r"remove the folder"):
        export(plan, out)


def interrupt_after(plan: ExportPlan, out: Path, samples: int) -> None:
    """Export until `samples` are committed, then stop as Ctrl-C does."""
    left = iter(range(samples - 1))

    def stop(_: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(plan, out, on_sample=stop)


def test_interrupted_work_is_continued(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 6)
    assert not (out / "export.json").exists()
    assert export(plan, out).rendered == 4
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("cut_bytes", [1, 20, 400])
def test_a_journal_cut_by_a_crash_loses_only_its_last_lines(
    plan: ExportPlan, out: Path, cut_bytes: int, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 6)
    journal = out / ".export" / "journal"
    journal.write_bytes(journal.read_bytes()[:-cut_bytes])
    assert export(plan, out).rendered == 5
    assert tree_of(out) == expected_tree


def test_a_changed_line_of_the_journal_is_not_trusted(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 6)
    journal = out / ".export" / "journal"
    lines = journal.read_text().splitlines(keepends=True)
    assert '"0": ' in lines[3]
    lines[3] = lines[3].replace('"0": ', '"1": ')
    journal.write_text("".join(lines))
    report = export(plan, out)
    assert (report.rendered, report.damaged) == (5, 1)
    assert tree_of(out) == expected_tree


def test_a_journal_without_a_readable_job_is_refused(plan: ExportPlan, out: Path) -> None:
    interrupt_after(plan, out, 2)
    journal = out / ".export" / "journal"
    journal.write_bytes(b"x" + journal.read_bytes())
    with pytest.raises(IntegrityError, match="is damaged"):
        export(plan, out)


def test_leftovers_of_a_killed_run_are_removed(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 6)
    (out / (plan.paths(7)["image"] + ".tmp")).write_bytes(b"half")
    (out / "manifest.jsonl.tmp").write_bytes(b"half")
    (out / ".export" / "journal.tmp").write_bytes(b"half")
    export(plan, out)
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("finished", [True, False])
def test_another_job_is_refused_by_its_first_differing_field(
    plan: ExportPlan, out: Path, finished: bool
) -> None:
    export(plan, out) if finished else interrupt_after(plan, out, 3)
    before = tree_of(out)
    changes: dict[str, Any] = {
        "seed": {"choice": FromPolicy(POLICY, 4)},
        "count": {"count": 11},
        "policy": {"choice": FromPolicy(replace(POLICY, falling=0.1), 3)},
    }
    for field, change in changes.items():
        with pytest.raises(ConflictError, match=f"its {field} is"):
            export(replace(plan, **change), out)
    with pytest.raises(ConflictError, match="its policy is"):
        export(replace(plan, choice=FromPolicy(replace(POLICY, falling=0.1), 4)), out)
    after = tree_of(out)
    after.pop(".export/lock", None), before.pop(".export/lock", None)
    assert after == before


def test_another_scene_is_another_job(plan: ExportPlan, tmp_path: Path) -> None:
    export(plan, tmp_path / "out")
    changed = WeatherScene.build(TinyClip(tint=1), tmp_path / "scene")
    with pytest.raises(ConflictError, match="its scenes is"):
        export(plan_export([changed], POLICY, count=10, seed=3), tmp_path / "out")


def test_an_output_in_use_names_its_holder(plan: ExportPlan, out: Path) -> None:
    out.mkdir()
    with (
        lock.exclusive(out),
        pytest.raises(ConflictError, match=f"by process {os.getpid()} on"),
    ):
        export(plan, out)
    assert list(out.iterdir()) == []
    assert export(plan, out).samples == 10


def test_an_exporter_waits_for_the_workers_of_a_dead_one(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "ORPHANS_WAIT_S", 0.1)
    (out / ".export").mkdir(parents=True)
    with lock.working(out), pytest.raises(ConflictError, match="still write"):
        export(plan, out)


def test_unusable_outputs_are_refused_before_the_first_render(
    plan: ExportPlan, scene: WeatherScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "write_unit", refuse_to_render)
    file = tmp_path / "file"
    file.write_text("x")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    inside = tmp_path / "inside"
    inside.symlink_to(scene.path)
    full = tmp_path / "full"
    (full / "mine").mkdir(parents=True)
    for out, error, words in [
        (scene.path / "out", OutputError, "inside the scene"),
        (scene.path, OutputError, "inside the scene"),
        (inside / "out", OutputError, "inside the scene"),
        (file, OutputError, "not a folder"),
        (file / "out", OutputError, "cannot write"),
        (loop, OutputError, "cannot write"),
        (full, ConflictError, "holds mine"),
    ]:
        with pytest.raises(error, match=words):
            export(plan, out)
    assert sorted(path.name for path in full.iterdir()) == ["mine"]
    assert WeatherScene.load(scene.path, verify=True).damaged_files() == []


def test_missing_parent_folders_are_made(
    plan: ExportPlan, tmp_path: Path, expected_tree: dict[str, str]
) -> None:
    out = tmp_path / "a" / "b" / "out"
    assert export(plan, out).samples == 10
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("workers", [-1, 1025, 1.5, True])
def test_a_number_of_workers_that_makes_no_sense_is_refused(
    plan: ExportPlan, out: Path, workers: Any
) -> None:
    with pytest.raises(ArgumentError, match="workers must be"):
        export(plan, out, workers=workers)
    assert not out.exists()


def test_an_unreadable_scene_is_named(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(), tmp_path / "scene")
    plan = plan_export([scene], POLICY, count=4, seed=0)
    picture = scene.path / "frames" / f"{plan.item(1).key}.png"
    with pytest.raises(SceneError, match=r"front.png cannot be read: No such file"):
        export(plan, tmp_path / "out", on_sample=lambda _: picture.unlink())
