"""Shards of an export run beside each other, die, and still give the tree of a single run."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import export_faults
import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from hypothesis import given
from hypothesis import strategies as st
from tiny_export import POLICY, tree_of

import weather_aug
from weather_aug import _files, _lock
from weather_aug.errors import ArgumentError, ConflictError, IntegrityError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import engines, lock
from weather_aug.writers import export as export_module
from weather_aug.writers.choices import FromPolicy
from weather_aug.writers.estimate import committed
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export, plan_grid
from weather_aug.writers.shards import MAX_SHARDS, Shard, ShardTarget, shard_journals
from weather_aug.writers.verify import verify_export

URL = "memory://bucket/shards"

SCRIPT = """
import json, sys, time
from pathlib import Path
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import plan_export

if __name__ == "__main__":
    scene, out, policy, count, number, of = sys.argv[1:]
    policy = WeatherPolicy.from_dict(json.loads(policy))
    plan = plan_export([WeatherScene.load(scene)], policy, count=int(count), seed=3)
    print("ready", flush=True)
    sys.stdin.readline()
    # Slow enough that it is at work while others are looked at.
    pause = lambda _: time.sleep(0.03)
    export(plan, Path(out), shard=(int(number), int(of)), on_sample=pause)
"""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


class Stop(Exception):
    """What ends a run early."""


def interrupt_after(plan: ExportPlan, out: str | Path, samples: int, **arguments: Any) -> None:
    left = iter(range(samples - 1))

    def stop(_: object) -> None:
        if next(left, None) is None:
            raise Stop

    with pytest.raises(Stop):
        export(plan, out, on_sample=stop, **arguments)


@given(st.integers(1, 300), st.sampled_from([1, 7, 32]), st.integers(1, 40))
def test_shards_divide_the_items(count: int, items_per_unit: int, of: int) -> None:
    layout = SimpleNamespace(items_per_unit=items_per_unit)
    plan: Any = SimpleNamespace(count=count, units=-(-count // items_per_unit), layout=layout)
    parts = [Shard(number, of) for number in range(1, of + 1)]
    assert sorted(unit for part in parts for unit in part.units(plan)) == [*range(plan.units)]
    for part in parts:
        items = [item for item in range(count) if item // items_per_unit in part.units(plan)]
        assert len(items) == part.count(plan)
        assert items == [item for item in range(count) if part.has(plan, item)]


@pytest.mark.parametrize("shard", [(0, 4), (5, 4), (1, 0), (-1, 4), (1, MAX_SHARDS + 1), (1.0, 2)])
def test_there_is_no_such_shard(plan: ExportPlan, out: Path, shard: Any) -> None:
    with pytest.raises(ArgumentError, match="shard"):
        export(plan, out, shard=shard)
    assert not out.exists()


def test_shards_verify_nothing(plan: ExportPlan, out: Path) -> None:
    with pytest.raises(ArgumentError, match="verify is for the whole export"):
        export(plan, out, shard=(1, 2), verify=True)


def assert_shards_and_an_ordinary_run_give(
    plan: ExportPlan, out: Path, expected: dict[str, str]
) -> None:
    for number, samples in ((2, 3), (1, 4), (3, 3)):
        report = export(plan, out, shard=(number, 3))
        assert (report.finished, report.samples, report.rendered) == (False, samples, samples)
        assert report.labelled == samples
        assert report.bytes > 1000 * samples
        assert report.classes == ()
        assert not {"manifest.jsonl", "export.json"} & {path.name for path in out.iterdir()}
        assert "is not finished" in verify_export(out)[0]
    assert [export(plan, out, shard=(1, 3)).rendered, committed(out, plan)] == [0, 10]
    report = export(plan, out)
    assert (report.finished, report.rendered, report.damaged) == (True, 0, 0)
    assert tree_of(out) == expected


def test_shards_and_an_ordinary_run_give_the_tree_of_one_run(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    assert_shards_and_an_ordinary_run_give(plan, out, expected_tree)


def test_an_ordinary_run_that_ignores_journals_of_shards_is_noticed(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export_module, "shard_journals", lambda _: [])
    with pytest.raises(AssertionError):
        assert_shards_and_an_ordinary_run_give(plan, out, expected_tree)


def test_a_finished_export_has_nothing_to_do_for_a_shard(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    export(plan, out)
    report = export(plan, out, shard=(2, 3))
    assert (report.finished, report.samples, report.rendered) == (True, 10, 0)
    assert tree_of(out) == expected_tree
    with pytest.raises(ConflictError, match="/out belongs to another job: its seed is 3"):
        export(replace(plan, choice=FromPolicy(POLICY, 4)), out, shard=(1, 2))
    assert tree_of(out) == expected_tree


def test_what_is_finished_while_a_shard_asks_is_left_clean(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    export(plan, out)
    finished = export_module._finished_before
    answers = iter([None])
    monkeypatch.setattr(
        export_module, "_finished_before", lambda *given: next(answers, finished(*given))
    )
    assert export(plan, out, shard=(1, 2)).finished
    assert next(answers, "asked again") == "asked again"
    assert tree_of(out) == expected_tree
    assert not (out / ".export").exists()


def test_tars_are_the_units(
    scene: WeatherScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_grid([scene], ["clear", "rain"], seeds=range(9), layout="webdataset")
    assert (plan.count, plan.units) == (72, 3)
    export(plan, tmp_path / "one")
    reports = [export(plan, tmp_path / "out", shard=(number, 2)) for number in (1, 2)]
    assert [report.samples for report in reports] == [32 + 8, 32]
    assert export(plan, tmp_path / "out").rendered == 0
    assert tree_of(tmp_path / "out") == tree_of(tmp_path / "one")


def test_more_shards_than_units(plan: ExportPlan, out: Path, expected_tree: dict[str, str]) -> None:
    assert export(plan, out, shard=(12, 16)).samples == 0
    assert export(plan, out, shard=(10, 16)).samples == 1
    assert export(plan, out).rendered == 9
    assert tree_of(out) == expected_tree


@contextmanager
def running(plan: ExportPlan, out: Path, shard: tuple[int, int] | None) -> Iterator[None]:
    """A run that has committed a sample and waits."""
    if shard is None:
        with lock.exclusive(out):
            yield
    else:
        part = Shard(*shard)
        with lock.shared(out, part.state(out), str(part)):
            yield


@pytest.mark.parametrize(
    ("holder", "second", "says"),
    [
        (None, (1, 2), "out is being exported to by process"),
        ((1, 2), None, "out is being exported to by process"),
        ((1, 2), (1, 2), "shard 1 of 2 of .*out is being exported to by process"),
    ],
)
def test_runs_that_exclude_each_other(
    plan: ExportPlan, out: Path, holder: Any, second: Any, says: str
) -> None:
    out.mkdir()
    with (
        running(plan, out, holder),
        pytest.raises(ConflictError, match=f"{says} {os.getpid()} on ") as caught,
    ):
        export(plan, out, shard=second)
    assert caught.value.exit_code == 5
    assert "another process" not in str(caught.value)


def test_shards_run_beside_each_other(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    with running(plan, out, (1, 3)), running(plan, out, (1, 2)):
        assert export(plan, out, shard=(2, 3)).rendered == 3
    assert export(plan, out).rendered == 7
    assert tree_of(out) == expected_tree


def test_a_lock_that_is_not_shared_is_noticed(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_lock, "shared", _lock.exclusive)
    with running(plan, out, (1, 3)), pytest.raises(ConflictError):
        export(plan, out, shard=(2, 3))


@pytest.mark.parametrize("shard", [None, (1, 2)])
def test_workers_of_dead_runs_are_waited_for(
    plan: ExportPlan, out: Path, shard: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "ORPHANS_WAIT_S", 0.1)
    interrupt_after(plan, out, 2, shard=(1, 2))
    with (
        lock.working(Shard(1, 2).state(out)),
        pytest.raises(ConflictError, match="still write"),
    ):
        export(plan, out, shard=shard)
    # A shard's workers do not hinder other shards.
    with lock.working(Shard(1, 2).state(out)):
        assert export(plan, out, shard=(2, 2)).rendered == 5


def test_other_numbers_of_shards_take_over_what_is_whole(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    """Items 0 and 3 come from a shard, 1, 2, 4 and 5 from an ordinary run; 3 is damaged then."""
    interrupt_after(plan, out, 2, shard=(1, 3))
    interrupt_after(plan, out, 4)
    (out / plan.paths(3)["label"]).unlink()
    report = export(plan, out, shard=(1, 2))
    assert (report.samples, report.rendered, report.damaged) == (5, 2, 0)
    report = export(plan, out, shard=(2, 2))
    assert (report.samples, report.rendered, report.damaged) == (5, 3, 1)
    assert len(shard_journals(out)) == 3
    report = export(plan, out)
    assert (report.rendered, report.damaged) == (0, 0)
    assert tree_of(out) == expected_tree


def test_what_is_committed_is_counted_once(plan: ExportPlan, out: Path) -> None:
    export(plan, out, shard=(1, 2))
    assert [committed(out, plan, Shard(number, 2)) for number in (1, 2)] == [5, 0]
    # Its journal repeats what the shards' hold.
    interrupt_after(plan, out, 2)
    assert committed(out, plan) == 7
    assert [committed(out, plan, Shard(number, 2)) for number in (1, 2)] == [5, 2]
    export(plan, out)
    assert [committed(out, plan, Shard(number, 2)) for number in (1, 2)] == [5, 5]


@pytest.mark.parametrize("cut_bytes", [1, 20, 400])
def test_a_torn_last_line_costs_its_sample(
    plan: ExportPlan, out: Path, cut_bytes: int, expected_tree: dict[str, str]
) -> None:
    interrupt_after(plan, out, 4, shard=(1, 2))
    (journal,) = shard_journals(out)
    journal.write_bytes(journal.read_bytes()[:-cut_bytes])
    assert committed(out, plan) == 3
    report = export(plan, out)
    assert (report.rendered, report.damaged) == (7, 1)
    assert tree_of(out) == expected_tree


def test_only_digests_are_believed(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    export(plan, out, shard=(1, 2))
    path = out / plan.paths(4)["image"]
    data = bytearray(path.read_bytes())
    data[40] ^= 1
    path.write_bytes(data)
    report = export(plan, out)
    assert (report.rendered, report.damaged) == (6, 1)
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("shard", [None, (1, 2), (1, 3)])
def test_a_shard_of_another_job_is_refused(plan: ExportPlan, out: Path, shard: Any) -> None:
    other = replace(plan, choice=FromPolicy(POLICY, 4))
    interrupt_after(plan, out, 1)
    export(other, out.with_name("other"), shard=(1, 2))
    theirs = Shard(1, 2).state(out)
    theirs.parent.mkdir(parents=True)
    Shard(1, 2).state(out.with_name("other")).rename(theirs)
    before = tree_of(out)
    with pytest.raises(ConflictError, match="another job: its seed is 4") as caught:
        export(plan, out, shard=shard)
    assert caught.value.exit_code == 5
    with pytest.raises(ConflictError, match="another job: its seed is 3"):
        export(other, out, shard=(2, 2))
    locks = {name for name in tree_of(out) if name.endswith(("/lock", "/workers", "s/journal"))}
    after = {name: digest for name, digest in tree_of(out).items() if name not in locks}
    assert after.items() <= before.items()


def test_a_journal_without_a_readable_job_is_refused(plan: ExportPlan, out: Path) -> None:
    export(plan, out, shard=(1, 2))
    (journal,) = shard_journals(out)
    journal.write_bytes(b"x" + journal.read_bytes())
    for shard in (None, (1, 2), (1, 3)):
        with pytest.raises(IntegrityError, match=r"00001-of-00002.*is damaged"):
            export(plan, out, shard=shard)


def assert_a_shard_leaves_alone_what_others_write(plan: ExportPlan, out: Path) -> None:
    """At its start, and after one of its workers has died."""
    export(plan, out, shard=(2, 2))
    theirs = out / f"{plan.paths(7)['image']}.0123456789abcdef.tmp"
    theirs.write_bytes(b"half")
    report = export(plan, out, shard=(1, 2), workers=2)
    assert report.rendered == 5
    assert (Shard(1, 2).state(out).parent / "died").exists()
    assert theirs.read_bytes() == b"half"


def test_a_shard_leaves_alone_what_others_write(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "work", export_faults.die_after_writing_once)
    assert_a_shard_leaves_alone_what_others_write(plan, out)
    monkeypatch.undo()
    assert export(plan, out).rendered == 0
    assert tree_of(out) == expected_tree


def test_a_shard_that_removes_leftovers_is_noticed(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "work", export_faults.die_after_writing_once)
    monkeypatch.setattr(
        ShardTarget,
        "remove_leftovers",
        lambda self, layout: self.whole.remove_leftovers(layout),
    )
    with pytest.raises((AssertionError, FileNotFoundError)):
        assert_a_shard_leaves_alone_what_others_write(plan, out)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_shard_that_dies_at_any_sync_can_be_continued(
    scene: WeatherScene, tmp_path: Path
) -> None:
    plan = plan_export([scene], POLICY, count=3, seed=3)
    export(plan, tmp_path / "one")
    expected = tree_of(tmp_path / "one")
    call, status = 0, 1
    while status != 0:
        call += 1
        out = tmp_path / str(call)
        status = exit_status_of_fork(plan, out, call)
        if call % 2:
            export(plan, out, shard=(1, 2))
        export(plan, out)
        assert tree_of(out) == expected
    assert call > 15


def exit_status_of_fork(plan: ExportPlan, out: Path, call: int) -> int:
    """Export a shard in a child that is gone at the `call`-th sync; 0 if it got through."""
    child = os.fork()
    if child == 0:
        left = iter(range(call - 1))
        sync = os.fsync

        def fsync(descriptor: int) -> None:
            if next(left, None) is None:
                os._exit(9)
            sync(descriptor)

        os.fsync = fsync
        export(plan, out, shard=(1, 2))
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def started(plan: ExportPlan, out: Path, number: int, of: int) -> subprocess.Popen[str]:
    """A shard in a process of its own, which waits for a line before it begins."""
    script = out.parent / "script.py"
    script.write_text(SCRIPT)
    policy = json.dumps(plan.job["policy"])
    arguments = [plan.scenes[0].path, out, policy, plan.count, number, of]
    return subprocess.Popen(
        [sys.executable, str(script), *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def kill_at(processes: dict[Path, subprocess.Popen[str]], lines: dict[Path, int]) -> None:
    """Kill each process when its journal has so many lines."""
    deadline_s = time.monotonic() + 60
    while lines:
        for journal, count in [*lines.items()]:
            assert processes[journal].poll() is None, "it ended before it could be killed"
            if journal.exists() and journal.read_bytes().count(b"\n") > count:
                processes[journal].kill()
                del lines[journal]
        assert time.monotonic() < deadline_s
        time.sleep(0.001)


def test_four_shards_at_once_of_which_two_are_killed(
    scene: WeatherScene, tmp_path: Path, out: Path
) -> None:
    plan = plan_export([scene], POLICY, count=240, seed=3)
    chance = random.Random(11)
    victims = chance.sample(range(1, 5), 2)
    journals = {n: Shard(n, 4).state(out) / ".export/journal" for n in range(1, 5)}
    with ExitStack() as ended:
        processes = {}
        for number, journal in journals.items():
            processes[journal] = ended.enter_context(started(plan, out, number, 4))
            ended.callback(processes[journal].kill)
        for process in processes.values():
            assert process.stdout.readline() == "ready\n"
        for process in processes.values():
            process.stdin.write("\n")
            process.stdin.flush()
        kill_at(processes, {journals[number]: chance.randrange(2, 20) for number in victims})
        for number, journal in journals.items():
            processes[journal].communicate(timeout=60)
            expected = -signal.SIGKILL if number in victims else 0
            assert expected == processes[journal].returncode
    assert 120 < committed(out, plan) < 240
    # One goes on as it was; what the other misses is left to the ordinary run.
    report = export(plan, out, shard=(victims[0], 4))
    assert (report.samples, report.damaged) == (60, 0)
    assert 0 < report.rendered < 60
    report = export(plan, out)
    assert 0 < report.rendered < 60
    export(plan, tmp_path / "one")
    assert tree_of(out) == tree_of(tmp_path / "one")
    assert verify_export(out) == []


@pytest.fixture
def store() -> Iterator[Any]:
    MemoryFileSystem.store.clear()
    MemoryFileSystem.pseudo_dirs[:] = [""]
    yield fsspec.filesystem("memory")


def url_tree(fs: Any) -> dict[str, str]:
    root = "/bucket/shards/"
    return {path[len(root) :]: _files.sha256_of(fs.cat_file(path)) for path in fs.find(root)}


def test_shards_of_a_url_share_its_state(
    plan: ExportPlan, tmp_path: Path, expected_tree: dict[str, str], store: Any
) -> None:
    state = tmp_path / "state"
    interrupt_after(plan, URL, 2, shard=(1, 2), state=state)
    report = export(plan, URL, shard=(2, 2), state=state)
    assert (report.out, report.finished, report.samples) == (URL, False, 5)
    assert "export.json" not in url_tree(store)
    assert committed(state, plan) == 7
    assert "is not finished" in verify_export(URL)[0]
    assert export(plan, URL, state=state).rendered == 3
    assert url_tree(store) == expected_tree


@pytest.mark.parametrize("name", ["state", "lost"])
def test_a_finished_url_has_nothing_to_do_for_a_shard(
    plan: ExportPlan, tmp_path: Path, expected_tree: dict[str, str], store: Any, name: str
) -> None:
    """Whether the state knows it or not."""
    export(plan, URL, state=tmp_path / "state")
    report = export(plan, URL, shard=(1, 2), state=tmp_path / name)
    assert (report.finished, report.samples, report.rendered) == (True, 10, 0)
    assert url_tree(store) == expected_tree
    with pytest.raises(ConflictError, match="its seed is 3"):
        other = replace(plan, choice=FromPolicy(POLICY, 4))
        export(other, URL, shard=(1, 2), state=tmp_path / name)


@pytest.mark.slow
def test_shards_by_ray(plan: ExportPlan, out: Path, expected_tree: dict[str, str]) -> None:
    pytest.importorskip("ray")
    assert export(plan, out, shard=(1, 2), engine="ray").rendered == 5
    assert export(plan, out, shard=(2, 2), engine="ray", workers=2).rendered == 5
    assert export(plan, out).rendered == 0
    assert tree_of(out) == expected_tree
