"""Members of a Ray are killed at random moments: actors, the driver, or all of it at once."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from exporters import assert_all_leave, committed_lines, live_members, ray_folder, started
from planted_calls import assert_committed_verifies, assert_nothing_partial
from tiny_export import POLICY, tree_of

from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.verify import verify_export

KILLS = 50
RAY = {"engine": "ray", "workers": 2, "fault": "Steady"}
MEMBERS = ["actor", "actor", "actor", "driver", "session"]
LEAVE_S = 30.0
"""Ray's workers look for their node's daemon every few seconds."""

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ray's files stand in a folder that goes; shared memory is as it was."""
    pytest.importorskip("ray", reason="ray is not installed")
    shared = set(Path("/dev/shm").iterdir())
    with ray_folder() as folder:
        monkeypatch.setenv("RAY_TMPDIR", str(folder))
        yield
    assert set(Path("/dev/shm").iterdir()) <= shared


@pytest.fixture(scope="module")
def plan(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=300, seed=3)


@pytest.fixture(scope="module")
def tree(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("whole") / "out"
    export(plan, out)
    return tree_of(out)


def actors_of(session: int) -> list[int]:
    """Processes that render, by the titles that Ray gives them."""
    found = []
    for member in live_members(session):
        with suppress(OSError):
            if Path(f"/proc/{member}/cmdline").read_bytes().startswith(b"ray::Steady"):
                found.append(member)
    return found


def kill(process: subprocess.Popen[bytes], member: str, chance: random.Random) -> bool:
    """Kill some member of an exporter's session; whether there was one."""
    if member == "actor":
        actors = actors_of(process.pid)
        if actors:
            with suppress(ProcessLookupError):
                os.kill(chance.choice(actors), signal.SIGKILL)
        return bool(actors)
    if process.poll() is not None:
        return False
    if member == "driver":
        process.kill()
        return True
    # Daemons and actors have process groups of their own, but stay in the session.
    for pid in live_members(process.pid):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return True


def run_and_kill(
    plan: ExportPlan, out: Path, kills: int, chance: random.Random, killed: list[str]
) -> None:
    """Run an exporter, and kill its actors until one kill or the end of the work ends it."""
    process = started(plan, out, **RAY)
    last = "nobody"
    while len(killed) < kills and last in ("nobody", "actor"):
        lines = committed_lines(out) + chance.randint(0, plan.count // 4)
        while process.poll() is None and committed_lines(out) < lines:
            time.sleep(0.002)
        time.sleep(chance.uniform(0, 0.05))
        member = chance.choice(MEMBERS)
        if process.poll() is not None:
            break
        if kill(process, member, chance):
            killed.append(member)
            last = member
    process.wait(120)
    process.stderr.close()
    assert process.returncode == (0 if last in ("nobody", "actor") else -signal.SIGKILL)
    assert_all_leave(process.pid, time.monotonic(), within_s=LEAVE_S)


def test_killed_fifty_times_at_random_it_arrives(
    plan: ExportPlan, tree: dict[str, str], tmp_path: Path
) -> None:
    chance = random.Random(13)
    killed: list[str] = []
    outs = [tmp_path / "0"]
    while len(killed) < KILLS:
        run_and_kill(plan, outs[-1], KILLS, chance, killed)
        assert_committed_verifies(outs[-1])
        assert_nothing_partial(outs[-1], tree)
        if (outs[-1] / "export.json").exists():
            outs.append(tmp_path / str(len(outs)))
    export(plan, outs[-1])
    for out in outs:
        assert tree_of(out) == tree
        assert verify_export(out) == []
    assert set(killed) == set(MEMBERS)


def test_an_interrupted_run_takes_its_ray_along(
    plan: ExportPlan, tree: dict[str, str], tmp_path: Path
) -> None:
    process = started(plan, tmp_path / "out", **RAY)
    while committed_lines(tmp_path / "out") < 5:
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    process.wait(60)
    process.stderr.close()
    assert process.returncode == 130
    assert_all_leave(process.pid, time.monotonic(), within_s=LEAVE_S)
    assert_committed_verifies(tmp_path / "out")
    export(plan, tmp_path / "out")
    assert tree_of(tmp_path / "out") == tree
