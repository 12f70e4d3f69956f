"""A call to the system that fails, or that is the last one: the same tree when it is continued."""

from __future__ import annotations

import errno
import io
import os
import resource
import shutil
import subprocess
from collections.abc import Mapping
from itertools import count, cycle
from pathlib import Path
from typing import Any

import pytest
from exporters import command_of, environment
from planted_calls import (
    assert_committed_verifies,
    assert_nothing_partial,
    failing_at,
    kill_at_each_call,
    refusing,
    status_of_fork,
)
from tiny_export import POLICY, tree_of

from weather_aug.errors import OutputError, SceneError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export

ITEMS = 20
FULL = [errno.ENOSPC]
OTHERS = [errno.EDQUOT, errno.EIO, errno.EMFILE, errno.EFBIG, errno.EROFS]

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


@pytest.fixture(scope="module")
def small(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=3, seed=3)


@pytest.fixture(scope="module")
def twenty(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=ITEMS, seed=3)


@pytest.fixture(scope="module")
def small_tree(small: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return tree_of_run(small, tmp_path_factory)


@pytest.fixture(scope="module")
def twenty_tree(twenty: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return tree_of_run(twenty, tmp_path_factory)


def tree_of_run(plan: ExportPlan, folders: pytest.TempPathFactory) -> dict[str, str]:
    out = folders.mktemp("whole") / "out"
    export(plan, out)
    return tree_of(out)


def refuse_each_call(
    plan: ExportPlan, tree: Mapping[str, str], folder: Path, codes: list[int]
) -> int:
    """Let each call fail once, by one error after the other; how many ended an export."""
    failed = 0
    for call, code in zip(count(1), cycle(codes)):
        out = folder / str(call)
        with failing_at(call, out, refusing(code)) as calls:
            try:
                export(plan, out)
            except OutputError as error:
                failed += 1
                assert error.exit_code == 6
                assert os.strerror(code) in str(error)
                assert str(out) in str(error)
                assert "\n" not in str(error)
        assert_committed_verifies(out)
        assert_nothing_partial(out, tree)
        export(plan, out)
        assert tree_of(out) == tree
        shutil.rmtree(out)
        if calls.total < call:
            return failed


@pytest.mark.parametrize("codes", [FULL, OTHERS], ids=["full", "others"])
def test_a_refusal_of_any_call_is_one_sentence_and_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, codes: list[int]
) -> None:
    assert refuse_each_call(small, small_tree, tmp_path, codes) > 60


@pytest.mark.slow
@pytest.mark.parametrize("codes", [FULL, OTHERS], ids=["full", "others"])
def test_a_refusal_of_any_call_of_twenty_items(
    twenty: ExportPlan, twenty_tree: dict[str, str], tmp_path: Path, codes: list[int]
) -> None:
    assert refuse_each_call(twenty, twenty_tree, tmp_path, codes) > 250


@pytest.mark.parametrize("finished", [False, True])
def test_killed_at_any_call_it_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, finished: bool
) -> None:
    """Once from nothing, once while a damaged export is being repaired."""
    damaged = small.paths(1)["label"] if finished else None
    # A written file is six calls, so steps of five meet each kind of call in turn.
    kills = kill_at_each_call(small, small_tree, tmp_path, every=5, damaged=damaged)
    assert kills > 6


@pytest.mark.slow
@pytest.mark.parametrize("finished", [False, True])
def test_killed_at_each_call_of_twenty_items(
    twenty: ExportPlan, twenty_tree: dict[str, str], tmp_path: Path, finished: bool
) -> None:
    damaged = twenty.paths(1)["label"] if finished else None
    kills = kill_at_each_call(twenty, twenty_tree, tmp_path, every=1, damaged=damaged)
    assert kills > (40 if finished else 250)


def test_every_kind_of_call_is_met(twenty: ExportPlan, tmp_path: Path) -> None:
    """A file is opened, written, synced, renamed, and its folder opened and synced."""
    with failing_at(0, tmp_path / "out", refusing(0)) as calls:
        export(twenty, tmp_path / "out")
    files = 2 * ITEMS + 5
    for name in ("Path.open", "write", "replace"):
        assert calls.by_name[name] >= files, name
    assert calls.by_name["fsync"] >= 2 * files
    assert calls.by_name["open"] >= files
    for name in ("mkdir", "unlink", "pwrite", "ftruncate"):
        assert calls.by_name[name] > 0, name


def test_short_writes_are_not_seen(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system takes at most 97 bytes at a time."""
    taken: list[int] = []

    class Reluctant(io.FileIO):
        def write(self, data: Any) -> int:
            taken.append(super().write(memoryview(data)[:97]))
            return taken[-1]

    real = Path.open

    def opening(path: Path, mode: str = "r", buffering: int = -1, **rest: Any) -> Any:
        if set(mode) <= {"r", "b", "t"}:
            return real(path, mode, buffering, **rest)
        raw = Reluctant(path, mode.replace("b", ""))
        return raw if buffering == 0 else io.BufferedWriter(raw)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", opening)
        export(small, tmp_path / "out")
    assert len(taken) > 150
    assert tree_of(tmp_path / "out") == small_tree


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_interrupted_calls_are_not_seen(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path
) -> None:
    """The system itself answers EINTR to every third write and sync of the exporter."""
    log = tmp_path / "calls"
    calls = "write,pwrite64,fsync"
    strace = ["strace", "-qq", "-o", str(log), "-e", f"trace={calls}"]
    if subprocess.run([*strace, "true"], check=False, capture_output=True).returncode:
        pytest.skip("processes may not be traced here")
    inject = ["-e", f"inject={calls}:error=EINTR:when=2+3"]
    command = command_of(small, tmp_path / "out", workers=0)
    subprocess.run([*strace, *inject, *command], env=environment(), check=True, timeout=120)
    assert log.read_text().count("EINTR") > 15
    assert tree_of(tmp_path / "out") == small_tree


@pytest.mark.parametrize("largest_file", [100, 600, 1300, 3300])
def test_a_write_cut_short_by_the_system_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, largest_file: int
) -> None:
    """A limit on file sizes fails pictures, then the journal, after a part of it is written."""
    out = tmp_path / "out"

    def work() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        return refused_with(small, out, "File too large")

    assert status_of_fork(work) == 6
    assert_committed_verifies(out)
    export(small, out)
    assert tree_of(out) == small_tree


def refused_with(plan: ExportPlan, out: Path, cause: str) -> int:
    """Exit code of an export that cannot write; 1 if it gives another cause, 0 if it ends well."""
    try:
        export(plan, out)
    except (OutputError, SceneError) as error:
        return error.exit_code if cause in str(error) else 1
    return 0


def test_too_few_descriptors_are_named_and_it_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path
) -> None:
    """The system's own limit: too low to write, then to read the scene, then just enough."""
    statuses = []
    for spare in range(10):
        out = tmp_path / str(spare)

        def work(out: Path = out, spare: int = spare) -> int:
            highest = max(int(path.name) for path in Path("/proc/self/fd").iterdir())
            os.closerange(3, highest + 1)
            resource.setrlimit(resource.RLIMIT_NOFILE, (3 + spare, 3 + spare))
            return refused_with(small, out, "Too many open files")

        statuses.append(status_of_fork(work))
        export(small, out)
        assert tree_of(out) == small_tree
    assert set(statuses) == {6, 3, 0}
    assert statuses == sorted(statuses, reverse=True)
