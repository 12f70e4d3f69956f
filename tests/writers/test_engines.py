"""Worker processes: the same tree from any number, and none of their deaths goes unnoticed."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import export_faults
import pytest
from tiny_export import tree_of

from weather_aug import _files
from weather_aug.errors import IntegrityError, OutputError, WeatherAugError
from weather_aug.writers import engines
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def committed(out: Path) -> set[int]:
    lines = (out / ".export" / "journal").read_text().splitlines()[1:]
    return {json.loads(line.partition(" ")[2])["item"] for line in lines}


def test_a_killed_worker_is_replaced_and_its_item_made(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    killed: list[int] = []

    def kill_one(_: dict[str, Any]) -> None:
        if not killed:
            worker = multiprocessing.active_children()[0]
            killed.append(worker.pid or 0)
            worker.kill()

    export(plan, out, workers=2, on_sample=kill_one)
    assert killed
    assert tree_of(out) == expected_tree


def test_a_worker_that_dies_after_writing_costs_nothing(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "work", export_faults.die_after_writing_once)
    export(plan, out, workers=2)
    assert (out.parent / "died").exists()
    assert tree_of(out) == expected_tree


def test_what_a_dead_worker_half_wrote_goes_with_the_run(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "work", export_faults.die_while_writing_once)
    export(plan, out, workers=2)
    left = (out.parent / "died").read_text()
    assert left.endswith(_files.TEMPORARY_SUFFIX)
    assert tree_of(out) == expected_tree


@pytest.mark.parametrize("fault", [export_faults.die_on_one_item, export_faults.run_out_of_memory])
def test_an_item_that_kills_its_workers_is_quarantined(
    plan: ExportPlan,
    out: Path,
    fault: Callable[..., None],
    expected_tree: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    item = export_faults.DEADLY_UNIT
    with monkeypatch.context() as patch:
        patch.setattr(engines, "work", fault)
        with pytest.raises(IntegrityError, match=rf"1 item\(s\) .* missing: {item} ") as caught:
            export(plan, out, workers=2)
    assert caught.value.exit_code == 4
    assert json.dumps(plan.recipe(item)) in str(caught.value)
    quarantined = json.loads((out / ".export" / "quarantine.jsonl").read_text())
    assert quarantined == {"item": item, "recipe": plan.recipe(item)}
    assert committed(out) == set(range(10)) - {item}
    assert export(plan, out).rendered == 1
    assert tree_of(out) == expected_tree


def test_a_workers_error_ends_the_run_and_it_can_be_continued(
    plan: ExportPlan, out: Path, expected_tree: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(engines, "work", export_faults.find_the_disk_full)
        with pytest.raises(OutputError, match="No space left on device"):
            export(plan, out, workers=2)
    assert multiprocessing.active_children() == []
    assert export_faults.DEADLY_UNIT not in committed(out)
    export(plan, out)
    assert tree_of(out) == expected_tree


def test_workers_that_cannot_start_end_the_run(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "work", export_faults.end_at_once)
    start_s = time.monotonic()
    with pytest.raises(WeatherAugError, match=r"end while they start .*__main__"):
        export(plan, out, workers=2)
    assert time.monotonic() - start_s < 30
    assert multiprocessing.active_children() == []
