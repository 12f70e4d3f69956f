"""Depth edges go back to the picture's edges, on pictures whose depth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from weather_aug.clip import edges
from weather_aug.clip.edges import OtherView, jumps, refined
from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import BUILDING, SKY, TRAIN_ID

HEIGHT, WIDTH = 64, 96
MIN_JUMP = 3.0 / 500.0
NEAR_M, FAR_M = 8.0, 30.0
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]


def _thing(box: tuple[slice, slice], seed: int = 0) -> tuple[Float32, Image]:
    """A red thing before a grey wall, both with texture; depth and picture."""
    depth = np.full((HEIGHT, WIDTH), FAR_M, np.float32)
    depth[box] = NEAR_M
    image = np.full((HEIGHT, WIDTH, 3), (120, 125, 130), np.int64)
    image[box] = (170, 60, 50)
    image += np.random.default_rng(seed).integers(-8, 9, (HEIGHT, WIDTH, 1))
    return depth, image.astype(np.uint8)


def _shifted(depth: Float32, by_px: int) -> Float32:
    return np.roll(depth, by_px, axis=1)


def _band(truth: Float32, reach: int = 3) -> NDArray[np.bool_]:
    inverse = (1 / truth).astype(np.float32)
    edge = jumps(inverse, MIN_JUMP).astype(np.uint8)
    return np.asarray(cv2.dilate(edge, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0)


def _share_right(depth: Float32, truth: Float32, where: NDArray[np.bool_]) -> float:
    with np.errstate(invalid="ignore"):
        close = (np.abs(depth - truth) < 0.1 * truth) | (np.isinf(depth) & np.isinf(truth))
    return float(close[where].mean())


BLOCK = (slice(16, 50), slice(30, 60))


@pytest.mark.parametrize("by_px", [-4, -2, 2, 4])
def test_a_shifted_edge_comes_back(by_px: int) -> None:
    truth, image = _thing(BLOCK)
    depth = _shifted(truth, by_px)
    back = refined(depth, image, min_jump_per_m=MIN_JUMP)
    assert _share_right(depth, truth, _band(truth)) < 0.93
    assert _share_right(back, truth, _band(truth)) > 0.99


def test_a_halo_around_a_post_goes() -> None:
    truth, image = _thing((slice(4, 60), slice(47, 50)))
    depth, _ = _thing((slice(4, 60), slice(44, 53)))
    back = refined(depth, image, min_jump_per_m=MIN_JUMP)
    assert _share_right(back, truth, _band(truth)) > 0.98


def test_no_depth_lies_between_the_two_sides() -> None:
    truth, image = _thing(BLOCK)
    back = refined(_shifted(truth, 3), image, min_jump_per_m=MIN_JUMP)
    assert set(np.unique(back).round(3)) == {NEAR_M, FAR_M}


def test_without_colour_models_the_edge_stays_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: colours that tell nothing."""
    truth, image = _thing(BLOCK)
    grey = np.full((HEIGHT, WIDTH, 3), 99, np.float32)
    monkeypatch.setattr(edges, "_levels", lambda image: grey)
    back = refined(_shifted(truth, 4), image, min_jump_per_m=MIN_JUMP)
    assert _share_right(back, truth, _band(truth)) < 0.93


def test_smooth_depth_is_left_alone() -> None:
    depth = np.repeat((1 / np.linspace(1 / 40, 1 / 4, HEIGHT))[:, None], WIDTH, 1)
    depth = depth.astype(np.float32)
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    back = refined(depth, image, min_jump_per_m=0.05)
    np.testing.assert_allclose(depth, back, rtol=1e-6)


def test_far_from_a_jump_nothing_changes() -> None:
    truth, image = _thing(BLOCK)
    back = refined(_shifted(truth, 4), image, min_jump_per_m=MIN_JUMP, reach_px=5)
    away = ~_band(_shifted(truth, 4), 6)
    np.testing.assert_allclose(_shifted(truth, 4)[away], back[away], rtol=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(-4, 4), st.integers(0, 1000), st.integers(20, 40), st.integers(52, 70))
def test_every_depth_was_there_before(by_px: int, seed: int, left: int, right: int) -> None:
    truth, image = _thing((slice(10, 54), slice(left, right)), seed)
    depth = _shifted(truth, by_px)
    kept = depth.copy()
    back = refined(depth, image, min_jump_per_m=MIN_JUMP)
    assert np.isin(back.round(4), depth.round(4)).all()
    np.testing.assert_array_equal(kept, depth)
    np.testing.assert_array_equal(back, refined(depth, image, min_jump_per_m=MIN_JUMP))


def test_labels_decide_where_colours_cannot() -> None:
    truth, image = _thing(BLOCK)
    image[:] = 120
    label = np.where(truth == NEAR_M, TRAIN_ID["car"], BUILDING).astype(np.uint8)
    depth = _shifted(truth, 3)
    back = refined(depth, image, label=label, min_jump_per_m=MIN_JUMP)
    assert _share_right(back, truth, _band(truth)) > 0.98
    assert _share_right(refined(depth, image, min_jump_per_m=MIN_JUMP), truth, _band(truth)) < 0.95


def test_labelled_sky_is_exactly_the_sky() -> None:
    truth, image = _thing(BLOCK)
    label = np.where(truth == NEAR_M, BUILDING, SKY).astype(np.uint8)
    depth = np.where(_shifted(label.astype(np.float32), 3) == SKY, np.inf, 12.0)
    back = refined(depth.astype(np.float32), image, label=label, min_jump_per_m=MIN_JUMP)
    np.testing.assert_array_equal(label == SKY, np.isinf(back))
    np.testing.assert_allclose(12.0, back[label != SKY], rtol=1e-6)


