"""Stereo depth on pairs whose depth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from weather_aug.clip.stereo import disparity, right_depth, stereo_depth
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import BUILDING, SKY

FOCAL_PX, BASELINE_M = 300.0, 0.5
WALL_M, POST_M = 15.0, 6.0
HEIGHT, WIDTH = 120, 260
POST = slice(110, 160)


@pytest.fixture(scope="module")
def pair() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A textured wall at 15 m (10 px) and a wide post before it at 6 m (25 px)."""
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 256, (HEIGHT, WIDTH + 40, 3), dtype=np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.2) // 2 + 100
    post = cv2.GaussianBlur(noise[:, ::-1], (0, 0), 1.2)[:, : POST.stop - POST.start] // 2
    # Brown, because a bright grey wall up to the top of the picture is sky to the heuristic.
    wall[..., 2] //= 2
    left, right = wall[:, :WIDTH].copy(), wall[:, 10 : WIDTH + 10].copy()
    left[:, POST] = post
    right[:, POST.start - 25 : POST.stop - 25] = post
    return left, right


def _depth(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> NDArray[np.float32]:
    return stereo_depth(*pair, focal_px=FOCAL_PX, baseline_m=BASELINE_M)


def test_depth_is_the_known_one(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    depth = _depth(pair)
    truth = np.full((HEIGHT, WIDTH), WALL_M)
    truth[:, POST] = POST_M
    off = np.abs(depth - truth) / truth
    assert np.isfinite(depth).all()
    assert np.median(off) < 0.02
    # Without the background fill the 15 px hidden beside the post alone are 6 % of the picture.
    assert (off > 0.1).mean() < 0.03


def test_hidden_strip_takes_the_background(
    pair: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> None:
    hidden = _depth(pair)[10:-10, POST.start - 13 : POST.start - 3]
    assert np.median(hidden) == pytest.approx(WALL_M, rel=0.05)


def test_edges_are_steps(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    depth = _depth(pair)[20:-20]
    between = (depth > 1.2 * POST_M) & (depth < 0.8 * WALL_M)
    assert between.mean() < 0.005


def test_right_view_is_the_mirror(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    depth = right_depth(*pair, focal_px=FOCAL_PX, baseline_m=BASELINE_M)
    at_post = depth[20:-20, POST.start - 20 : POST.stop - 30]
    assert np.median(at_post) == pytest.approx(POST_M, rel=0.02)
    assert np.median(depth[20:-20, 180:240]) == pytest.approx(WALL_M, rel=0.02)


def test_trust_needs_both_views(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    match = disparity(*pair, max_disparity_px=48)
    assert match.trusted[:, 180:240].mean() > 0.9
    assert match.trusted[10:-10, POST.start - 12 : POST.start - 3].mean() < 0.2


def test_label_decides_the_sky(pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    label = np.full((HEIGHT, WIDTH), BUILDING, np.uint8)
    label[:30] = SKY
    depth = stereo_depth(*pair, focal_px=FOCAL_PX, baseline_m=BASELINE_M, label=label)
    np.testing.assert_array_equal(label == SKY, np.isinf(depth))


def test_pictures_that_are_no_pair_are_refused(
    pair: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> None:
    left, right = pair
    with pytest.raises(ArgumentError, match="right must have the image's shape"):
        stereo_depth(left, right[:, 1:], focal_px=FOCAL_PX, baseline_m=BASELINE_M)
    with pytest.raises(ArgumentError, match="nothing in common"):
        stereo_depth(left, np.zeros_like(right), focal_px=FOCAL_PX, baseline_m=BASELINE_M)
    with pytest.raises(ArgumentError, match="baseline_m"):
        stereo_depth(left, right, focal_px=FOCAL_PX, baseline_m=0.0)
