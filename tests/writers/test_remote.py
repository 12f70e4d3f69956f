"""Exports to places that fsspec reaches: the same bytes as in a folder, whatever fails."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from planted_places import Copier, FlakyStore, StrictDisk
from tiny_export import POLICY, tree_of

from weather_aug import _files
from weather_aug.errors import ArgumentError, ConflictError, MissingExtraError, OutputError
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.remote import FsspecFolder, default_state

URL = "memory://bucket/rainy"
FLAKY = "flaky://bucket/rainy"


class Stop(Exception):
    """What ends an export early."""


@pytest.fixture(autouse=True)
def places() -> Iterator[None]:
    for place in (FlakyStore, StrictDisk, Copier):
        fsspec.register_implementation(place.protocol[0], place, clobber=True)
    for store in (MemoryFileSystem, FlakyStore):
        store.store.clear()
        store.pseudo_dirs[:] = [""]
    FlakyStore.puts.clear()
    yield
    FlakyStore.every, FlakyStore.unreadable = 0, False


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


def remote_tree(url: str) -> dict[str, str]:
    fs, root = fsspec.core.url_to_fs(url)
    return {path[len(root) + 1 :]: _files.sha256_of(fs.cat_file(path)) for path in fs.find(root)}


def stop_after(samples: int) -> Any:
    seen: list[dict[str, Any]] = []

    def stop(entry: dict[str, Any]) -> None:
        seen.append(entry)
        if len(seen) == samples:
            raise Stop

    return stop


def test_a_store_holds_the_tree_of_a_folder(
    plan: ExportPlan, state: Path, expected_tree: dict[str, str]
) -> None:
    report = export(plan, URL, state=state)
    assert (report.out, report.rendered) == (URL, 10)
    assert remote_tree(URL) == expected_tree


def test_workers_write_to_a_url(
    plan: ExportPlan, tmp_path: Path, state: Path, expected_tree: dict[str, str]
) -> None:
    export(plan, f"file://{tmp_path}/out", state=state, workers=2)
    assert tree_of(tmp_path / "out") == expected_tree


def test_a_finished_export_is_left_alone(plan: ExportPlan, state: Path) -> None:
    export(plan, FLAKY, state=state)
    FlakyStore.puts.clear()
    assert export(plan, FLAKY, state=state, verify=True).rendered == 0
    assert FlakyStore.puts == []


def test_the_state_continues_what_was_stopped(
    plan: ExportPlan, state: Path, expected_tree: dict[str, str]
) -> None:
    with pytest.raises(Stop):
        export(plan, URL, state=state, on_sample=stop_after(4))
    assert "export.json" not in remote_tree(URL)
    assert export(plan, URL, state=str(state)).rendered == 6
    assert remote_tree(URL) == expected_tree


@pytest.mark.parametrize("stopped", [True, False])
def test_without_the_state_it_starts_again(
    plan: ExportPlan, tmp_path: Path, stopped: bool, expected_tree: dict[str, str]
) -> None:
    if stopped:
        with pytest.raises(Stop):
            export(plan, URL, state=tmp_path / "lost", on_sample=stop_after(4))
    else:
        export(plan, URL, state=tmp_path / "lost")
    assert export(plan, URL, state=tmp_path / "new").rendered == 10
    assert remote_tree(URL) == expected_tree


@pytest.mark.parametrize("stopped", [True, False])
def test_another_job_at_the_place_is_refused(
    plan: ExportPlan, tmp_path: Path, stopped: bool
) -> None:
    if stopped:
        with pytest.raises(Stop):
            export(plan, URL, state=tmp_path / "a", on_sample=stop_after(1))
    else:
        export(plan, URL, state=tmp_path / "a")
    before = remote_tree(URL)
    other = plan_export(plan.scenes, POLICY, count=10, seed=4)
    with pytest.raises(ConflictError, match=r"memory://bucket/rainy belongs .* its seed is 3"):
        export(other, URL, state=tmp_path / "b")
    assert remote_tree(URL) == before


def test_what_is_no_export_is_refused(plan: ExportPlan, state: Path) -> None:
    fsspec.filesystem("memory").pipe_file("/bucket/rainy/theses.tex", b"years of work")
    with pytest.raises(ConflictError, match=r"no export, but holds theses\.tex"):
        export(plan, URL, state=state)


@pytest.mark.parametrize("name", ["image", "manifest.jsonl", "export.json"])
def test_damage_is_repaired(
    plan: ExportPlan, state: Path, name: str, expected_tree: dict[str, str]
) -> None:
    export(plan, URL, state=state)
    fs = fsspec.filesystem("memory")
    path = f"/bucket/rainy/{plan.paths(3)['image'] if name == 'image' else name}"
    data = bytearray(fs.cat_file(path))
    place = data.index(b"2000") if name == "export.json" else len(data) // 2
    data[place] ^= 1
    fs.pipe_file(path, bytes(data))
    report = export(plan, URL, state=state, verify=True)
    assert report.damaged == report.rendered == (name == "image")
    assert remote_tree(URL) == expected_tree


def continued_through_failures(plan: ExportPlan, state: Path) -> int:
    """Run an export until it ends; at each failure nothing may look finished that is not."""
    for failures in range(60):
        try:
            export(plan, FLAKY, state=state)
        except OutputError:
            tree = remote_tree(FLAKY)
            assert "export.json" not in tree or len(tree) >= 2 * plan.count + 5
        else:
            return failures
    raise AssertionError("it never ended")


def test_a_network_that_fails_again_and_again(
    plan: ExportPlan, state: Path, expected_tree: dict[str, str]
) -> None:
    FlakyStore.every = 4
    assert continued_through_failures(plan, state) >= 5
    assert remote_tree(FLAKY) == expected_tree


def test_export_json_put_too_early_is_noticed(
    plan: ExportPlan, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = FsspecFolder.publish
    monkeypatch.setattr(
        FsspecFolder, "publish", lambda self, names: publish(self, reversed(list(names)))
    )
    FlakyStore.every = 4
    with pytest.raises(AssertionError):
        continued_through_failures(plan, state)


def test_a_failure_names_the_url_and_no_password(plan: ExportPlan, state: Path) -> None:
    FlakyStore.every = 1
    url = "flaky://me:secret@bucket/rainy"
    with pytest.raises(OutputError) as caught:
        export(plan, url, state=state, storage_options={"token": "hidden"})
    assert str(caught.value).startswith("cannot write flaky://bucket/rainy/")
    assert "NetworkError connection reset" in str(caught.value)
    assert caught.value.exit_code == 6
    target = FsspecFolder(url, state, {"token": "hidden"})
    for text in (str(caught.value), repr(target), str(target)):
        assert "secret" not in text and "hidden" not in text


def test_an_outage_is_no_damage(
    plan: ExportPlan, state: Path, expected_tree: dict[str, str]
) -> None:
    with pytest.raises(Stop):
        export(plan, FLAKY, state=state, on_sample=stop_after(4))
    FlakyStore.unreadable = True
    with pytest.raises(OutputError, match=r"cannot read flaky://.*no route to host"):
        export(plan, FLAKY, state=state)
    FlakyStore.unreadable = False
    report = export(plan, FLAKY, state=state)
    assert (report.rendered, report.damaged) == (6, 0)


def test_a_place_that_renames_onto_no_file(
    plan: ExportPlan, tmp_path: Path, state: Path, expected_tree: dict[str, str]
) -> None:
    out = tmp_path / "out"
    export(plan, f"strict://{out}", state=state)
    (out / plan.paths(3)["image"]).write_bytes(b"")
    leftover = out / f"{plan.paths(3)['image']}.12345678.tmp"
    leftover.write_bytes(b"half")
    assert export(plan, f"strict://{out}", state=state).rendered == 1
    assert tree_of(out) == expected_tree


def test_nothing_half_written_stands_under_a_name(
    tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(self: StrictDisk, path: str, value: bytes, **_: Any) -> None:
        Path(path).write_bytes(value[: len(value) // 2])
        raise OSError("disk quota exceeded")

    target = FsspecFolder(f"strict://{tmp_path}/out", state)
    target.make_folders(["a/b"])
    target.write_whole("a/b/c.png", b"old")
    with monkeypatch.context() as patch:
        patch.setattr(StrictDisk, "pipe_file", half)
        with pytest.raises(OutputError, match=r"strict://.*/a/b/c\.png: OSError disk quota"):
            target.write_whole("a/b/c.png", b"newer")
    assert {"a/b/c.png": _files.sha256_of(b"old")} == tree_of(tmp_path / "out")


def test_a_target_goes_to_workers_with_its_options(tmp_path: Path) -> None:
    target = FsspecFolder(f"file://{tmp_path}/out", tmp_path, {"auto_mkdir": True})
    again = pickle.loads(pickle.dumps(target))
    assert again == target
    again.write_whole("a/b.png", b"x")
    stored = {"size": 1, "sha256": _files.sha256_of(b"x")}
    assert target.is_whole("a/b.png", stored, digests=True)
    assert not target.is_whole("a/b.png", stored | {"sha256": "0"}, digests=True)
    assert not target.is_whole("a", stored, digests=True)


@pytest.mark.parametrize(
    ("out", "error", "message"),
    [
        ("copier:///tmp/x", ArgumentError, "neither put nor rename"),
        ("simplecache::memory://x", ArgumentError, "chain of file systems"),
        ("nosuch://x", ArgumentError, "nosuch"),
        ("s3://bucket/x", MissingExtraError, "s3fs"),
    ],
)
def test_places_that_cannot_be_used(
    plan: ExportPlan, state: Path, out: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        export(plan, out, state=state)
    assert not state.exists()


def test_workers_do_not_share_the_memory_of_a_process(plan: ExportPlan, state: Path) -> None:
    with pytest.raises(ArgumentError, match="by this process alone; export with workers=1"):
        export(plan, URL, state=state, workers=2)


def test_arguments_for_another_output_are_refused(plan: ExportPlan, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="is a folder of this machine"):
        export(plan, tmp_path / "out", state=tmp_path / "state")
    with pytest.raises(ArgumentError, match="engine 'dask' is not one of process, inline, ray"):
        export(plan, tmp_path / "out", engine="dask")
    with pytest.raises(ArgumentError, match="address is of a Ray cluster"):
        export(plan, tmp_path / "out", address="auto")


def test_the_state_stands_in_the_working_directory_by_itself(
    plan: ExportPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    export(plan, URL)
    assert [tmp_path / ".weather-aug-export"] == list(tmp_path.iterdir())
    assert json.loads((default_state(URL) / "export.json").read_text())["job"] == plan.job
    assert default_state(URL) == default_state(URL + "/") != default_state(FLAKY)
    assert export(plan, URL).rendered == 0
