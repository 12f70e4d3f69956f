"""The power goes: what was not synced is lost, what is listed as committed is not."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from planted_calls import assert_committed_verifies, assert_nothing_partial
from power_cut import Disk, watched
from tiny_export import POLICY, tree_of

from weather_aug import _files
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import journal
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export


@pytest.fixture(scope="module", params=["cityscapes", "webdataset"])
def plan(scene: WeatherScene, request: pytest.FixtureRequest) -> ExportPlan:
    return plan_export([scene], POLICY, count=2, seed=3, layout=request.param)


@pytest.fixture(scope="module")
def tree(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("whole") / "out"
    export(plan, out)
    return tree_of(out)


def cut_before_each_sync(
    plan: ExportPlan, tree: dict[str, str], folder: Path, *, then_continue: bool = True
) -> int:
    """Cut the power before each sync of an export; check what is left; how many cuts."""
    cuts = 0
    chance = random.Random(5)

    def cut(disk: Disk) -> None:
        nonlocal cuts
        for drawn, names_kept in ((None, False), (None, True), (chance, False)):
            left = folder / "left"
            disk.after_cut(left, drawn, names_kept=names_kept)
            assert_committed_verifies(left)
            assert_nothing_partial(left, tree)
            if then_continue:
                export(plan, left)
                assert tree_of(left) == tree
            shutil.rmtree(left)
            cuts += 1

    (folder / "out").mkdir()
    with watched(folder / "out", cut) as disk:
        export(plan, folder / "out")
        cut(disk)
    return cuts


@pytest.mark.parametrize(
    "sync_every", [1, pytest.param(journal.SYNC_EVERY, marks=pytest.mark.slow)]
)
def test_after_a_power_cut_it_continues(
    plan: ExportPlan,
    tree: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sync_every: int,
) -> None:
    """Lines of the journal that wait for their sync may be lost, others not."""
    monkeypatch.setattr(journal, "SYNC_EVERY", sync_every)
    assert cut_before_each_sync(plan, tree, tmp_path) > 30


def without_file_syncs(real: Callable[[int], None], descriptor: int) -> None:
    if Path(f"/proc/self/fd/{descriptor}").is_dir():
        real(descriptor)


def without_folder_syncs(real: Callable[[int], None], descriptor: int) -> None:
    if not Path(f"/proc/self/fd/{descriptor}").is_dir():
        real(descriptor)


@pytest.mark.parametrize("careless", [without_file_syncs, without_folder_syncs])
def test_a_sync_left_out_would_be_noticed(
    scene: WeatherScene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    careless: Callable[[Callable[[int], None], int], None],
) -> None:
    """The planted fault, of each kind of sync but the journal's own."""
    plan = plan_export([scene], POLICY, count=2, seed=3)
    export(plan, tmp_path / "whole")
    tree = tree_of(tmp_path / "whole")

    class Careless:
        """The module `os` as `_files` sees it."""

        def __getattr__(self, name: str) -> object:
            return getattr(os, name)

        def fsync(self, descriptor: int) -> None:
            careless(os.fsync, descriptor)

    monkeypatch.setattr(_files, "os", Careless())
    monkeypatch.setattr(journal, "SYNC_EVERY", 1)
    with pytest.raises((AssertionError, OSError)):
        cut_before_each_sync(plan, tree, tmp_path, then_continue=False)
