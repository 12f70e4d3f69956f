"""Labels of a batch: those of `render`, whatever the policy and the integers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from batch_scene import Case, arguments, batch, yard

from weather_aug.render import batch_label
from weather_aug.render.batch import BATCH_OPTIONS, render_batch
from weather_aug.render.batch_label import frame_of
from weather_aug.taxonomy import IGNORE
from weather_aug.weather import Weather

THICK = Weather(visibility_m=25.0)
DEEP = Weather(snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2, visibility_m=60.0)


WALL = Weather(visibility_m=5.0)
"""Fog in which a car 8.5 m ahead has vanished."""


@pytest.mark.parametrize(
    ("weather", "policy"),
    [
        (THICK, "ignore_unseen"),
        (DEEP, "ignore_unseen"),
        (DEEP, "keep"),
        (WALL, "keep"),
        (WALL, "acdc"),
    ],
)
def test_labels_are_those_of_the_compiled_renderer(weather, policy):
    options = replace(BATCH_OPTIONS, labels=policy)
    case = Case(yard(), weather)
    expected, found = case.alone(options=options), batch([case], options=options)
    assert expected.invalid.mean() > 0.02
    assert ((expected.label != case.frame.label).any()) == (policy != "keep")
    assert (expected.label != found.label[0].numpy()).mean() < 1e-3
    assert (expected.invalid != found.invalid[0].numpy()).mean() < 1e-3


def test_without_labels_the_mask_still_tells():
    case = Case(yard(labelled=False), THICK)
    expected, found = case.alone(), batch([case])
    assert found.label is None
    assert expected.invalid.mean() > 0.02
    assert (expected.invalid != found.invalid[0].numpy()).mean() < 1e-3


def without_snow(monkeypatch):
    monkeypatch.setattr(batch_label, "_under_snow", lambda sight, *_: sight)


def all_small(monkeypatch):
    monkeypatch.setattr(batch_label, "small_things", lambda *_: None)


def nothing_distinct(monkeypatch):
    right = batch_label.readable_labels
    wrong = lambda a, b, c, seen, *rest: right(a, b, c, 0 * seen, *rest)  # noqa: E731
    monkeypatch.setattr(batch_label, "readable_labels", wrong)


@pytest.mark.parametrize(
    ("fault", "weather"), [(without_snow, DEEP), (all_small, THICK), (nothing_distinct, THICK)]
)
def test_the_agreement_would_notice(fault, weather, monkeypatch):
    case = Case(yard(), weather)
    fault(monkeypatch)
    expected, found = case.alone(), batch([case])
    assert (expected.invalid != found.invalid[0].numpy()).mean() > 1e-3


def test_wide_ids_come_back_as_they_were():
    inputs = arguments([Case(yard(), THICK)])
    plain = inputs["labels"]
    wide = plain.long()
    wide[0, 50, :20], wide[0, 51, :20], plain[0, 50:52, :20] = -1, 300, IGNORE
    narrow, found = render_batch(**inputs), render_batch(**(inputs | {"labels": wide}))
    assert torch.equal(narrow.image, found.image)
    assert torch.equal(narrow.invalid, found.invalid)
    kept = found.label != IGNORE
    assert torch.equal(wide[kept], found.label[kept])
    assert (found.label[0, 50:52, :20] < 0).any() or (found.label[0, 50:52, :20] > 255).any()


def test_a_frame_of_tensors_is_the_recorded_one():
    case = Case(yard(), THICK)
    inputs = arguments([case])
    tensors = (inputs[name][0] for name in ("images", "depth_m", "labels"))
    frame = frame_of(*tensors, inputs["cameras"][0], 2.0)
    np.testing.assert_array_equal(case.frame.image, frame.image)
    np.testing.assert_array_equal(case.frame.depth_m, frame.depth_m)
    np.testing.assert_array_equal(case.frame.label, frame.label)
    assert frame.time_s == 2.0
