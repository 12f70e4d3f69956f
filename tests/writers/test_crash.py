"""Killed at random moments, an export continues to the tree of an uninterrupted run."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import pytest
from exporters import assert_all_leave, committed_lines, live_members, started, wait_for_lines
from planted_calls import assert_committed_verifies, assert_nothing_partial, committed_entries
from tiny_export import POLICY, tree_of

from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.verify import verify_export

INLINE = {"engine": "inline", "workers": 1}
ONE, TWO, FOUR = ({"engine": "process", "workers": count} for count in (1, 2, 4))
START_S = 1.5
"""About as long as an exporter takes to its first sample."""


@pytest.fixture(scope="module")
def long(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=300, seed=3)


@pytest.fixture(scope="module")
def long_tree(long: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("long") / "out"
    export(long, out)
    return tree_of(out)


def run_until(
    out: Path, plan: ExportPlan, how: Mapping[str, object], chance: random.Random
) -> bool:
    """Run an exporter until a random moment, then kill its whole group; False if it got through."""
    process = started(plan, out, **how)
    begun_s = time.monotonic()
    if chance.random() < 0.2:
        # While it starts, reads back what is there, or at any time at all.
        deadline_s, lines = begun_s + chance.uniform(0, 2 * START_S), plan.count + 1
    else:
        # While it renders, or writes the files at the root.
        deadline_s = begun_s + 60
        lines = chance.randint(committed_lines(out), plan.count)
    while process.poll() is None and time.monotonic() < deadline_s and committed_lines(out) < lines:
        time.sleep(0.001)
    time.sleep(chance.uniform(0, 0.02))
    killed = process.poll() is None
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    assert process.wait(5) in (0, -signal.SIGKILL)
    # Not communicate(): a worker that stayed would hold the pipe of errors open.
    process.stderr.close()
    assert_all_leave(process.pid, time.monotonic())
    return killed


def kill_at_random(
    plan: ExportPlan,
    tree: Mapping[str, str],
    folder: Path,
    how: Mapping[str, object],
    *,
    kills: int,
    seed: int,
) -> None:
    """Kill exporters so often, each of which continues what the last one left."""
    chance = random.Random(seed)
    out = folder / "0"
    workers = int(str(how["workers"]))
    labels = {Path(plan.paths(index)["label"]).name for index in range(plan.count)}
    while kills:
        if run_until(out, plan, how, chance):
            kills -= 1
        assert_committed_verifies(out)
        assert_nothing_partial(out, tree)
        if (out / "export.json").exists():
            out = folder / str(kills)
            continue
        # Lost are at most the samples that the workers had.
        written = sum(path.name in labels for path in out.rglob("*.png"))
        assert written <= len(committed_entries(out)) + workers
    for path in {out, *folder.iterdir()}:
        # One that was killed when it had finished left its lock.
        export(plan, path)
        assert tree_of(path) == tree
        assert verify_export(path) == []


@pytest.mark.parametrize("how", [INLINE, TWO], ids=["inline", "2"])
def test_killed_at_random_it_arrives(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path, how: dict[str, object]
) -> None:
    kill_at_random(long, long_tree, tmp_path, how, kills=3, seed=11)


@pytest.mark.slow
@pytest.mark.parametrize("how", [INLINE, ONE, TWO, FOUR], ids=["inline", "1", "2", "4"])
def test_killed_fifty_times_at_random_it_arrives(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path, how: dict[str, object]
) -> None:
    kill_at_random(long, long_tree, tmp_path, how, kills=50, seed=7)


def kill_the_parent(plan: ExportPlan, out: Path, lines: int, fault: str = "") -> None:
    """Kill an exporter alone, see its workers leave and write nothing more."""
    process = started(plan, out, **TWO, fault=fault)
    wait_for_lines(process, out, lines)
    assert len(live_members(process.pid)) > 2
    process.kill()
    killed_s = time.monotonic()
    process.wait(5)
    process.stderr.close()
    assert_committed_verifies(out)
    assert_all_leave(process.pid, killed_s)
    before = tree_of(out)
    time.sleep(0.3)
    assert before == tree_of(out)


@pytest.mark.parametrize(("lines", "fault"), [(3, ""), (6, "sleep_on_one_item")])
def test_killed_alone_it_takes_its_workers_along(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path, lines: int, fault: str
) -> None:
    """Idle ones, and one that is busy with a sample."""
    out = tmp_path / "out"
    kill_the_parent(long, out, lines, fault)
    done = len(committed_entries(out))
    report = export(long, out)
    assert (report.damaged, report.rendered) == (0, long.count - done)
    assert tree_of(out) == long_tree


def test_killed_in_one_process_it_continues_in_others(
    long: ExportPlan, long_tree: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = started(long, out, **INLINE)
    wait_for_lines(process, out, 40)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=5)
    assert export(long, out, workers=2).rendered <= long.count - 40
    assert tree_of(out) == long_tree
