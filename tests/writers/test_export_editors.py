"""Exports and merges name the editors of backgrounds, and hold what trained them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from recorded_editor import Recorded, record
from tinting_editor import Tinting
from tiny_export import POLICY, TinyClip, tree_of

from weather_aug import _files
from weather_aug.errors import IntegrityError
from weather_aug.scene.backgrounds_record import TRAINED_ON
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import layout, manifest
from weather_aug.writers.export import export
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.merged import read_merge
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.verify import verify_export

ROOT_FILES = {
    *(layout.MANIFEST, layout.CLASS_STATS, layout.CLASS_STATS_DICT),
    layout.SAMPLES_WITH_CLASS,
}
RECORDS = {"rain": record("a", "b"), "snow": record("b", "c")}
WHOLE, SNOW = record("a", "b", "c"), RECORDS["snow"]


def name_of(trained_on: Any) -> str:
    return f"trained_on_{_files.sha256_of(trained_on.as_bytes())[:16]}.txt"


def scene_of(out: Path, editor: Any, *weathers: str, **clip: Any) -> WeatherScene:
    made = TinyClip(frames=1, **clip)
    return WeatherScene.build(made, out, editor=editor, weathers=weathers or None)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WeatherScene]:
    folder = tmp_path_factory.mktemp("edited")
    untold = Recorded(records={"snow": SNOW})
    return {
        "whole": scene_of(folder / "whole", Recorded(records=RECORDS), "rain", "snow"),
        "again": scene_of(folder / "again", Recorded(records=RECORDS), "rain", "snow", tint=5),
        "part": scene_of(folder / "part", untold, "rain", "snow"),
        "mute": scene_of(folder / "mute", Tinting(), "rain", "snow"),
        "physical": scene_of(folder / "physical", "physical"),
    }


@pytest.fixture(scope="module")
def plan(scenes: dict[str, WeatherScene]) -> ExportPlan:
    return plan_of(scenes.values())


def plan_of(scenes: Iterable[WeatherScene], **changes: Any) -> ExportPlan:
    return plan_export(list(scenes), POLICY, count=4, seed=1, **changes)


@pytest.fixture(scope="module")
def made(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tests that harm it copy it."""
    out = tmp_path_factory.mktemp("made") / "out"
    export(plan, out)
    return out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


def test_an_export_holds_each_record_once(made: Path) -> None:
    contents = layout.read_contents(made)
    card = json.loads(json.dumps(Tinting().card))
    editor = {"editor": "tinting", "card": card}
    assert contents["editors"] == [
        editor | {"trained_on": name_of(WHOLE)},
        editor | {"trained_on": name_of(SNOW), "unrecorded": ["rain"]},
        editor,
    ]
    found = sorted(path.name for path in made.glob("trained_on_*"))
    assert found == sorted([name_of(WHOLE), name_of(SNOW)])
    for trained_on in (WHOLE, SNOW):
        data = (made / name_of(trained_on)).read_bytes()
        assert data == trained_on.as_bytes()
        stored = {"size": len(data), "sha256": _files.sha256_of(data)}
        assert contents["files"][name_of(trained_on)] == stored
    assert verify_export(made) == []


def test_without_records_an_export_is_what_it_was(
    scenes: dict[str, WeatherScene], tmp_path: Path
) -> None:
    """As before there were any: the files at the root, and the editor with its card alone."""
    export(plan_of([scenes["mute"], scenes["physical"]]), tmp_path)
    contents = layout.read_contents(tmp_path)
    card = json.loads(json.dumps(Tinting().card))
    assert contents["editors"] == [{"editor": "tinting", "card": card}]
    assert set(contents["files"]) == ROOT_FILES


def test_it_is_the_same_however_the_export_went(
    plan: ExportPlan, made: Path, tmp_path: Path
) -> None:
    """Cut short before the records, between them, and behind them."""
    write = manifest._files.write_whole
    for place in range(3):
        out, left = tmp_path / str(place), place

        def cut(path: Path, data: bytes) -> None:
            nonlocal left
            if path.name.startswith(("trained_on_", "export.json")):
                left -= 1
                if left < 0:
                    raise KeyboardInterrupt
            write(path, data)

        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr("weather_aug._files.write_whole", cut)
            export(plan, out)
        assert not (out / "export.json").exists()
        export(plan, out)
        assert tree_of(out) == tree_of(made)


@pytest.mark.parametrize("harm", ["lost", "flipped"])
def test_a_harmed_record_is_found_and_repaired(
    plan: ExportPlan, made: Path, out: Path, harm: str
) -> None:
    path = out / name_of(SNOW)
    if harm == "lost":
        path.unlink()
        words = f"{path.name} is missing"
    else:
        path.write_bytes(path.read_bytes().replace(b"c" * 64, b"c" * 63 + b"d"))
        words = f"{path.name} has changed since it was written"
    assert [words in problem for problem in verify_export(out)] == [True]
    assert export(plan, out).rendered == 0
    assert tree_of(out) == tree_of(made)


