"""Killed or failing at any moment, an export continues to the tree of an uninterrupted run."""

from __future__ import annotations

import errno
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tiny_export import POLICY, tree_of

import weather_aug
from weather_aug import _files
from weather_aug.errors import OutputError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.verify import verify_export

FAULTY = [(os, "fsync"), (os, "open"), (Path, "open"), (Path, "replace"), (Path, "mkdir")]
FAULTY += [(Path, "unlink")]

SCRIPT = """
import json, signal, sys
from pathlib import Path
import export_faults
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import engines
from weather_aug.writers.export import export
from weather_aug.writers.plan import plan_export

if __name__ == "__main__":
    # A shell starts what runs behind it deaf to interrupts; an exporter in a terminal is not.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    scene, out, policy, count, workers, fault = sys.argv[1:]
    engines.work = getattr(export_faults, fault, engines.work)
    plan = plan_export(
        [WeatherScene.load(scene)],
        WeatherPolicy.from_dict(json.loads(policy)),
        count=int(count),
        seed=3,
    )
    try:
        export(plan, Path(out), workers=int(workers))
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.fixture(scope="module")
def small(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=3, seed=3)


@pytest.fixture(scope="module")
def small_tree(small: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("small") / "out"
    export(small, out)
    return tree_of(out)


@pytest.fixture(scope="module")
def long(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=300, seed=3)


@pytest.fixture(scope="module")
def long_tree(long: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("long") / "out"
    export(long, out)
    return tree_of(out)


@contextmanager
def failing_at(call: int, out: Path, fail: Callable[[], Any]) -> Iterator[list[int]]:
    """Call `fail` before the `call`-th call of a function in FAULTY that touches the output."""
    calls = [0]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            if isinstance(args[0], int) or Path(args[0]).is_relative_to(out):
                calls[0] += 1
                if calls[0] == call:
                    fail()
            return function(*args, **kwargs)

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in FAULTY:
            patch.setattr(owner, name, counted(getattr(owner, name)))
        yield calls


def refuse() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def assert_committed_verifies(out: Path, *, cut: bool = False) -> None:
    """What the journal or the finished manifest lists is there, whole."""
    if (out / "export.json").exists():
        # Only the state folder may be left over beside a finished export.
        assert [p for p in verify_export(out) if ".export/" not in p] == []
        return
    journal = out / ".export" / "journal"
    if journal.exists():
        lines = journal.read_text().splitlines(keepends=True)[1:]
        for line in lines[:-1] if cut else lines:
            for file in json.loads(line.partition(" ")[2])["files"].values():
                assert _files.sha256_of_file(out / file["path"]) == file["sha256"]


def test_a_full_disk_at_any_call_is_one_sentence_and_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path
) -> None:
    call, failed = 0, 0
    while True:
        call += 1
        out = tmp_path / str(call)
        with failing_at(call, out, refuse) as calls:
            try:
                export(small, out)
            except OutputError as error:
                failed += 1
                assert "No space left on device" in str(error)
                assert str(out) in str(error)
                assert "\n" not in str(error)
        if calls[0] < call:
            break
        assert_committed_verifies(out)
        export(small, out)
        assert tree_of(out) == small_tree
    assert failed > 50


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_killed_at_any_call_it_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, finished: bool, every: int
) -> None:
    """Once from nothing, once while a damaged export is being repaired."""
    # A written file is five calls, so steps of four meet each kind of call in turn.
    call, status = 1 - every, 1
    while status != 0:
        call += every
        out = tmp_path / str(call)
        if finished:
            export(small, out)
            (out / small.paths(1)["label"]).unlink()
        status = exit_status_of_fork(small, out, call)
        if not finished:
            assert_committed_verifies(out)
        export(small, out)
        assert tree_of(out) == small_tree
    assert call > 30


def exit_status_of_fork(plan: ExportPlan, out: Path, call: int) -> int:
    """Export in a child that is gone without a trace at the `call`-th call; 0 if it got through."""
    child = os.fork()
    if child == 0:
        with failing_at(call, out, lambda: os._exit(9)):
            export(plan, out)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("largest_file", [100, 600, 1300, 3300])
def test_a_write_cut_short_by_the_system_can_be_continued(
    small: ExportPlan, small_tree: dict[str, str], tmp_path: Path, largest_file: int
) -> None:
    """A limit on file sizes fails pictures, then the journal, after a part of it is written."""
    out = tmp_path / "out"
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        try:
            export(small, out)
        except OutputError as error:
            os._exit(error.exit_code if "File too large" in str(error) else 1)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 6
    assert_committed_verifies(out, cut=True)
    export(small, out)
    assert tree_of(out) == small_tree


def started(
    plan: ExportPlan, out: Path, workers: int, fault: str = "none"
) -> subprocess.Popen[bytes]:
    """An exporter in a session of its own, its workers with a fault of `export_faults`."""
    script = out.parent / "script.py"
    script.write_text(SCRIPT)
    policy = json.dumps(plan.job["policy"])
    arguments = [plan.scenes[0].path, out, policy, plan.count, workers, fault]
    folders = (Path(__file__).parent, Path(weather_aug.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, str(script), *map(str, arguments)],
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))},
        stderr=subprocess.PIPE,
    )


def wait_for_lines(process: subprocess.Popen[bytes], out: Path, lines: int) -> None:
    """Until so many samples are committed."""
    journal = out / ".export" / "journal"
    deadline = time.monotonic() + 60
    while not journal.exists() or journal.read_bytes().count(b"\n") <= lines:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.001)


def live_members(session: int) -> list[int]:
    """Processes of a session that are not zombies."""
    members = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(its_session) == session and state != "Z":
            members.append(int(stat.parent.name))
    return members


def assert_all_leave(session: int, since_s: float) -> None:
    """Within 2 s, workers and the helper that multiprocessing starts."""
    while left := live_members(session):
        if time.monotonic() - since_s > 2:
            os.killpg(session, signal.SIGKILL)
            pytest.fail(f"workers {left} outlive their parent")
        time.sleep(0.01)


def kill_and_continue(
    plan: ExportPlan,
    out: Path,
    lines: int,
    *,
    workers: int,
    then: int,
    whole_group: bool,
    fault: str = "none",
) -> None:
    process = started(plan, out, workers, fault)
    wait_for_lines(process, out, lines)
    if whole_group:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        assert len(live_members(process.pid)) > workers > 1
        process.kill()
    killed_s = time.monotonic()
    # Not communicate(): a worker that stayed would hold the pipe of errors open.
    process.wait(5)
    process.stderr.close()
    assert_committed_verifies(out)
    if not whole_group:
        assert_all_leave(process.pid, killed_s)
        before = tree_of(out)
        time.sleep(0.3)
        assert before == tree_of(out)
    report = export(plan, out, workers=then)
    assert report.damaged == 0
    assert report.rendered <= plan.count - lines


def test_killed_alone_it_takes_its_workers_along(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    kill_and_continue(long, out, 3, workers=2, then=1, whole_group=False)
    assert tree_of(out) == long_tree


def test_killed_alone_it_takes_busy_workers_along(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    how = {"workers": 2, "then": 1, "whole_group": False, "fault": "sleep_on_one_item"}
    kill_and_continue(long, out, 6, **how)
    assert tree_of(out) == long_tree


@pytest.mark.parametrize(("lines", "then"), [(0, 1), (40, 2)])
def test_killed_in_one_process_it_continues_in_others(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path, lines: int, then: int
) -> None:
    out = tmp_path / "out"
    kill_and_continue(long, out, lines, workers=1, then=then, whole_group=True)
    assert tree_of(out) == long_tree


def test_interrupted_it_stops_soon_and_continues(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = started(long, out, 2)
    wait_for_lines(process, out, 5)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=5)
    assert process.returncode == 130
    assert b"Traceback" not in errors
    assert_all_leave(process.pid, time.monotonic())
    assert_committed_verifies(out)
    assert export(long, out).rendered < long.count
    assert tree_of(out) == long_tree


@pytest.mark.slow
def test_killed_fifty_times_at_random_it_arrives(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path
) -> None:
    chance = random.Random(7)
    for attempt in range(50):
        out = tmp_path / str(attempt)
        kills = 0
        while True:
            process = started(long, out, chance.choice((1, 2, 3)))
            try:
                process.communicate(timeout=chance.uniform(0.8, 3.5))
                break
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
                kills += 1
                assert_committed_verifies(out)
            if kills == 3:
                export(long, out)
                break
        assert tree_of(out) == long_tree
        assert verify_export(out) == []
