"""One plan, one tree: in this process, in 1, 2 or 4 others, and in Ray actors."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from exporters import ray_folder
from numpy.typing import NDArray
from tiny_export import POLICY, tree_of

from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import export as exporter
from weather_aug.writers import sample
from weather_aug.writers.engines import Engine, run_inline, run_processes
from weather_aug.writers.export import ExportReport, export
from weather_aug.writers.plan import ExportPlan, plan_export

COUNT, PER_TAR = 10, 3


def ray_engine() -> Engine:
    pytest.importorskip("ray", reason="ray is not installed")
    from weather_aug.writers.ray_engine import run_ray

    return partial(run_ray, actors=2)


ENGINES: dict[str, Callable[[], Engine]] = {
    "inline": lambda: run_inline,
    "process-1": lambda: partial(run_processes, workers=1),
    "process-2": lambda: partial(run_processes, workers=2),
    "process-4": lambda: partial(run_processes, workers=4),
    "ray-2": ray_engine,
}


@pytest.fixture(scope="module", params=["cityscapes", "webdataset"])
def layout_plan(scene: WeatherScene, request: pytest.FixtureRequest) -> ExportPlan:
    plan = plan_export([scene], POLICY, count=COUNT, seed=3, layout=request.param)
    if plan.layout.tar is None:
        return plan
    return replace(plan, layout=replace(plan.layout, items_per_unit=PER_TAR))


@pytest.fixture(scope="module")
def tree(layout_plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the first run of the plan gave."""
    out = tmp_path_factory.mktemp("first") / "out"
    run(layout_plan, out, run_inline)
    return tree_of(out)


def run(plan: ExportPlan, out: Path, engine: Engine) -> ExportReport:
    """Export by an engine, which `export` would else choose by its name and workers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporter, "_engine", lambda *_: engine)
        return export(plan, out)


@pytest.mark.parametrize("engine", ENGINES)
def test_all_engines_give_one_tree(
    layout_plan: ExportPlan,
    tree: dict[str, str],
    tmp_path: Path,
    engine: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with ray_folder() as folder:
        monkeypatch.setenv("RAY_TMPDIR", str(folder))
        report = run(layout_plan, tmp_path / "out", ENGINES[engine]())
    assert report.rendered == COUNT
    assert tree_of(tmp_path / "out") == tree
    assert len(tree) == (2 * COUNT + 5 if layout_plan.layout.tar is None else 6)
    assert multiprocessing.active_children() == []


def test_one_bit_of_one_picture_would_be_noticed(
    layout_plan: ExportPlan, tree: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, pictures = sample.png_bytes, iter(range(2 * COUNT))

    def other(plane: NDArray[Any]) -> bytes:
        return real(plane ^ (next(pictures) == 7))

    monkeypatch.setattr(sample, "png_bytes", other)
    run(layout_plan, tmp_path / "out", run_inline)
    assert tree_of(tmp_path / "out") != tree
