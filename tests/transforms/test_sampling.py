"""Which frame an item shows: every frame in turn, or rare classes by DAFormer's law."""

from __future__ import annotations

import copy
import json
import math
import pickle
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import CLASSES, TRAIN_ID
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.sampling import (
    Choice,
    RareClass,
    RareClassPicks,
    Uniform,
    sampling_from_dict,
)

POLE = TRAIN_ID["pole"]
CROP = (24, 20)


def label_of(**pixels: int) -> NDArray[np.uint8]:
    """A label of a hundred pixels with so many of some train ids, the rest ignored."""
    ids = [int(name[1:]) for name, count in pixels.items() for _ in range(count)]
    return np.array(ids + [255] * (100 - len(ids)), np.uint8).reshape(10, 10)


LABELS = [
    label_of(c0=90, c5=10),
    label_of(c0=50, c1=40),
    label_of(c0=60, c1=30, c5=5),
    label_of(c0=55, c5=10, c7=4),
    label_of(c0=100),
]
"""Class 7 is the rarest, but never has 5 pixels."""


def picks_of(**law: Any) -> RareClassPicks:
    law = {"min_pixels": 5, "temperature": 0.2} | law
    return RareClass(**law).picks(len(LABELS), 100, iter(LABELS))


def test_classes_are_drawn_by_the_law_of_the_paper() -> None:
    """p(c) ∝ exp((1 - f_c) / T), f_c over all labelled pixels of all frames; chi squared."""
    picks = picks_of()
    total = {0: 355, 1: 70, 5: 25, 7: 4}
    frequency = {c: pixels / sum(total.values()) for c, pixels in total.items()}
    assert picks.train_ids == (0, 1, 5)
    weights = [math.exp((1 - frequency[c]) / 0.2) for c in picks.train_ids]
    expected = [weight / sum(weights) for weight in weights]
    assert picks.probability() == pytest.approx(expected)
    count = 20_000
    drawn = Counter(
        picks.pick(11, epoch, item).train_id for epoch in range(2) for item in range(count // 2)
    )
    assert chi_squared([drawn[c] for c in picks.train_ids], expected) < 27.6  # p = 1e-6, 2 df


def chi_squared(found: list[int], expected: list[float]) -> float:
    count = sum(found)
    return sum((n - count * p) ** 2 / (count * p) for n, p in zip(found, expected, strict=True))


def test_another_temperature_would_be_seen() -> None:
    picks, colder = picks_of(), picks_of(temperature=0.17)
    drawn = Counter(colder.pick(11, 0, item).train_id for item in range(20_000))
    assert chi_squared([drawn[c] for c in picks.train_ids], picks.probability()) > 27.6


def test_frames_of_a_class_are_equally_likely_and_show_it() -> None:
    picks = picks_of()
    chosen = [picks.pick(2, 0, item) for item in range(6000)]
    for choice in chosen:
        assert np.count_nonzero(LABELS[choice.frame] == choice.train_id) >= 5
    of_five = Counter(choice.frame for choice in chosen if choice.train_id == 5)
    assert set(of_five) == {0, 2, 3}
    assert chi_squared([of_five[frame] for frame in (0, 2, 3)], [1 / 3] * 3) < 27.6


@pytest.mark.parametrize("temperature", [1e-6, 0.01, 1e6])
def test_every_temperature_has_a_law(temperature: float) -> None:
    probability = picks_of(temperature=temperature).probability()
    assert sum(probability) == pytest.approx(1)
    if temperature == 1e-6:
        assert probability == [0, 0, 1]
    if temperature == 1e6:
        assert probability == pytest.approx([1 / 3] * 3, rel=1e-5)


def test_all_nineteen_classes_fit() -> None:
    label = np.repeat(np.arange(len(CLASSES), dtype=np.uint8), 10)[None]
    picks = RareClass(min_pixels=10).picks(1, 10, [label])
    assert picks.train_ids == tuple(range(len(CLASSES)))
    assert {picks.pick(0, 0, item).train_id for item in range(400)} == set(picks.train_ids)


def test_statistics_take_four_bytes_a_frame() -> None:
    picks = RareClass(min_pixels=5).picks(5000, 5000, LABELS * 1000)
    assert len(pickle.dumps(picks)) < 4 * 5000 + 1000
    again = pickle.loads(pickle.dumps(picks))
    assert all(again.pick(0, 1, item) == picks.pick(0, 1, item) for item in range(50))


def test_no_frame_with_enough_pixels_names_the_cure() -> None:
    with pytest.raises(ArgumentError, match=r"no frame has more than 100 pixels .* lower it"):
        RareClass().picks(5, 5, LABELS)


@given(st.integers(1, 12), st.integers(1, 60), st.integers(0, 5))
def test_uniform_shows_every_frame_equally_often(frames: int, length: int, epoch: int) -> None:
    picks = Uniform().picks(frames, length, ())
    chosen = [picks.pick(3, epoch, item) for item in range(length)]
    counts = Counter(choice.frame for choice in chosen)
    assert set(counts) <= set(range(frames))
    assert max(counts.values()) - min(counts.get(f, 0) for f in range(frames)) <= 1
    whole = length // frames * frames
    assert [choice.frame for choice in chosen[:whole]] == [i % frames for i in range(whole)]
    assert all(choice == Choice(choice.frame) for choice in chosen)


def test_left_over_frames_are_others_in_other_epochs() -> None:
    picks = Uniform().picks(50, 5, ())
    epochs = {tuple(picks.pick(0, e, item).frame for item in range(5)) for e in range(20)}
    assert len(epochs) == 20


@pytest.mark.parametrize("law", [Uniform(), RareClass(), RareClass(0.5, 10, 2.0, 0)])
def test_strategies_are_values(law: Uniform | RareClass) -> None:
    again = sampling_from_dict(json.loads(json.dumps(law.to_dict())))
    assert again == law == copy.deepcopy(law) == pickle.loads(pickle.dumps(law))


@pytest.mark.parametrize(
    ("state", "says"),
    [
        ({}, "strategy must be one of"),
        ({"strategy": "rare"}, "strategy must be one of uniform, rare_class, got 'rare'"),
        ({"strategy": "uniform", "temperature": 1}, "has no field temperature"),
        ([], "strategy must be"),
    ],
)
def test_what_is_no_strategy_is_refused(state: Any, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        sampling_from_dict(state)


@pytest.mark.parametrize(
    "choices",
    [
        *({"temperature": value} for value in (0, -1, math.nan, "1")),
        *({"min_pixels": value} for value in (0, 2.5, math.inf)),
        *({"min_crop_ratio": value} for value in (-1, math.nan)),
        *({"tries": value} for value in (-1, 0.5, 10**6)),
    ],
    ids=str,
)
def test_numbers_outside_their_ranges_are_refused(choices: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError, match=next(iter(choices))):
        RareClass(**choices)


def rare_dataset(scene: WeatherScene, **law: Any) -> WeatherDataset:
    law = {"temperature": 1e-3, "min_pixels": 40, "min_crop_ratio": 0.9} | law
    return WeatherDataset([scene], sampling=RareClass(**law), crop=CROP, length=40)


def poles(dataset: WeatherDataset) -> list[int]:
    """Pixels of the rarest class in each item's clear label."""
    return [int((dataset[item]["label_full"] == POLE).sum()) for item in range(len(dataset))]


def test_crops_are_drawn_until_they_show_the_class(tiny_scene: WeatherScene) -> None:
    """With 60 tries a crop shows it as good as ever; with none seldom."""
    patient, hasty = rare_dataset(tiny_scene, tries=60), rare_dataset(tiny_scene, tries=0)
    assert {patient._picks.pick(0, 0, item).train_id for item in range(40)} == {POLE}
    enough = [sum(n > 36 for n in poles(dataset)) for dataset in (patient, hasty)]
    assert enough[0] == 40
    assert enough[1] < 30


def test_the_last_crop_is_taken_as_it_is(tiny_scene: WeatherScene) -> None:
    impossible = rare_dataset(tiny_scene, tries=3, min_crop_ratio=900.0)
    windows = [json.loads(impossible[item]["recipe"])["window"] for item in range(40)]
    assert len({tuple(window) for window in windows}) > 20


def test_a_crop_that_will_do_is_the_one_without_sampling(tiny_scene: WeatherScene) -> None:
    """The first try is the data set's own crop: nothing is drawn twice for nothing."""
    picky, plain = rare_dataset(tiny_scene, min_crop_ratio=0.0), rare_dataset(tiny_scene, tries=0)
    same = [
        picky[item]["recipe"] == plain[item]["recipe"]
        for item in range(40)
        if (plain[item]["label_full"] == POLE).any()
    ]
    assert same and all(same)


def test_a_dataset_counts_its_frames_once(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = rare_dataset(tiny_scene)
    monkeypatch.setattr(RareClass, "picks", lambda *_: pytest.fail("counted again"))
    again = pickle.loads(pickle.dumps(dataset))
    assert again[3]["recipe"] == dataset[3]["recipe"]


def test_labels_are_needed(unlabelled_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="the frames have no labels"):
        WeatherDataset([unlabelled_scene], sampling=RareClass())


def test_what_is_no_sampling_is_refused(tiny_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="sampling must be Uniform"):
        WeatherDataset([tiny_scene], sampling="rare")  # type: ignore[arg-type]
