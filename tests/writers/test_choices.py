"""Grids: every frame in every weather with every seed, item by item, without a list."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_export import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather
from weather_aug.writers.choices import FromGrid, FromPolicy, weather_named, weathers_by_name
from weather_aug.writers.plan import ExportPlan, plan_grid
from weather_aug.writers.sample import rendered

WEATHERS = {"dry": Weather.clear(), "storm": Weather.rain(0.9), "whiteout": Weather.fog(0.9)}
SEEDS = (7, -2, 2**63)


@pytest.fixture(scope="module")
def scenes(
    scene: WeatherScene, tmp_path_factory: pytest.TempPathFactory
) -> tuple[WeatherScene, WeatherScene]:
    """Four frames, and two of two cameras each."""
    clip = TinyClip(name="rig", frames=2, cameras=("front", "rear"))
    return scene, WeatherScene.build(clip, tmp_path_factory.mktemp("rig") / "rig")


def listed(plan: ExportPlan) -> list[tuple[int, FrameKey, str, int]]:
    return [(i.scene_index, i.key, i.draw.kind, i.draw.seed) for i in plan]


def test_a_grid_is_the_product_in_its_documented_order(
    scenes: tuple[WeatherScene, WeatherScene],
) -> None:
    plan = plan_grid(scenes, WEATHERS, SEEDS)
    frames = [(number, key) for number, scene in enumerate(scenes) for key in scene.keys]
    expected = [(*frame, *rest) for frame, *rest in product(frames, WEATHERS, SEEDS)]
    assert len(plan) == 8 * 3 * 3
    assert listed(plan) == expected
    assert all(item.draw.weather == WEATHERS[item.draw.kind] for item in plan)
    assert {item.draw.severity for item in plan} == {None}


@given(st.integers(1, 50), st.integers(1, 4), st.integers(1, 5), st.data())
def test_items_of_a_grid_are_the_products(
    frames: int, weathers: int, seeds: int, data: st.DataObject
) -> None:
    names = {f"w{number}": Weather.clear() for number in range(weathers)}
    grid = FromGrid(names, tuple(range(seeds)))
    product_ = list(product(range(frames), names, range(seeds)))
    assert grid.count(frames) == len(product_)
    index = data.draw(st.integers(0, len(product_) - 1))
    frame, draw = grid.item(index, frames)
    assert (frame, draw.kind, draw.seed) == product_[index]


def test_keys_choose_frames_of_every_scene_that_has_them(
    scenes: tuple[WeatherScene, WeatherScene],
) -> None:
    keys = [FrameKey(1, "rear"), FrameKey(0, "front")]
    plan = plan_grid(scenes, ["clear"], keys=keys)
    chosen = [(i.scene_index, i.key) for i in plan]
    assert chosen == [(0, keys[1]), (1, keys[1]), (1, keys[0])]


def test_the_job_tells_grids_apart_and_survives_json(scene: WeatherScene) -> None:
    plan = plan_grid([scene], WEATHERS, SEEDS)
    assert json.loads(json.dumps(plan.job, allow_nan=False)) == plan.job
    others = [
        plan_grid([scene], dict(reversed(WEATHERS.items())), SEEDS),
        plan_grid([scene], WEATHERS, SEEDS[::-1]),
        plan_grid([scene], WEATHERS | {"storm": Weather.rain(0.8)}, SEEDS),
        plan_grid([scene], WEATHERS, SEEDS, keys=scene.keys[:3]),
        plan_grid([scene], WEATHERS, SEEDS, keys=scene.keys[1:]),
    ]
    digests = {other.digest for other in [plan, *others]}
    assert len(digests) == len(others) + 1


def test_a_recipe_of_a_grid_renders_its_weather(scene: WeatherScene) -> None:
    plan = plan_grid([scene], WEATHERS, [5])
    entry, _ = rendered(plan, 1)
    recipe = json.loads(json.dumps(entry["recipe"], allow_nan=False))
    assert (recipe["kind"], recipe["severity"], recipe["seed"]) == ("storm", None, 5)
    assert Weather.from_dict(recipe["weather"]) == WEATHERS["storm"]


def test_a_grid_of_millions_is_no_list(scene: WeatherScene) -> None:
    tracemalloc.start()
    plan = plan_grid([scene], WEATHERS, range(100_000))
    assert plan.item(len(plan) - 1).draw.seed == 99_999
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(plan) == 1_200_000
    assert peak < 16 * 2**20
    assert len(pickle.dumps(plan_grid([scene], WEATHERS))) < 8192


def test_texts_name_weathers() -> None:
    named = weathers_by_name(["clear", "rain", "snow=0.3", "rain+fog=light"])
    assert list(named) == ["clear", "rain", "snow=0.3", "rain+fog=light"]
    assert named["clear"].is_clear
    assert named["rain"] == Weather.rain("heavy")
    assert named["snow=0.3"] == Weather.snow(0.3)
    assert named["rain+fog=light"] == Weather.mix(Weather.rain("light"), Weather.fog("light"))


@pytest.mark.parametrize("text", ["hail", "rain=much", "rain=2", "rain=nan", "", "=0.5", "rain+"])
def test_a_text_that_names_no_weather_is_refused(text: str) -> None:
    with pytest.raises(ArgumentError):
        weather_named(text)


def test_bad_grids_are_refused(scene: WeatherScene) -> None:
    for says, weathers, seeds in (
        ("weathers is empty", [], [0]),
        ("weathers is empty", {}, [0]),
        ("mapping or a list", "rain", [0]),
        ("stands twice", ["rain", "rain"], [0]),
        ("must be a Weather", {"rain": 0.5}, [0]),
        ("name must be a text", [Weather.clear()], [0]),
        ("seeds must be 1 to", ["rain"], []),
        ("seeds must be 1 to", ["rain"], range(10**12)),
        ("no seed twice", ["rain"], [1, 1]),
        ("seeds must be an integer", ["rain"], [0.5]),
    ):
        with pytest.raises(ArgumentError, match=says):
            plan_grid([scene], weathers, seeds)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="scenes is empty"):
        plan_grid([], ["rain"])
    for keys in ([], [FrameKey(0, "rear")]):
        with pytest.raises(ArgumentError, match="keys: "):
            plan_grid([scene], ["rain"], keys=keys)


def test_shares_are_what_items_are(scene: WeatherScene) -> None:
    grid = plan_grid([scene], WEATHERS, SEEDS)
    counted = [item.draw.kind for item in grid]
    assert grid.choice.shares() == {
        kind: pytest.approx(counted.count(kind) / len(counted)) for kind in WEATHERS
    }
    policy = WeatherPolicy(types={"clear": 1, "rain": 3, "snow": 0})
    assert FromPolicy(policy, 0).shares() == {"clear": 0.25, "rain": 0.75}
