"""The geometric prior on a drawn street."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from weather_aug.clip.prior import MAX_DEPTH_M, MIN_DEPTH_M, geometric_prior_depth
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import BUILDING, CLASSES, IGNORE, ROAD, SKY, TRAIN_ID

HEIGHT, WIDTH, FOCAL_PX = 360, 480, 415.0
PRINCIPAL_PX = (239.5, 179.5)
CAR, POLE, SIGN = TRAIN_ID["car"], TRAIN_ID["pole"], TRAIN_ID["traffic sign"]


def _ground_m(row: float, pitch_rad: float = 0.0) -> float:
    slope = (row - PRINCIPAL_PX[1]) / FOCAL_PX
    return 1.5 / (slope * math.cos(pitch_rad) + math.sin(pitch_rad))


def _street() -> NDArray[np.uint8]:
    label = np.full((HEIGHT, WIDTH), SKY, np.uint8)
    label[200:] = ROAD
    label[60:215, :120] = BUILDING
    label[60:200, 360:] = BUILDING
    label[180:260, 200:290] = CAR
    label[100:240, 400:404] = POLE
    label[90:110, 392:412] = SIGN
    return label


def _depth(label: NDArray[np.uint8], **options: float) -> NDArray[np.float32]:
    return geometric_prior_depth(label, focal_px=FOCAL_PX, principal_px=PRINCIPAL_PX, **options)


def test_ground_is_the_plane_below_the_camera() -> None:
    depth = _depth(_street())
    for row in (300, 320, 359):
        np.testing.assert_allclose(_ground_m(row), depth[row], rtol=1e-5)
    pitched = _depth(_street(), pitch_rad=0.05)
    np.testing.assert_allclose(_ground_m(320, 0.05), pitched[320], rtol=1e-5)


def test_ground_never_recedes_down_a_column() -> None:
    label = np.full((HEIGHT, WIDTH), ROAD, np.uint8)
    assert (np.diff(_depth(label), axis=0) <= 0).all()


def test_things_stand_where_they_touch_the_ground() -> None:
    depth = _depth(_street())
    np.testing.assert_allclose(_ground_m(259), depth[180:260, 200:290], rtol=0.01)
    np.testing.assert_allclose(_ground_m(214), depth[60:180, 10:100], rtol=0.01)
    np.testing.assert_allclose(_ground_m(239), depth[120:240, 400:404], rtol=0.01)


def test_sky_is_infinite_and_nothing_else() -> None:
    label = _street()
    np.testing.assert_array_equal(label == SKY, np.isinf(_depth(label)))


def test_a_sign_hangs_on_its_pole() -> None:
    label = _street()
    depth = _depth(label)
    assert depth[95, 395] == pytest.approx(_ground_m(239), rel=0.01)


def test_a_sign_without_a_pole_is_not_behind_the_facade_it_covers() -> None:
    label = _street()
    label[170:178, 30:40] = SIGN
    assert _depth(label)[174, 35] <= _ground_m(214) * 1.01


def test_a_broken_pole_is_one_pole() -> None:
    label = _street()
    label[20:90, 400:404] = POLE
    label[112:116, 400:404] = SKY
    depth = _depth(label)
    np.testing.assert_allclose(_ground_m(239), depth[20:90, 400:404], rtol=0.01)


def test_a_hidden_facade_stands_behind_what_hides_it() -> None:
    label = np.full((HEIGHT, WIDTH), SKY, np.uint8)
    label[60:190] = BUILDING
    label[190:230] = CAR
    label[230:] = ROAD
    depth = _depth(label)
    assert depth[200, 240] == pytest.approx(_ground_m(229), rel=0.01)
    assert _ground_m(229) < depth[100, 240] < _ground_m(189)


def test_hidden_columns_take_the_nearest_visible_contact() -> None:
    label = _street()
    label[210:250, 60:100] = CAR
    label[200:215, 40:120] = CAR
    np.testing.assert_allclose(_ground_m(214), _depth(label)[100, :120], rtol=0.02)


def test_ignored_pixels_take_their_neighbours_depth() -> None:
    label = _street()
    whole = _depth(label)
    holed = label.copy()
    holed[300:304, 100:400] = IGNORE
    holed[100:104, 20:60] = IGNORE
    holed[10:12, 200:204] = IGNORE
    np.testing.assert_allclose(whole, _depth(holed), rtol=0.05)


@settings(max_examples=40, deadline=None)
@given(
    arrays.arrays(
        np.uint8,
        st.tuples(st.integers(1, 24), st.integers(1, 24)),
        elements=st.sampled_from([*range(len(CLASSES)), IGNORE]),
    ),
    st.floats(-0.3, 0.3),
)
def test_any_label_gives_usable_depth(label: NDArray[np.uint8], pitch_rad: float) -> None:
    if (label == IGNORE).all():
        return
    depth = geometric_prior_depth(
        label, focal_px=20.0, principal_px=(12.0, 9.0), pitch_rad=pitch_rad
    )
    assert depth.dtype == np.float32 and depth.shape == label.shape
    finite = depth[np.isfinite(depth)]
    assert not np.isnan(depth).any()
    assert (finite >= MIN_DEPTH_M).all() and (finite <= MAX_DEPTH_M * 1.0001).all()
    assert np.isinf(depth[label == SKY]).all()


def test_bad_labels_are_refused() -> None:
    with pytest.raises(ArgumentError, match="holds 33, which is no train id"):
        _depth(np.full((4, 4), 33, np.uint8))
    with pytest.raises(ArgumentError, match="ignores every pixel"):
        _depth(np.full((4, 4), IGNORE, np.uint8))
    with pytest.raises(ArgumentError, match="uint8"):
        _depth(np.zeros((4, 4), np.int64))  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_prior_is_quick() -> None:
    label = _street()
    _depth(label)
    seconds = []
    for _ in range(9):
        start = time.perf_counter()
        _depth(label)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.03
