"""Bhattacharyya distance of colours: OpenCV's number, a metric, blind to where pixels stand."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scores import colour
from weather_aug.scores.colour import (
    bhattacharyya,
    bhattacharyya_log,
    coefficient,
    colour_histogram,
    steadiness,
)
from weather_aug.scores.neighbours import between_views, over_time

SHAPE = (5, 7, 3)
IMAGE = arrays(np.uint8, SHAPE)
KIND = st.sampled_from(["joint", "channels"])
BINS = st.sampled_from([1, 3, 8, 16, 32])
ROUNDING = 1e-12
OF_OPENCV = 5e-4
"""OpenCV keeps histograms in float32, and sqrt(1 - BC) turns an error of 1e-7 near BC = 1 into its
root."""


def of_opencv(image, bins, kind, mask=None):
    mask = None if mask is None else mask.astype(np.uint8)
    if kind == "joint":
        return cv2.calcHist([image], [0, 1, 2], mask, [bins] * 3, [0, 256] * 3).reshape(-1)
    return np.concatenate(
        [cv2.calcHist([image], [c], mask, [bins], [0, 256]).reshape(-1) for c in range(3)]
    )


def check_against_opencv(a, b, bins=8, kind="joint"):
    theirs = cv2.compareHist(
        of_opencv(a, bins, kind), of_opencv(b, bins, kind), cv2.HISTCMP_BHATTACHARYYA
    )
    ours = bhattacharyya(colour_histogram(a, bins, kind=kind), colour_histogram(b, bins, kind=kind))
    assert ours == pytest.approx(theirs, abs=OF_OPENCV)


@given(a=IMAGE, b=IMAGE, bins=BINS, kind=KIND)
def test_distance_is_opencvs(a, b, bins, kind):
    check_against_opencv(a, b, bins, kind)


def check_histogram(image, bins=8, kind="joint", mask=None):
    theirs = of_opencv(image, bins, kind, mask).astype(np.float64)
    ours = colour_histogram(image, bins, kind=kind, mask=mask)
    assert ours == pytest.approx(theirs / theirs.sum(), abs=ROUNDING)
    assert ours.dtype == np.float64


@given(image=IMAGE, bins=BINS, kind=KIND, mask=arrays(bool, SHAPE[:2]).filter(np.any))
def test_histogram_is_opencvs(image, bins, kind, mask):
    check_histogram(image, bins, kind, mask)


@given(a=IMAGE, b=IMAGE, kind=KIND)
def test_it_is_a_distance(a, b, kind):
    one, other = (colour_histogram(image, kind=kind) for image in (a, b))
    assert 0 <= bhattacharyya(one, other) <= 1
    assert bhattacharyya(one, other) == bhattacharyya(other, one)
    assert bhattacharyya(one, one) == 0
    assert (bhattacharyya(one, other) == 0) == (one == other).all()


@given(a=IMAGE, b=IMAGE, c=IMAGE)
def test_no_detour_is_shorter(a, b, c):
    p, q, r = (colour_histogram(image) for image in (a, b, c))
    assert bhattacharyya(p, r) <= bhattacharyya(p, q) + bhattacharyya(q, r) + ROUNDING


@given(a=IMAGE, b=IMAGE)
def test_both_definitions_are_of_one_coefficient(a, b):
    p, q = colour_histogram(a), colour_histogram(b)
    assert bhattacharyya(p, q) ** 2 == pytest.approx(1 - coefficient(p, q), abs=ROUNDING)
    assert math.exp(-bhattacharyya_log(p, q)) == pytest.approx(coefficient(p, q), abs=ROUNDING)


@given(image=IMAGE, order=st.permutations(range(35)), kind=KIND)
def test_where_pixels_stand_does_not_matter(image, order, kind):
    moved = image.reshape(-1, 3)[np.array(order)].reshape(SHAPE)
    assert (colour_histogram(moved, kind=kind) == colour_histogram(image, kind=kind)).all()


def test_colours_apart_are_as_far_as_can_be():
    black, white = np.zeros(SHAPE, np.uint8), np.full(SHAPE, 255, np.uint8)
    p, q = colour_histogram(black), colour_histogram(white)
    assert bhattacharyya(p, q) == 1
    assert bhattacharyya_log(p, q) == math.inf
    assert bhattacharyya_log(p, p) == 0


def test_channels_apart_do_not_see_which_belong_together():
    """Red and cyan pixels against black and white ones: the same in each channel."""
    one, other = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2, 3), np.uint8)
    one[0] = (255, 0, 0), (0, 255, 255)
    other[0] = (0, 0, 0), (255, 255, 255)
    apart = [colour_histogram(image, kind="channels") for image in (one, other)]
    joint = [colour_histogram(image) for image in (one, other)]
    assert bhattacharyya(*apart) == 0
    assert bhattacharyya(*joint) == 1


def test_near_equal_histograms_keep_their_digits():
    """sqrt(1 - BC) itself would give 0 or 1e-8 of rounding here."""
    p = np.array([0.5, 0.5])
    q = p + np.array([1e-9, -1e-9])
    assert bhattacharyya(p, q) == pytest.approx(1e-9 / math.sqrt(2), rel=1e-6)


def key(time, camera):
    return FrameKey(time, camera)


def of_clip(levels):
    return {key(*at): np.full(SHAPE, level, np.uint8) for at, level in levels.items()}


def test_neighbours_are_of_one_camera_or_of_one_time():
    keys = [key(5, "b"), key(0, "a"), key(0, "b"), key(5, "a"), key(9, "a")]
    assert over_time(keys) == (
        (key(0, "b"), key(5, "b")),
        (key(0, "a"), key(5, "a")),
        (key(5, "a"), key(9, "a")),
    )
    assert between_views(keys) == (
        (key(5, "b"), key(5, "a")),
        (key(0, "a"), key(0, "b")),
    )


def test_time_and_view_are_told_apart():
    """One camera's colours leap from frame to frame, both cameras' are alike: and the reverse."""
    flickers = of_clip({(0, "a"): 0, (0, "b"): 0, (1, "a"): 255, (1, "b"): 255})
    found = steadiness(flickers)
    assert (found.time, found.view, found.time_pairs, found.view_pairs) == (1, 0, 2, 2)
    found = steadiness(of_clip({(0, "a"): 0, (0, "b"): 255, (1, "a"): 0, (1, "b"): 255}))
    assert (found.time, found.view) == (0, 1)


def test_only_the_views_asked_for_are_compared():
    images = of_clip({(0, "a"): 0, (0, "b"): 255, (0, "c"): 255})
    assert steadiness(images).view == pytest.approx(2 / 3)
    found = steadiness(images, views=[(key(0, "b"), key(0, "c"))])
    assert (found.view, found.view_pairs) == (0, 1)


def test_without_neighbours_there_is_no_number():
    found = steadiness(of_clip({(0, "a"): 0}))
    assert math.isnan(found.time)
    assert math.isnan(found.view)


GOOD = np.zeros(SHAPE, np.uint8)
FLAT = np.full(8, 1 / 8)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: colour_histogram(GOOD, 0), "bins must be"),
        (lambda: colour_histogram(GOOD, 2.5), "bins must be a whole"),
        (lambda: colour_histogram(GOOD, kind="hsv"), "kind must be"),
        (lambda: colour_histogram(GOOD / 255.0), "image must be uint8"),
        (lambda: colour_histogram(GOOD, mask=np.zeros(SHAPE[:2], bool)), "mask holds no pixel"),
        (lambda: colour_histogram(GOOD, mask=np.ones((2, 2), bool)), "mask must have"),
        (lambda: colour_histogram(GOOD, mask=GOOD[..., 0]), "mask must be a bool"),
        (lambda: bhattacharyya(FLAT, FLAT[:4] * 2), "histogram_b must have the 8 bins"),
        (lambda: bhattacharyya(FLAT * 2, FLAT), "histogram_a must be shares"),
        (lambda: bhattacharyya(FLAT, [1.0]), "histogram_b must be a one-dim"),
        (lambda: steadiness({}), "images is empty"),
        (lambda: steadiness(of_clip({(0, "a"): 0}), views=[(key(0, "a"), key(1, "a"))]), "views"),
    ],
)
def test_what_does_not_fit_is_refused(call, says):
    with pytest.raises(ArgumentError, match=says):
        call()


def test_a_histogram_of_one_channel_is_found_out(monkeypatch):
    noise = np.random.default_rng(0).integers(0, 256, SHAPE).astype(np.uint8)
    check_histogram(noise)
    monkeypatch.setattr(colour, "image_uint8", lambda _, image: image[..., [0, 0, 0]])
    with pytest.raises(AssertionError):
        check_histogram(noise)


@pytest.mark.parametrize("wrong", [bhattacharyya_log, lambda p, q: 1 - coefficient(p, q)])
def test_another_definition_is_found_out(monkeypatch, wrong):
    monkeypatch.setitem(globals(), "bhattacharyya", wrong)
    rng = np.random.default_rng(1)
    a, b = (rng.integers(0, high, SHAPE).astype(np.uint8) for high in (256, 180))
    with pytest.raises(AssertionError):
        check_against_opencv(a, b)
