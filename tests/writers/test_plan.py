"""What an ExportPlan promises: item by item, without a list, without collisions."""

from __future__ import annotations

import json
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_export import POLICY, TinyClip

from weather_aug.errors import ArgumentError, ConflictError, SceneError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.choices import FromPolicy
from weather_aug.writers.plan import ExportPlan, plan_export

RARER_RAIN = {"rain": 1, "clear": 1, "snow": 2, "fog": 1}


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> list[WeatherScene]:
    """Two scenes of one name and different content, the second without labels."""
    folder = tmp_path_factory.mktemp("twins")
    clips = {"a": TinyClip(frames=3), "b": TinyClip(frames=5, labelled=False, tint=9)}
    return [WeatherScene.build(clip, folder / name) for name, clip in clips.items()]


def test_an_item_is_the_same_in_any_order_and_after_pickling(plan: ExportPlan) -> None:
    forward = list(plan)
    copy = pickle.loads(pickle.dumps(plan))
    assert [plan.item(i) for i in reversed(range(10))] == forward[::-1]
    assert list(copy) == forward
    assert copy.job == plan.job


def test_weathers_are_those_of_the_policy(plan: ExportPlan) -> None:
    assert [item.draw for item in plan] == [POLICY.draw(3, 0, i) for i in range(10)]


@pytest.mark.parametrize("count", [1, 3, 8, 20, 50])
def test_every_frame_of_every_scene_comes_equally_often(
    twins: list[WeatherScene], count: int
) -> None:
    plan = plan_export(twins, POLICY, count=count, seed=1)
    times = Counter((item.scene_index, item.key) for item in plan)
    assert sum(times.values()) == count
    least = 0 if len(times) < 8 else min(times.values())
    assert max(times.values()) - least <= 1


def test_the_order_is_shuffled_anew_in_each_round_and_by_the_seed(
    twins: list[WeatherScene],
) -> None:
    def order(seed: int, first: int) -> list[tuple[int, object]]:
        plan = plan_export(twins, POLICY, count=16, seed=seed)
        return [(plan.item(i).scene_index, plan.item(i).key) for i in range(first, first + 8)]

    assert sorted(order(1, 0)) == sorted(order(1, 8)) == sorted(order(2, 0))
    assert order(1, 0) != order(1, 8)
    assert order(1, 0) != order(2, 0)
    assert order(1, 0) != sorted(order(1, 0))


def test_base_names_are_unique_over_scenes_of_one_name_and_over_jobs(
    twins: list[WeatherScene],
) -> None:
    jobs = [plan_export(twins, POLICY, count=40, seed=seed) for seed in (1, 2)]
    jobs.append(plan_export(twins, replace(POLICY, falling=0.5), count=40, seed=1))
    names = [Path(path).name for plan in jobs for i in range(40) for path in plan.paths(i).values()]
    assert len(names) > 120
    assert len(set(names)) == len(names)


def test_only_labelled_frames_get_a_label_path(twins: list[WeatherScene]) -> None:
    plan = plan_export(twins, POLICY, count=16, seed=1)
    for item in plan:
        parts = set(plan.paths(item.item))
        assert parts == ({"image", "label"} if item.scene_index == 0 else {"image"})


@given(st.integers(0, 9))
def test_a_recipe_survives_json_exactly(plan: ExportPlan, index: int) -> None:
    recipe = plan.recipe(index)
    assert json.loads(json.dumps(recipe, allow_nan=False)) == recipe


@pytest.mark.parametrize(
    "change",
    [
        {"choice": FromPolicy(POLICY, 4)},
        {"count": 11},
        {"options": RenderOptions(max_particles=5)},
        {"choice": FromPolicy(replace(POLICY, severity=(0.2, 1.0)), 3)},
        {"choice": FromPolicy(replace(POLICY, types=RARER_RAIN), 3)},
        {"parts": ("image", "label", "depth")},
        {"split": "val"},
    ],
)
def test_what_decides_the_bytes_is_in_the_fingerprint(
    plan: ExportPlan, change: dict[str, object]
) -> None:
    assert replace(plan, **change).digest != plan.digest


def test_the_plan_of_a_million_items_pickles_small(scene: WeatherScene) -> None:
    plan = plan_export([scene], POLICY, count=1_000_000, seed=3)
    assert len(plan) == 1_000_000
    assert plan.item(999_999) == plan.item(999_999)
    assert len(pickle.dumps(plan)) < 4096


def test_bad_arguments_are_refused(scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="scenes is empty"):
        plan_export([], POLICY, count=1, seed=0)
    with pytest.raises(ArgumentError, match="count must be in"):
        plan_export([scene], POLICY, count=0, seed=0)
    with pytest.raises(ArgumentError, match="seed must be an integer"):
        plan_export([scene], POLICY, count=1, seed=0.5)  # type: ignore[arg-type]
    plan = plan_export([scene], POLICY, count=2, seed=0)
    for outside in (-1, 2):
        with pytest.raises(ArgumentError, match="item must be in"):
            plan.item(outside)


@pytest.mark.parametrize("name", ["../../evil", "/etc", "a/b", ""])
def test_a_scene_whose_name_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    scene = WeatherScene.build(TinyClip(frames=1), tmp_path / "scene")
    manifest = scene.path / "scene.json"
    manifest.write_text(manifest.read_text().replace('"tiny"', json.dumps(name)))
    with pytest.raises(SceneError, match="must be letters"):
        plan_export([WeatherScene.load(scene.path)], POLICY, count=1, seed=0)


def test_a_scene_rebuilt_since_is_noticed(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(frames=1), tmp_path / "scene")
    plan = plan_export([scene], POLICY, count=1, seed=0)
    plan.check_scenes()
    WeatherScene.build(TinyClip(frames=2), tmp_path / "scene", overwrite=True)
    with pytest.raises(ConflictError, match="rebuilt"):
        plan.check_scenes()
