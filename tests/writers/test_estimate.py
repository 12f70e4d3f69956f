"""What an export will cost, measured on samples that are rendered and encoded as it does."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import estimate as module
from weather_aug.writers.estimate import Estimate, committed, estimate
from weather_aug.writers.export import export
from weather_aug.writers.layout import CONTENTS, JOURNAL
from weather_aug.writers.plan import ExportPlan, plan_export, plan_grid
from weather_aug.writers.sample import Encoded, rendered
from weather_aug.writers.spread import spread_items


def test_bytes_are_near_the_exports(scene: WeatherScene, tmp_path: Path) -> None:
    """Also where a rare weather is several times as large as the others."""
    policy = WeatherPolicy(types={"clear": 5, "snow": 1})
    plan = plan_export([scene], policy, count=60, seed=3)
    written = export(plan, tmp_path / "out").bytes
    cost = estimate(plan, budget_s=1e9)
    assert cost.measured == 32
    assert cost.bytes == pytest.approx(written, rel=0.1)
    mean = sum(sum(map(len, rendered(plan, i)[1].values())) for i in range(60)) / 60
    assert mean == written / 60


def test_time_is_the_mean_of_a_sample_and_ends_the_measurement(
    plan: ExportPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def slow(plan: ExportPlan, index: int) -> tuple[dict[str, object], Encoded]:
        calls.append(index)
        # The first renders what compiles and opens files: it must not be counted.
        time.sleep(0.5 if len(calls) == 1 else 0.05)
        return {}, {"image": b"12345", "label": b"678"}

    monkeypatch.setattr(module, "rendered", slow)
    cost = estimate(plan, most=6, budget_s=1e9)
    assert (len(calls), cost.measured) == (7, 6)
    assert cost.bytes == 10 * 8
    assert 0.05 <= cost.seconds_per_sample < 0.3
    assert len(set(calls[1:])) == 6
    kinds = {plan.item(item).draw.kind for item in range(10)}
    assert {plan.item(item).draw.kind for item in calls[1 : 1 + len(kinds)]} == kinds
    # Without time one of each weather is measured all the same.
    assert estimate(plan, budget_s=0.0).measured == len(kinds)


def test_more_processes_take_less_time_up_to_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    cost = Estimate(samples=100, measured=2, bytes_per_sample=1.0, seconds_per_sample=2.0)
    assert [cost.seconds(workers) for workers in (0, 1, 2, 4, 64)] == [200, 200, 100, 50, 50]
    assert cost.seconds(2, samples=10) == 10


def test_an_estimate_of_a_plan_writes_nothing(scene: WeatherScene, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in scene.path.rglob("*")}
    estimate(plan_grid([scene], ["clear"]), most=1)
    assert {path: path.stat().st_mtime_ns for path in scene.path.rglob("*")} == before


def test_what_is_there_already_is_counted(plan: ExportPlan, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert committed(out, plan) == 0
    counts: list[int] = []

    def stop(entry: dict[str, object]) -> None:
        counts.append(committed(out, plan))
        if len(counts) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(plan, out, on_sample=stop)
    assert counts == [1, 2, 3, 4]
    assert committed(out, plan) == 4
    with (out / JOURNAL).open("ab") as file:
        file.write(b"a line cut sho")
    assert committed(out, plan) == 4
    other = replace(plan, parts=("image",))
    assert committed(out, other) == 0
    export(plan, out)
    assert (committed(out, plan), committed(out, other)) == (10, 0)
    (out / CONTENTS).write_text("{}")
    assert committed(out, plan) == 0


@given(st.integers(1, 10**8), st.integers(1, 64), st.binary(min_size=8, max_size=8))
def test_spread_items_are_distinct_and_one_of_each_stretch(
    count: int, wanted: int, digest: bytes
) -> None:
    items = spread_items("test", digest.hex(), count, wanted)
    wanted = min(wanted, count)
    assert len(items) == wanted
    assert spread_items("test", digest.hex(), count, wanted) == items
    for stretch, item in enumerate(sorted(items)):
        assert stretch * count // wanted <= item < (stretch + 1) * count // wanted
