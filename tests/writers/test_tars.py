"""Tars of samples: the same bytes always, read by WebDataset, whole or made again."""

from __future__ import annotations

import gc
import io
import json
import shutil
import tarfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_calls import kill_at_each_call
from tiny_export import POLICY, tree_of

from weather_aug import _files
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import engines, target, verify
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.sample import encoded_parts, render_recipe, write_unit
from weather_aug.writers.source import Source
from weather_aug.writers.tars import Tar
from weather_aug.writers.verify import verify_export

COUNT, PER_TAR = 8, 3
TARS = [f"shards/train-{unit:06d}.tar" for unit in range(3)]


@pytest.fixture(scope="module")
def plan(scene: WeatherScene) -> ExportPlan:
    whole = plan_export([scene], POLICY, count=COUNT, seed=3, layout="webdataset")
    return replace(whole, layout=replace(whole.layout, items_per_unit=PER_TAR))


@pytest.fixture(scope="module")
def whole(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tars") / "out"
    export(plan, out)
    return out


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "out"))


def entries(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def grouped(path: Path) -> Iterator[dict[str, bytes]]:
    """Samples of a tar as WebDataset groups them: by the name before its first dot."""
    sample: dict[str, Any] = {}
    with tarfile.open(path) as tar:
        for member in tar:
            base, _, key = member.name.partition(".")
            if sample and sample["__key__"] != base:
                yield sample
                sample = {}
            file = tar.extractfile(member)
            assert file is not None
            sample |= {"__key__": base, key: file.read()}
    if sample:
        yield sample


def check_sample(sample: dict[str, Any], scene: WeatherScene) -> None:
    """Its recipe gives its pictures; its label has one channel."""
    shot = render_recipe(scene, json.loads(sample["json"]))
    label = cv2.imdecode(np.frombuffer(sample["label.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shot.label, label)
    assert {name: sample[f"{name}.png"] for name in ("image", "label")} == encoded_parts(shot)


def test_tars_hold_the_samples_in_item_order(whole: Path, scene: WeatherScene) -> None:
    assert sorted(tree_of(whole)) == ["export.json", "manifest.jsonl", *TARS]
    samples = [sample for path in TARS for sample in grouped(whole / path)]
    assert [int(sample["__key__"].split("_")[2]) for sample in samples] == list(range(COUNT))
    for sample, entry in zip(samples, entries(whole), strict=True):
        assert json.loads(sample["json"]) == entry["recipe"]
        check_sample(sample, scene)


# WebDataset leaves the files that it reads to the garbage collector.
@pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_webdataset_reads_them(whole: Path, scene: WeatherScene) -> None:
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
    urls = [str(whole / path) for path in TARS]
    samples = list(webdataset.WebDataset(urls, shardshuffle=False))
    assert len(samples) == COUNT
    for sample in samples:
        check_sample(sample, scene)
    decoded = list(webdataset.WebDataset(urls, shardshuffle=False).decode("rgb8"))
    # The reason why labels are decoded by hand.
    assert decoded[0]["label.png"].shape == (32, 48, 3)
    gc.collect()


def test_the_manifest_names_the_tar_and_its_members(whole: Path) -> None:
    for entry in entries(whole):
        (file,) = entry["files"].values()
        data = (whole / file["path"]).read_bytes()
        assert file["path"] == TARS[entry["item"] // PER_TAR]
        assert (file["size"], file["sha256"]) == (len(data), _files.sha256_of(data))
        assert list(entry["members"]) == ["image", "label"]
        with tarfile.open(whole / file["path"]) as tar:
            for member in entry["members"].values():
                info = tar.getmember(member["name"])
                assert (info.offset_data, info.size) == (member["offset"], member["size"])
                part = data[member["offset"] : member["offset"] + member["size"]]
                assert _files.sha256_of(part) == member["sha256"]


def test_nothing_in_a_tar_tells_who_made_it_or_when(whole: Path) -> None:
    for path in TARS:
        with tarfile.open(whole / path) as tar:
            for member in tar:
                assert member.isreg()
                assert (member.mtime, member.uid, member.gid) == (0, 0, 0)
                assert (member.uname, member.gname, member.mode) == ("", "", 0o644)


def test_the_number_of_samples_a_tar_is_part_of_the_job(plan: ExportPlan) -> None:
    other = replace(plan, layout=replace(plan.layout, items_per_unit=4))
    assert plan.job["items_per_unit"] == PER_TAR
    assert other.digest != plan.digest


names = st.from_regex(r"[a-z_0-9]{1,150}\.image\.png", fullmatch=True)


@given(st.dictionaries(names, st.binary(max_size=1500), max_size=5))
def test_any_members_come_back_from_their_offsets(members: dict[str, bytes]) -> None:
    tars = []
    for _ in range(2):
        tar = Tar()
        told = [tar.add(name, data) for name, data in members.items()]
        tars.append(tar.closed())
    assert tars[0] == tars[1]
    for member in told:
        part = tars[0][member["offset"] : member["offset"] + member["size"]]
        assert part == members[member["name"]]
    with tarfile.open(fileobj=io.BytesIO(tars[0])) as read:
        assert read.getnames() == list(members)


def silently_shorter(data: bytes) -> bool:
    """Whether a reader of a tar takes it for a smaller one without an error."""
    try:
        with tarfile.open(fileobj=io.BytesIO(data)) as tar:
            return len([member for member in tar if tar.extractfile(member).read()]) > 0  # type: ignore[union-attr]
    except tarfile.TarError:
        return False


def test_a_tar_cut_at_any_block_is_found(out: Path) -> None:
    path = out / TARS[-1]
    data = path.read_bytes()
    silent = 0
    for size in range(0, len(data), tarfile.BLOCKSIZE):
        path.write_bytes(data[:size])
        assert verify_export(out) == [f"{TARS[-1]} has {size} bytes, {len(data)} were written"]
        silent += silently_shorter(data[:size])
    assert silent > 0
    changed = bytearray(data)
    changed[700] ^= 1
    path.write_bytes(changed)
    assert verify_export(out) == [f"{TARS[-1]} has changed since it was written"]


def test_each_tar_is_hashed_once(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: list[str] = []
    real, real_of_source = _files.sha256_of_file, verify.sha256_of

    def counting(path: Path) -> str:
        hashed.append(path.name)
        return real(path)

    def counting_of_source(source: Source, relative: str) -> str:
        hashed.append(Path(relative).name)
        return real_of_source(source, relative)

    monkeypatch.setattr(_files, "sha256_of_file", counting)
    monkeypatch.setattr(verify, "sha256_of", counting_of_source)
    once = [Path(path).name for path in TARS]
    assert verify_export(out) == []
    assert [name for name in hashed if name.endswith(".tar")] == once
    hashed.clear()
    assert export(plan, out, verify=True).rendered == 0
    assert [name for name in hashed if name.endswith(".tar")] == once


def test_two_units_may_not_share_a_tar(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = entries(out)
    for entry in lines[PER_TAR : 2 * PER_TAR]:
        entry["files"] = lines[0]["files"]
    monkeypatch.setattr(verify, "_lines", lambda _: (json.dumps(entry) for entry in lines))
    problems = verify_export(out)
    assert f"{TARS[0]} is listed twice" in problems
    assert f"{TARS[1]} is not part of the export" in problems


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-512])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [cut, flip, Path.unlink])
def test_a_damaged_tar_is_made_again_whole(
    plan: ExportPlan, whole: Path, out: Path, damage: Any
) -> None:
    damage(out / TARS[1])
    report = export(plan, out, verify=True)
    assert (report.rendered, report.damaged) == (PER_TAR, PER_TAR)
    assert tree_of(out) == tree_of(whole)


@pytest.mark.parametrize("samples", [3, 4, 5, 6])
def test_interrupted_work_is_continued_tar_by_tar(
    plan: ExportPlan, whole: Path, tmp_path: Path, samples: int
) -> None:
    left = iter(range(samples - 1))

    def stop(_: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(plan, tmp_path / "out", on_sample=stop)
    tars = -(-samples // PER_TAR)
    assert sorted(path.name for path in (tmp_path / "out" / "shards").iterdir()) == [
        Path(path).name for path in TARS[:tars]
    ]
    report = export(plan, tmp_path / "out")
    assert report.rendered == COUNT - tars * PER_TAR
    assert tree_of(tmp_path / "out") == tree_of(whole)


@pytest.mark.parametrize("lines", [1, 2])
def test_a_unit_committed_in_part_is_completed(
    plan: ExportPlan, whole: Path, tmp_path: Path, lines: int
) -> None:
    """As after a kill between two lines of a unit: its tar is written again, with its bytes."""
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        export(plan, out, on_sample=interrupting)
    journal = out / ".export" / "journal"
    kept = journal.read_bytes().splitlines(keepends=True)[: 1 + lines]
    journal.write_bytes(b"".join(kept))
    assert export(plan, out).rendered == COUNT - lines
    assert tree_of(out) == tree_of(whole)


def interrupting(_: object) -> None:
    raise KeyboardInterrupt


def test_a_tar_that_cannot_be_written_leaves_nothing(
    plan: ExportPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "shards").mkdir()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_files.os, "fsync", full)
    with pytest.raises(_files.OutputError, match="No space left"):
        write_unit(plan, target.LocalFolder(tmp_path), 0)
    assert list((tmp_path / "shards").iterdir()) == []


@pytest.fixture(scope="module")
def small(scene: WeatherScene) -> ExportPlan:
    plan = plan_export([scene], POLICY, count=3, seed=3, layout="webdataset")
    return replace(plan, layout=replace(plan.layout, items_per_unit=2))


@pytest.fixture(scope="module")
def small_tree(small: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("small") / "out"
    export(small, out)
    return tree_of(out)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 5])
def test_killed_at_any_call_it_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, finished: bool, every: int
) -> None:
    """Once from nothing, once while a damaged tar is being repaired."""
    damaged = TARS[0] if finished else None
    assert kill_at_each_call(small, small_tree, tmp_path, every=every, damaged=damaged) > 30 / every


def test_leftovers_of_a_killed_run_are_removed(plan: ExportPlan, whole: Path, out: Path) -> None:
    (out / (TARS[0] + ".tmp")).write_bytes(b"half")
    export(plan, out)
    assert tree_of(out) == tree_of(whole)


@pytest.mark.slow
def test_two_processes_give_the_same_tars(plan: ExportPlan, whole: Path, tmp_path: Path) -> None:
    export(plan, tmp_path / "out", workers=2)
    assert tree_of(tmp_path / "out") == tree_of(whole)


def test_a_clock_in_the_tar_would_be_noticed(
    plan: ExportPlan, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dated(tarfile.TarInfo):
        def tobuf(self, *args: Any, **keywords: Any) -> bytes:
            self.mtime = 1_700_000_000
            return super().tobuf(*args, **keywords)

    monkeypatch.setattr(tarfile, "TarInfo", Dated)
    monkeypatch.setattr(engines, "write_unit", write_unit)
    export(plan, tmp_path / "out")
    assert tree_of(tmp_path / "out") != tree_of(whole)
