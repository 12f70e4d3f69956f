"""Posts of known disparity before the sky and before a wood."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from weather_aug.clip import posts, stereo
from weather_aug.clip.posts import post_disparity, upright
from weather_aug.clip.stereo import stereo_depth

HEIGHT, WIDTH = 120, 200
POST = (slice(20, 110), slice(100, 102))
POST_PX, BEHIND_PX = 14, 3
Pair = tuple[NDArray[np.uint8], NDArray[np.uint8]]


def _pair(behind: NDArray[np.uint8], colour: tuple[int, int, int]) -> Pair:
    left, right = behind[:, :WIDTH].copy(), behind[:, BEHIND_PX : WIDTH + BEHIND_PX].copy()
    left[POST] = colour
    right[POST[0], POST[1].start - POST_PX : POST[1].stop - POST_PX] = colour
    return left, right


@pytest.fixture(scope="module")
def sky() -> Pair:
    rng = np.random.default_rng(0)
    behind = np.full((HEIGHT, WIDTH + 20, 3), (140, 190, 250), np.int64)
    behind += rng.integers(-3, 4, behind.shape)
    return _pair(behind.clip(0, 255).astype(np.uint8), (205, 212, 222))


@pytest.fixture(scope="module")
def wood() -> Pair:
    noise = np.random.default_rng(1).integers(0, 120, (HEIGHT, WIDTH + 20, 3), dtype=np.uint8)
    return _pair(cv2.GaussianBlur(noise, (0, 0), 1.0), (190, 190, 180))


@pytest.mark.parametrize("name", ["sky", "wood"])
def test_a_post_has_its_disparity(name: str, request: pytest.FixtureRequest) -> None:
    found = post_disparity(*request.getfixturevalue(name), max_disparity_px=40)
    inside = found[32:98, POST[1]]
    assert (np.abs(inside - POST_PX) < 0.5).mean() > 0.95
    beside = np.ones(found.shape, bool)
    beside[:, 96:106] = False
    assert (found[beside] > 0).mean() < 0.002


def test_a_post_in_one_picture_only_is_not_matched(sky: Pair) -> None:
    left, right = sky
    empty = right.copy()
    empty[:] = right[:1]
    assert not post_disparity(left, empty, max_disparity_px=40).any()


def test_two_equal_posts_are_not_guessed_at(sky: Pair) -> None:
    left, right = sky
    twice = right.copy()
    twice[POST[0], 72:74] = right[POST[0], 86:88]
    assert not (post_disparity(left, twice, max_disparity_px=40) > 0).any()


def test_without_the_rival_check_it_would_guess(sky: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: any good match is taken."""
    left, right = sky
    twice = right.copy()
    twice[POST[0], 72:74] = right[POST[0], 86:88]
    guessing = posts._matched.py_func
    monkeypatch.setitem(guessing.__globals__, "RIVAL_MISMATCH", np.float32(-10.0))
    monkeypatch.setattr(posts, "_matched", guessing)
    assert (post_disparity(left, twice, max_disparity_px=40) > 0).any()


def test_a_wide_wall_and_a_short_mark_are_no_posts() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image[:, 40:80] = 200
    image[60:66, 150:152] = 250
    assert not (upright(image) > posts.MIN_CONTRAST).any()


def test_stereo_keeps_a_post_before_the_sky(sky: Pair) -> None:
    left, right = (view.copy() for view in sky)
    # Ground with texture, so that there is something else to match.
    ground = cv2.GaussianBlur(
        np.random.default_rng(3).integers(0, 160, (30, WIDTH + 30, 3), dtype=np.uint8), (0, 0), 1.0
    )
    left[-30:], right[-30:] = ground[:, :WIDTH], ground[:, 20 : WIDTH + 20]
    depth = stereo_depth(left, right, focal_px=300.0, baseline_m=0.5)
    at_post = depth[30:84, POST[1]]
    assert (np.abs(at_post - 150.0 / POST_PX) < 1.0).mean() > 0.9
    assert np.isinf(depth[30:80, 40:90]).mean() > 0.99


def test_a_post_nearer_than_the_ground_below_it_is_a_false_match(
    sky: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right = (view.copy() for view in sky)
    ground = cv2.GaussianBlur(
        np.random.default_rng(3).integers(0, 160, (30, WIDTH + 30, 3), dtype=np.uint8), (0, 0), 1.0
    )
    left[-30:], right[-30:] = ground[:, :WIDTH], ground[:, 6 : WIDTH + 6]
    false = np.zeros((HEIGHT, WIDTH), np.float32)
    # At a place where nothing stands; 40 px would be nearer than the ground's 6 px.
    false[40:80, 150:152] = 40.0
    monkeypatch.setattr(stereo, "post_disparity", lambda *views, **limits: false.copy())
    here = (slice(40, 80), slice(150, 152))
    assert np.isinf(stereo_depth(left, right, focal_px=300.0, baseline_m=0.5)[here]).all()
    nearest = np.full((HEIGHT, WIDTH), 99, np.float32)
    monkeypatch.setattr(stereo, "_nearest_below", lambda match: nearest)
    assert np.isfinite(stereo_depth(left, right, focal_px=300.0, baseline_m=0.5)[here]).any()