def test_the_other_view_decides_where_colours_cannot() -> None:
    scale = 120.0
    near_px, far_px = round(scale / NEAR_M), round(scale / FAR_M)
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(
        rng.integers(0, 256, (HEIGHT, WIDTH + 40, 3), dtype=np.uint8), (0, 0), 1.0
    )
    truth, _ = _thing(BLOCK)
    left, right = texture[:, :WIDTH].copy(), texture[:, far_px : WIDTH + far_px].copy()
    left[BLOCK] = texture[BLOCK][::-1]
    right[BLOCK[0], BLOCK[1].start - near_px : BLOCK[1].stop - near_px] = left[BLOCK]
    # Its right edge is seen by both cameras, whose left side hides a strip from one of them.
    seen = _band(truth) & (np.arange(WIDTH) > 50)
    depth = _shifted(truth, 4)
    alone = refined(depth, left, min_jump_per_m=MIN_JUMP)
    paired = refined(depth, left, other_view=OtherView(right, scale), min_jump_per_m=MIN_JUMP)
    assert _share_right(paired, truth, seen) > _share_right(alone, truth, seen) + 0.02


def test_lone_pixels_are_no_surface() -> None:
    truth, image = _thing(BLOCK)
    near = np.full((HEIGHT, WIDTH), 1 / NEAR_M, np.float32)
    far = np.full((HEIGHT, WIDTH), 1 / FAR_M, np.float32)
    speckled = (1 / truth).astype(np.float32)
    speckled[5, 5] = 1 / NEAR_M
    speckled[40, 45] = 1 / FAR_M
    line = speckled.copy()
    line[:, 80] = 1 / NEAR_M
    clean = edges.unspecked(line, near, far)
    assert clean[5, 5] == far[0, 0] and clean[40, 45] == near[0, 0]
    np.testing.assert_array_equal(line[1:-1, 80], clean[1:-1, 80])
    assert image.shape[:2] == clean.shape


@pytest.fixture(scope="module")
def street() -> tuple[Float32, Image, NDArray[np.uint8]]:
    frame = StreetClip(frames=1, width=480, height=288).frame(FrameKey(0, "front"))
    assert frame.depth_m is not None and frame.label is not None
    return frame.depth_m, frame.image, frame.label


def _damaged(truth: Float32) -> Float32:
    """Posts of 2 px lost, and every edge moved by 2 to 4 px in a direction that drifts."""
    with np.errstate(divide="ignore"):
        inverse = (1 / truth).astype(np.float32)
    inverse = cv2.morphologyEx(inverse, cv2.MORPH_OPEN, np.ones((1, 3), np.uint8))
    rng = np.random.default_rng(4)
    x, y, size = (
        cv2.GaussianBlur(rng.standard_normal(truth.shape).astype(np.float32), (0, 0), 12)
        for _ in range(3)
    )
    reach = np.clip(3 + 20 * size, 2, 4) / np.hypot(x, y)
    rows, columns = np.mgrid[: truth.shape[0], : truth.shape[1]].astype(np.float32)
    moved = cv2.remap(
        inverse,
        columns + x * reach,
        rows + y * reach,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    with np.errstate(divide="ignore"):
        return np.where(moved > 0, 1 / moved, np.inf).astype(np.float32)


@pytest.mark.parametrize("labelled", [False, True])
def test_damaged_edges_of_a_street_are_restored(
    street: tuple[Float32, Image, NDArray[np.uint8]], labelled: bool
) -> None:
    truth, image, label = street
    damaged = _damaged(truth)
    jump = 3.0 / 343.0
    with np.errstate(divide="ignore"):
        edge = jumps((1 / truth).astype(np.float32), jump).astype(np.uint8)
    band = cv2.dilate(edge, np.ones((7, 7), np.uint8)) > 0
    shown = label if labelled else None
    back = refined(damaged, image, label=shown, min_jump_per_m=jump)
    before, after = _share_right(damaged, truth, band), _share_right(back, truth, band)
    assert before < 0.85
    # A third of what is wrong comes right, half with labels; leaves are the rest.
    assert 1 - after < (0.6 if labelled else 0.75) * (1 - before)
    assert _share_right(back, truth, ~band) > _share_right(damaged, truth, ~band) - 0.005


def test_bad_arguments_are_refused() -> None:
    truth, image = _thing(BLOCK)
    with pytest.raises(ArgumentError, match="depth_m must have the image's shape"):
        refined(truth[1:], image, min_jump_per_m=MIN_JUMP)
    with pytest.raises(ArgumentError, match="above 0"):
        refined(np.zeros_like(truth), image, min_jump_per_m=MIN_JUMP)
    with pytest.raises(ArgumentError, match="reach_px"):
        refined(truth, image, min_jump_per_m=MIN_JUMP, reach_px=0)
    with pytest.raises(ArgumentError, match="min_jump_per_m"):
        refined(truth, image, min_jump_per_m=0.0)
    with pytest.raises(ArgumentError, match="label"):
        refined(truth, image, label=np.zeros((2, 2), np.uint8), min_jump_per_m=MIN_JUMP)
    with pytest.raises(ArgumentError, match="confidence"):
        refined(truth, image, confidence=truth[1:], min_jump_per_m=MIN_JUMP)
    with pytest.raises(ArgumentError, match="other_view"):
        refined(truth, image, other_view=OtherView(image[1:], 1.0), min_jump_per_m=MIN_JUMP)
