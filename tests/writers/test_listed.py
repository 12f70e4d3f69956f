"""Lists of samples: what a line may hold, and what is refused by its number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tiny_export import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, DataError
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather
from weather_aug.writers import listed
from weather_aug.writers.plan import ExportPlan, plan_list

LINE = {"time_index": 2, "camera": "front", "weather": "rain=0.3", "seed": 7}


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """Another street of one frame."""
    clip = TinyClip(name="other", frames=1)
    return WeatherScene.build(clip, tmp_path_factory.mktemp("other") / "other")


def plan_of(lines: list[Any], scenes: list[WeatherScene], folder: Path) -> ExportPlan:
    path = folder / "list.jsonl"
    path.write_text("\n\n".join(x if isinstance(x, str) else json.dumps(x) for x in lines))
    return plan_list(scenes, path)


def test_lines_are_samples_in_their_order(
    scene: WeatherScene, other: WeatherScene, tmp_path: Path
) -> None:
    fog = Weather.fog(visibility_m=80)
    elsewhere = {"time_index": 0, "camera": "front", "weather": fog.to_dict()}
    lines = [
        elsewhere | {"scene_digest": other.digest},
        LINE | {"scene": "tiny"},
        {"item": 9, "recipe": elsewhere | {"scene": "other", "kind": "mist", "severity": 0.5}},
    ]
    plan = plan_of(lines, [scene, other], tmp_path)
    first, second, third = plan
    assert (first.scene_index, first.key, first.draw.weather) == (1, FrameKey(0, "front"), fog)
    assert (first.draw.kind, first.draw.seed, first.draw.severity) == ("listed", 0, None)
    assert (second.scene_index, second.key) == (0, FrameKey(2, "front"))
    assert (second.draw.kind, second.draw.weather) == ("rain=0.3", Weather.rain(0.3))
    assert second.draw.seed == 7
    assert (third.draw.kind, third.draw.severity) == ("mist", 0.5)
    assert plan.choice.shares() == pytest.approx(
        {"listed": 1 / 3, "rain=0.3": 1 / 3, "mist": 1 / 3}
    )


def test_the_job_tells_lists_apart(scene: WeatherScene, tmp_path: Path) -> None:
    second = LINE | {"time_index": 1}
    plans = [
        plan_of(lines, [scene], tmp_path)
        for lines in (
            [LINE, second],
            [second, LINE],
            [LINE, second | {"seed": 8}],
            [LINE, second | {"weather": "rain=0.31"}],
            [LINE, second | {"kind": "drizzle"}],
            [LINE],
        )
    ]
    assert len({plan.digest for plan in plans}) == len(plans)
    assert plan_of([LINE, second], [scene], tmp_path).digest == plans[0].digest


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "line 3 is not valid JSON"),
        ("3", "line 3 is no sample"),
        ({"camera": "front", "weather": "rain"}, "line 3 has no field 'time_index'"),
        (LINE | {"time_index": 99}, "no frame 000099_front"),
        (LINE | {"time_index": "2"}, "time_index must be an integer"),
        (LINE | {"camera": ["front"]}, "no frame"),
        (LINE | {"weather": "hail"}, "'hail'"),
        (LINE | {"weather": {"hail_mm_per_h": 3}}, "hail_mm_per_h"),
        (LINE | {"weather": 3}, "line 3 is no sample"),
        (LINE | {"seed": 0.5}, "seed must be an integer"),
        (LINE | {"severity": 2}, "severity"),
        (LINE | {"scene": "elsewhere"}, "no scene is elsewhere"),
    ],
)
def test_a_line_that_is_no_sample_is_named(
    scene: WeatherScene, tmp_path: Path, line: Any, says: str
) -> None:
    with pytest.raises(DataError, match=says):
        plan_of([LINE, line], [scene], tmp_path)


def test_scenes_of_one_name_need_a_digest(scene: WeatherScene, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="2 scenes are tiny; name one by its scene_digest"):
        plan_of([LINE | {"scene": "tiny"}], [scene, scene], tmp_path)


def test_files_that_are_no_list_are_refused(
    scene: WeatherScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DataError, match="lists no samples"):
        plan_of([""], [scene], tmp_path)
    with pytest.raises(DataError, match="cannot read"):
        plan_list([scene], tmp_path / "missing.jsonl")
    (tmp_path / "list.jsonl").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="not UTF-8"):
        plan_list([scene], tmp_path / "list.jsonl")
    with pytest.raises(ArgumentError, match="scenes is empty"):
        plan_list([], tmp_path / "list.jsonl")
    monkeypatch.setattr(listed, "MAX_LISTED", 2)
    with pytest.raises(DataError, match="more than 2 samples"):
        plan_of([LINE] * 3, [scene], tmp_path)
