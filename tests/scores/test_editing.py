"""Scores of an edited clip: 1 where nothing changed, and worse for what flickers or disagrees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scores import editing
from weather_aug.scores.editing import edit_scores, neighbours_of, statistics_gap
from weather_aug.scores.warp import warp_error
from weather_aug.taxonomy import IGNORE

CLIP = TinyClip(frames=3)
CLEAR = {key: CLIP.frame(key) for key in CLIP.keys}
IMAGES = {key: frame.image for key, frame in CLEAR.items()}
NEIGHBOURS = neighbours_of(CLEAR)
ROUNDING = 1e-12


def scores(images, targets=None):
    return edit_scores(CLEAR, images, targets=targets, neighbours=NEIGHBOURS)


def changed(by):
    """Pictures with `by(key, image)` for each image, float, clipped."""
    return {
        key: np.clip(np.round(by(key, image.astype(float))), 0, 255).astype(np.uint8)
        for key, image in IMAGES.items()
    }


def test_neighbours_are_those_that_share_surfaces():
    assert len(NEIGHBOURS.time) == 2 * len(CLIP.cameras)
    assert len(NEIGHBOURS.view) == CLIP.frames
    a, b = next(iter(NEIGHBOURS.view))
    assert a.time_index == b.time_index
    turned_away = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind = replace(CLEAR[b].camera)
    behind = replace(behind, world_from_camera=behind.world_from_camera @ turned_away)
    apart = neighbours_of({a: CLEAR[a], b: replace(CLEAR[b], camera=behind)})
    assert (dict(apart.time), dict(apart.view)) == ({}, {})


def test_the_recording_is_as_steady_as_itself():
    found = scores(IMAGES)
    for warp in (found.warp_time, found.warp_view):
        assert warp.ratio == 1
        assert warp.ratio_per_contrast == 1
    assert found.colour == found.colour_clear
    assert found.target is None
    expected = [warp_error(CLEAR[a], CLEAR[b]).absolute for a, b in NEIGHBOURS.time]
    assert found.warp_time.absolute == pytest.approx(np.mean(expected), abs=ROUNDING)
    assert (found.warp_time.pairs, found.warp_view.pairs) == (4, 3)


def test_neighbours_are_found_if_not_given():
    assert edit_scores(CLEAR, IMAGES) == scores(IMAGES)


def flickering():
    """A leap of 60 levels from frame to frame, in all cameras alike."""
    return changed(lambda key, image: image + 60 * (key.time_index % 2))


def disagreeing():
    """A leap of 60 levels between the cameras, always the same."""
    return changed(lambda key, image: image + 60 * (key.camera == "right"))


def check_what_flickers_and_what_disagrees():
    calm, flicker, disagree = scores(IMAGES), scores(flickering()), scores(disagreeing())
    assert flicker.warp_time.ratio > 2
    assert flicker.warp_view.ratio == pytest.approx(1, abs=0.15)
    assert flicker.colour.time > calm.colour.time + 0.1
    assert disagree.warp_view.ratio > 2
    assert disagree.warp_time.ratio == pytest.approx(1, abs=0.15)
    assert disagree.colour.view > calm.colour.view + 0.1


def test_what_flickers_is_told_from_what_disagrees():
    check_what_flickers_and_what_disagrees()


def test_pairs_that_are_mixed_up_are_found_out(monkeypatch):
    right = editing._warp_score
    monkeypatch.setattr(editing, "_warp_score", lambda pairs, *rest: right(NEIGHBOURS.time, *rest))
    with pytest.raises(AssertionError):
        check_what_flickers_and_what_disagrees()


def check_grey():
    found = scores(changed(lambda key, image: 128 + (image - 128) / 2))
    assert found.warp_time.ratio == pytest.approx(0.5, abs=0.05)
    assert found.warp_time.ratio_per_contrast == pytest.approx(1, abs=0.05)


def test_less_contrast_is_no_steadiness():
    check_grey()


def test_a_ratio_that_forgets_contrast_is_found_out(monkeypatch):
    monkeypatch.setattr(editing, "_contrast", lambda error: 1.0)
    with pytest.raises(AssertionError):
        check_grey()


def test_pictures_of_one_colour_have_no_contrast_to_measure_by():
    found = scores(changed(lambda key, image: 0 * image + 90))
    assert found.warp_time.absolute < ROUNDING
    assert found.warp_time.ratio < ROUNDING
    assert math.isnan(found.warp_time.ratio_per_contrast)


def test_near_a_target():
    target = changed(lambda key, image: image * 0.5)
    half_way = changed(lambda key, image: image * 0.75)
    there, none, some = (scores(images, target).target for images in (target, IMAGES, half_way))
    assert (there.l1, there.statistics) == (0, 0)
    assert none.l1 == none.l1_clear > 0
    assert none.statistics == none.statistics_clear > 0
    assert some.l1 == pytest.approx(some.l1_clear / 2, rel=0.02)
    assert some.statistics == pytest.approx(some.statistics_clear / 2, rel=0.02)


SHAPE = (6, 5)
PICTURE = arrays(np.uint8, (*SHAPE, 3))
LABEL = arrays(np.uint8, SHAPE, elements=st.sampled_from([0, 1, 10, IGNORE]))


def gap_by_loops(image, target, label):
    """Class by class, as the docstring says it."""
    classes = [c for c in np.unique(label) if c != IGNORE]
    if not classes:
        label, classes = np.zeros(SHAPE, np.uint8), [0]
    total = count = 0.0
    for c in classes:
        off = []
        for measure in (np.mean, np.std):
            for picture_of in (
                lambda p: p[..., 0],
                lambda p: p[..., 1],
                lambda p: p[..., 2],
                lambda p: 0.2126 * p[..., 0] + 0.7152 * p[..., 1] + 0.0722 * p[..., 2],
            ):
                a, b = (measure(picture_of(p[label == c] / 255.0)) for p in (image, target))
                off.append(abs(a - b))
        pixels = (label == c).sum()
        total, count = total + np.mean(off) * pixels, count + pixels
    return total / count


def check_gap(image, target, label):
    expected = gap_by_loops(image, target, label)
    assert statistics_gap(image, target, label) == pytest.approx(expected, abs=1e-9)


@given(image=PICTURE, target=PICTURE, label=LABEL)
def test_gap_is_that_of_plain_loops(image, target, label):
    check_gap(image, target, label)


@given(image=PICTURE, target=PICTURE, order=st.permutations(range(30)))
def test_gap_does_not_ask_where_in_a_class_pixels_stand(image, target, order):
    moved = image.reshape(-1, 3)[np.array(order)].reshape(image.shape)
    gap = statistics_gap(image, target)
    assert statistics_gap(moved, target) == pytest.approx(gap, abs=ROUNDING)
    assert statistics_gap(target, image) == pytest.approx(gap, abs=ROUNDING)
    assert statistics_gap(image, moved) == pytest.approx(0, abs=1e-7)
    assert 0 <= gap <= 1


def test_classes_are_told_apart():
    """Road and sky that change places have the same colours only if nobody knows the classes."""
    image, label = np.zeros((2, 4, 3), np.uint8), np.zeros((2, 4), np.uint8)
    image[0], label[0] = 200, 10
    swapped = image[::-1].copy()
    assert statistics_gap(image, swapped) == pytest.approx(0, abs=ROUNDING)
    assert statistics_gap(image, swapped, label) == pytest.approx(200 / 255 / 2)


def test_a_gap_without_classes_is_found_out(monkeypatch):
    right = editing._statistics
    monkeypatch.setattr(
        editing, "_statistics", lambda image, known, index: right(image, known, 0 * index)
    )
    rng = np.random.default_rng(0)
    image, target = rng.integers(0, 256, (2, *SHAPE, 3)).astype(np.uint8)
    with pytest.raises((AssertionError, ValueError)):
        check_gap(image, target, np.arange(30).reshape(SHAPE).astype(np.uint8) // 15)


KEY = CLIP.keys[0]


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: edit_scores({}, {}), "clear has no frames"),
        (lambda: scores({}), "edited has no picture of frame 000000_front"),
        (lambda: scores(IMAGES, {}), "targets has no picture"),
        (lambda: scores(IMAGES | {KEY: IMAGES[KEY][1:]}), "000000_front.* must have"),
        (lambda: scores(IMAGES | {KEY: IMAGES[KEY] / 255.0}), "000000_front.* must be uint8"),
        (lambda: statistics_gap(IMAGES[KEY], IMAGES[KEY][1:]), "target must have"),
        (
            lambda: statistics_gap(IMAGES[KEY], IMAGES[KEY], np.zeros((2, 2), np.uint8)),
            "label must have",
        ),
        (
            lambda: edit_scores(
                {FrameKey(0, "front"): replace(CLEAR[KEY], depth_m=None)}
                | {FrameKey(1, "front"): CLEAR[FrameKey(1, "front")]},
                IMAGES,
            ),
            "no depth",
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, says):
    with pytest.raises(ArgumentError, match=says):
        call()
