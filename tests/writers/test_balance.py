"""Class balance: frames by DAFormer's law over the scenes' labels, item by item."""

from __future__ import annotations

import json
import math
import pickle
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tiny_export import POLICY, TinyClip

from weather_aug.errors import ArgumentError
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import CLASSES, TRAIN_ID
from weather_aug.writers.balance import ClassBalance
from weather_aug.writers.choices import FromPolicy
from weather_aug.writers.plan import ExportPlan, plan_export

CAR = TRAIN_ID["car"]
LAW = ClassBalance(temperature=0.3, min_pixels=20)
"""The car has 32, 28, 24, 20 and 16 pixels in the frames of the tiny street."""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[WeatherScene]:
    """Frames 0..4 labelled, 5..7 not."""
    folder = tmp_path_factory.mktemp("balanced")
    clips = {"a": TinyClip(frames=5), "b": TinyClip(frames=3, labelled=False, tint=9)}
    return [WeatherScene.build(clip, folder / name) for name, clip in clips.items()]


def balanced(scenes: list[WeatherScene], count: int = 600, seed: int = 3) -> ExportPlan:
    return plan_export(scenes, POLICY, count=count, seed=seed, balance=LAW)


def pixels_of(scene: WeatherScene) -> np.ndarray:
    """(frames, 19) counted from the clear frames, as the law is written."""
    labels = [scene.frame(key).label for key in scene.keys]
    return np.array([[int((label == c).sum()) for c in range(len(CLASSES))] for label in labels])


def test_classes_are_drawn_by_the_law(scenes: list[WeatherScene]) -> None:
    pixels = pixels_of(scenes[0])
    frequency = pixels.sum(axis=0) / pixels.sum()
    classes = [c for c in range(len(CLASSES)) if (pixels[:, c] >= LAW.min_pixels).any()]
    weights = [math.exp((1 - frequency[c]) / LAW.temperature) for c in classes]
    expected = {CLASSES[c]: w / sum(weights) for c, w in zip(classes, weights, strict=True)}
    choice = balanced(scenes).choice
    assert isinstance(choice, FromPolicy)
    assert choice.balance is not None
    assert choice.balance.shares() == pytest.approx(expected)
    assert next(iter(choice.balance.shares())) == "car"


def test_frames_come_as_often_as_the_law_says(scenes: list[WeatherScene]) -> None:
    plan = balanced(scenes)
    pixels = pixels_of(scenes[0])
    assert isinstance(plan.choice, FromPolicy)
    assert plan.choice.balance is not None
    expected = np.zeros(5)
    for name, share in plan.choice.balance.shares().items():
        enough = pixels[:, CLASSES.index(name)] >= LAW.min_pixels
        expected += share * enough / enough.sum()
    times = Counter((item.scene_index, item.key.time_index) for item in plan)
    seen = np.array([times[0, time] for time in range(5)]) / len(plan)
    assert seen.sum() == 1
    # Three standard deviations of a share over 600 items.
    assert np.abs(seen - expected).max() < 3 * 0.5 / math.sqrt(600)
    assert seen[4] < seen[:4].min()


def test_frames_without_a_label_are_never_chosen(scenes: list[WeatherScene]) -> None:
    assert {item.scene_index for item in balanced(scenes)} == {0}
    assert {item.scene_index for item in balanced(scenes[::-1])} == {1}


def test_weathers_stay_those_of_the_policy(scenes: list[WeatherScene]) -> None:
    plan = balanced(scenes, count=20)
    assert [item.draw for item in plan] == [POLICY.draw(3, 0, i) for i in range(20)]


def test_an_item_is_the_same_in_any_order_and_after_pickling(scenes: list[WeatherScene]) -> None:
    plan = balanced(scenes, count=40)
    forward = list(plan)
    copy = pickle.loads(pickle.dumps(plan))
    assert [copy.item(i) for i in reversed(range(40))] == forward[::-1]
    assert (copy.job, copy.digest) == (plan.job, plan.digest)
    assert list(balanced(scenes, count=41))[:40] == forward
    assert list(balanced(scenes, count=40, seed=4)) != forward
    assert len(pickle.dumps(plan)) < 8192


def test_labels_are_read_once_and_what_was_counted_is_in_the_job(
    scenes: list[WeatherScene], monkeypatch: pytest.MonkeyPatch
) -> None:
    read, calls = store.read_surfaces, []

    def counting(folder: Path, record: store.FrameRecord) -> object:
        calls.append(record.key)
        return read(folder, record)

    monkeypatch.setattr(store, "read_surfaces", counting)
    plan = balanced(scenes)
    list(plan)
    assert len(calls) == 8
    assert json.loads(json.dumps(plan.job, allow_nan=False)) == plan.job
    unbalanced = plan_export(scenes, POLICY, count=600, seed=3)
    assert "balance" not in unbalanced.job
    other = plan_export(scenes, POLICY, count=600, seed=3, balance=ClassBalance(0.3, 28))
    assert len({plan.digest, unbalanced.digest, other.digest}) == 3

    def one_pixel_less(folder: Path, record: store.FrameRecord) -> object:
        depth, label = read(folder, record)
        if label is not None:
            label = label.copy()
            label[np.nonzero(label == CAR)[0][0], np.nonzero(label == CAR)[1][0]] = 0
        return depth, label

    monkeypatch.setattr(store, "read_surfaces", one_pixel_less)
    assert balanced(scenes).digest != plan.digest


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ({"min_pixels": 0}, "min_pixels"),
        ({"min_pixels": 2.5}, "min_pixels must be whole"),
        ({"temperature": 0}, "temperature"),
        ({"temperature": math.nan}, "temperature"),
    ],
)
def test_numbers_outside_their_range_are_refused(law: dict[str, float], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        ClassBalance(**law)  # type: ignore[arg-type]


def test_too_high_a_bound_or_no_label_says_what_to_do(scenes: list[WeatherScene]) -> None:
    for some in (scenes, scenes[1:]):
        with pytest.raises(ArgumentError, match=r"min_pixels is 3000.*lower it"):
            plan_export(some, POLICY, count=1, seed=0, balance=ClassBalance())
