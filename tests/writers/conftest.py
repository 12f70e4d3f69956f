"""The tiny scene, its plan and the tree that an export of it must give."""

from __future__ import annotations

import pytest
from tiny_export import POLICY, TinyClip, tree_of

from weather_aug.render.compose import warm_up
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export


@pytest.fixture(scope="session", autouse=True)
def warm() -> None:
    """Kernels are on disk before a test waits for a process that needs them."""
    warm_up()


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    return WeatherScene.build(TinyClip(), tmp_path_factory.mktemp("scenes") / "tiny")


@pytest.fixture(scope="session")
def plan(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=10, seed=3)


@pytest.fixture(scope="session")
def expected_tree(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What an uninterrupted run of `plan` in one process leaves."""
    out = tmp_path_factory.mktemp("expected") / "out"
    export(plan, out)
    tree = tree_of(out)
    assert len(tree) == 2 * plan.count + 5
    return tree
