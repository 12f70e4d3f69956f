"""Severity as a function of the epoch."""

from __future__ import annotations

import copy
import json
import pickle
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.dataset import WeatherDataset

RISING = SeverityCurriculum(((2, (0.1, 0.3)), (10, (0.1, 0.5)), (12, (0.5, 1.0))))


@pytest.mark.parametrize(
    ("epoch", "expected"),
    [
        (0, (0.1, 0.3)),
        (2, (0.1, 0.3)),
        (6, (0.1, 0.4)),
        (10, (0.1, 0.5)),
        (11, (0.3, 0.75)),
        (12, (0.5, 1.0)),
        (2**62, (0.5, 1.0)),
    ],
)
def test_both_ends_move_on_straight_lines(epoch: int, expected: tuple[float, float]) -> None:
    assert RISING.severity(epoch) == pytest.approx(expected)


severities = st.floats(0, 1)
stages = st.lists(
    st.tuples(st.integers(0, 1000), st.tuples(severities, severities).map(sorted)),
    min_size=1,
    max_size=5,
    unique_by=lambda stage: stage[0],
).map(sorted)


@given(stages, st.integers(0, 1100))
def test_every_epoch_has_a_policy(stages: list[Any], epoch: int) -> None:
    """Rounding leads no range out of [0, 1] or its ends past each other."""
    curriculum = SeverityCurriculum(tuple(stages))
    policy = WeatherPolicy({"rain": 1}, falling=0.3)
    changed = curriculum.policy_at(policy, epoch)
    assert changed.severity == curriculum.severity(epoch)
    assert (changed.types, changed.falling) == (policy.types, 0.3)


def test_copies_are_equal() -> None:
    again = SeverityCurriculum.from_dict(json.loads(json.dumps(RISING.to_dict())))
    assert RISING == again == pickle.loads(pickle.dumps(RISING)) == copy.deepcopy(RISING)


@pytest.mark.parametrize(
    "stages",
    [
        *((), None, "ab", ((1, 0.5),)),
        *(((1, (0.2, 0.1)),), ((1, (0, 2)),), ((1, (0, float("nan"))),)),
        *(((2, (0, 1)), (1, (0, 1))), ((1, (0, 1)), (1, (0, 1)))),
        *(((0.5, (0, 1)),), (("1", (0, 1)),)),
    ],
    ids=repr,
)
def test_bad_stages_are_refused(stages: Any) -> None:
    with pytest.raises(ArgumentError, match="stages must be"):
        SeverityCurriculum(stages)


@pytest.mark.parametrize("state", [{}, {"stages": [[0, [0, 1]]], "more": 1}, [], None])
def test_what_is_no_curriculum_is_refused(state: Any) -> None:
    with pytest.raises(ArgumentError, match="is read from"):
        SeverityCurriculum.from_dict(state)


def test_a_dataset_follows_it(tiny_scene: WeatherScene) -> None:
    policy = WeatherPolicy({"rain": 1, "fog": 1}, severity=(0.9, 1.0))
    dataset = WeatherDataset([tiny_scene], policy, curriculum=RISING)
    for epoch in (0, 11, 30):
        dataset.set_epoch(epoch)
        low, high = dataset.policy_at(epoch).severity
        assert (low, high) == RISING.severity(epoch)
        assert all(low <= dataset.drawn(index).severity <= high for index in range(8))
    plain = WeatherDataset([tiny_scene], policy)
    plain.set_epoch(30)
    assert [plain.drawn(i).kind for i in range(8)] == [dataset.drawn(i).kind for i in range(8)]
    assert plain.policy_at(30) == policy


def test_what_is_no_curriculum_is_refused_by_the_dataset(tiny_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="curriculum must be a SeverityCurriculum, got dict"):
        WeatherDataset([tiny_scene], curriculum={"stages": []})  # type: ignore[arg-type]