def test_an_export_that_drops_a_record_would_be_seen(
    plan: ExportPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: the record is named, but not written."""
    monkeypatch.setattr(manifest, "write_records", lambda scenes, out: [])
    export(plan, tmp_path / "out")
    contents = layout.read_contents(tmp_path / "out")
    named = {e["trained_on"] for e in contents["editors"] if "trained_on" in e}
    assert named and not named & set(contents["files"])


def test_a_record_that_changed_in_the_scene_is_not_handed_on(
    scenes: dict[str, WeatherScene], tmp_path: Path
) -> None:
    copy = shutil.copytree(scenes["whole"].path, tmp_path / "scene")
    path = copy / TRAINED_ON
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"c" * 64, b"c" * 63 + b"d"))
    plan = plan_of([WeatherScene.load(copy)])
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        export(plan, tmp_path / "out")
    assert not (tmp_path / "out/export.json").exists()
    path.write_bytes(whole)
    export(plan, tmp_path / "out")
    assert verify_export(tmp_path / "out") == []


@pytest.mark.parametrize("place", ["memory", "file"])
def test_a_url_gets_the_records_too(
    plan: ExportPlan, made: Path, tmp_path: Path, place: str
) -> None:
    MemoryFileSystem.store.clear()
    url = "memory://bucket/edited" if place == "memory" else f"file://{tmp_path}/edited"
    export(plan, url, state=tmp_path / "state")
    fs, root = fsspec.core.url_to_fs(url)
    found = {p[len(root) + 1 :]: _files.sha256_of(fs.cat_file(p)) for p in fs.find(root)}
    assert found == tree_of(made)
    fs.rm_file(f"{root}/{name_of(SNOW)}")
    export(plan, url, state=tmp_path / "state")
    assert fs.cat_file(f"{root}/{name_of(SNOW)}") == SNOW.as_bytes()
    MemoryFileSystem.store.clear()


@pytest.mark.parametrize("hard", [False, True])
def test_a_merge_holds_the_records_of_its_exports(
    scenes: dict[str, WeatherScene], tmp_path: Path, hard: bool
) -> None:
    """Two exports with one record, in either order; and a merge of a merge."""
    outs = [tmp_path / name for name in ("whole", "again", "physical")]
    for path in outs:
        export(plan_of([scenes[path.name]]), path)
    merged = tmp_path / "merged"
    merge_cityscapes(outs[2], outs[:2], merged, hard=hard)
    path = merged / name_of(WHOLE)
    assert path.read_bytes() == WHOLE.as_bytes()
    assert path.is_symlink() != hard
    contents = read_merge(merged)
    assert [editor["trained_on"] for editor in contents["editors"]] == [path.name]
    assert list(contents["files"]) == [path.name]
    merge_cityscapes(outs[2], outs[1::-1], merged, hard=hard)
    assert path.read_bytes() == WHOLE.as_bytes()
    more = tmp_path / "more"
    export(plan_of([scenes["mute"]]), more)
    merge_cityscapes(merged, [more], tmp_path / "both", hard=hard)
    assert (tmp_path / "both" / path.name).read_bytes() == WHOLE.as_bytes()
    assert len(read_merge(tmp_path / "both")["editors"]) == 2


def test_a_merge_of_physical_exports_names_no_editor(
    scenes: dict[str, WeatherScene], tmp_path: Path
) -> None:
    export(plan_of([scenes["physical"]]), tmp_path / "out")
    merge_cityscapes(tmp_path / "out", [], tmp_path / "merged")
    contents = read_merge(tmp_path / "merged")
    assert contents["editors"] == [] and contents["files"] == {}


def test_a_merge_of_an_export_of_before_does_not_claim_to_know(
    scenes: dict[str, WeatherScene], out: Path, tmp_path: Path
) -> None:
    contents = layout.read_contents(out)
    del contents["editors"]
    (out / "export.json").write_bytes(layout.sealed_contents(contents))
    other = tmp_path / "other"
    export(plan_of([scenes["mute"]]), other)
    for sources in ([out, other], [other, out]):
        merge_cityscapes(sources[0], sources[1:], tmp_path / "merged")
        assert read_merge(tmp_path / "merged")["editors"] is None


def test_a_merge_does_not_take_a_harmed_record(out: Path, tmp_path: Path) -> None:
    path = out / name_of(WHOLE)
    path.write_bytes(path.read_bytes().replace(b"a" * 64, b"a" * 63 + b"b"))
    with pytest.raises(IntegrityError, match=f"damaged: {path.name} is not as it was written"):
        merge_cityscapes(out, [], tmp_path / "merged")


def test_a_changed_merge_is_found(out: Path, tmp_path: Path) -> None:
    merge_cityscapes(out, [], tmp_path / "merged")
    path = tmp_path / "merged/merge.json"
    path.write_text(path.read_text().replace('"unrecorded"', '"was_recorded"'))
    with pytest.raises(IntegrityError, match="changed since it was written, or is of an earlier"):
        read_merge(tmp_path / "merged")
