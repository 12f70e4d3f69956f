"""Depth of a picture that nobody labelled: its horizon, its ground, its sky."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tiny_clip import TinyClip

from weather_aug.clip import alone, horizon
from weather_aug.clip.alone import depth_from_picture, surfaces_of
from weather_aug.clip.drivable import edge_behind, ground_edge
from weather_aug.clip.horizon import pitch_from_picture
from weather_aug.clip.prior import MAX_DEPTH_M, MIN_DEPTH_M, geometric_prior_depth
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import GROUND, ROAD, SKY, taxonomy

CAMVID = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"
FOCAL_PX = 400.0
PRINCIPAL_PX = (239.5, 159.5)
HEIGHT_M = 1.5
UInt8 = NDArray[np.uint8]


def street(pitch_deg: float) -> UInt8:
    """A straight road between walls with ledges, (320, 480, 3), from a camera that is tilted."""
    rows, columns = np.mgrid[:320, :480].astype(float)
    pitch = math.radians(pitch_deg)
    x, y = (columns - PRINCIPAL_PX[0]) / FOCAL_PX, (rows - PRINCIPAL_PX[1]) / FOCAL_PX
    down = y * math.cos(pitch) + math.sin(pitch)
    image = np.full((320, 480, 3), (150, 182, 226), np.uint8)
    ground = down > HEIGHT_M / 190
    image[ground] = (92, 90, 88)
    aside = x * HEIGHT_M / np.maximum(down, 1e-3)
    for line_m in (-5.0, -1.8, 1.8, 5.0):
        image[ground & (np.abs(aside - line_m) < 0.12)] = (230, 230, 225)
    wall_m = 9.0 / np.maximum(np.abs(x), 1e-3)
    above_m = HEIGHT_M - wall_m * down
    wall = (above_m > 0) & (above_m < 6) & (wall_m < 120)
    image[wall] = (150, 96, 74)
    image[wall & (np.abs(above_m % 2 - 1) < 0.12)] = (90, 60, 50)
    return image


def _depth(image: UInt8, **other: Any) -> NDArray[np.float32]:
    return depth_from_picture(image, focal_px=FOCAL_PX, principal_px=PRINCIPAL_PX, **other)


@pytest.mark.parametrize("pitch_deg", [-6.0, -2.5, 0.0, 1.5, 5.0])
def test_the_pitch_is_where_the_lines_meet(pitch_deg: float) -> None:
    found = pitch_from_picture(street(pitch_deg), focal_px=FOCAL_PX, principal_px=PRINCIPAL_PX)
    np.testing.assert_allclose(pitch_deg, math.degrees(found), atol=0.3)


def test_a_picture_without_lines_counts_as_level() -> None:
    noise = np.random.Generator(np.random.Philox(3)).integers(0, 256, (320, 480, 3), np.uint8)
    for image in (np.full((320, 480, 3), 90, np.uint8), noise):
        assert abs(pitch_from_picture(image, focal_px=400.0, principal_px=PRINCIPAL_PX)) < 0.02


def _off_road(pitch_deg: float) -> float:
    """Median relative error of depth on the road, 4 to 40 m ahead."""
    pitch = math.radians(pitch_deg)
    slope = (np.arange(320) - PRINCIPAL_PX[1]) / FOCAL_PX
    with np.errstate(divide="ignore"):
        true_m = HEIGHT_M / (slope * math.cos(pitch) + math.sin(pitch))
    near = (true_m > 4) & (true_m < 40)
    found_m = _depth(street(pitch_deg), camera_height_m=HEIGHT_M)[near, 240]
    return float(np.median(np.abs(found_m / true_m[near] - 1)))


@pytest.mark.parametrize("pitch_deg", [-4.0, 0.0, 4.0])
def test_the_road_is_the_plane_below_the_camera(pitch_deg: float) -> None:
    assert _off_road(pitch_deg) < 0.06


def test_a_forgotten_pitch_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alone, "pitch_from_picture", lambda *_, **__: 0.0)
    assert _off_road(4.0) > 0.3


def test_camera_height_scales_the_ground() -> None:
    image = street(0.0)
    one, two = _depth(image, camera_height_m=1.0), _depth(image, camera_height_m=2.0)
    np.testing.assert_allclose(2 * one[300], two[300], rtol=1e-3)


def _frame(width: int = 320, height: int = 240) -> Frame:
    return TinyClip(width=width, height=height).frame(FrameKey(0, "front"))


def _errors(frame: Frame) -> tuple[float, float]:
    """Median relative error, and intersection over union of the sky."""
    camera = frame.camera
    found = depth_from_picture(
        np.array(frame.image), focal_px=camera.focal_px[1], principal_px=camera.principal_px
    )
    true = np.asarray(frame.depth_m, np.float32)
    sky, open_sky = np.isinf(found), np.isinf(true)
    both = ~sky & ~open_sky
    off = float(np.median(np.abs(found[both] / true[both] - 1)))
    return off, float((sky & open_sky).sum() / (sky | open_sky).sum())


@pytest.mark.parametrize("size", [(64, 48), (320, 240), (900, 500)])
def test_a_drawn_street_is_near_its_exact_depth(size: tuple[int, int]) -> None:
    off, sky = _errors(_frame(*size))
    assert off < 0.05
    assert sky > 0.95


def test_errors_would_show_lost_ground_and_sky(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        nothing = np.full(320, 240, np.int32)
        patch.setattr(alone, "ground_edge", lambda *_, **__: nothing)
        assert _errors(_frame())[0] > 0.05
    with monkeypatch.context() as patch:
        patch.setattr(alone, "sky_mask", lambda image: np.zeros(image.shape[:2], bool))
        assert _errors(_frame())[1] < 0.95


@pytest.mark.skipif(not CAMVID.is_dir(), reason="the CamVid subset is not on this machine")
def test_street_photographs_are_parted_as_people_part_them() -> None:
    offs, skies, grounds = [], [], []
    camvid = taxonomy("camvid11")
    for path in sorted((CAMVID / "val").glob("*.png"))[::5]:
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        ids = cv2.imread(str(CAMVID / "valannot" / path.name), cv2.IMREAD_UNCHANGED)
        label = camvid.train_ids(ids, where=path.name)
        view: dict[str, Any] = dict(focal_px=415.0, principal_px=(239.5, 179.5))
        found, seen = depth_from_picture(image, **view), surfaces_of(image, **view).label
        prior = geometric_prior_depth(label, **view)
        both = np.isfinite(found) & np.isfinite(prior)
        offs.append(np.median(np.abs(found[both] / prior[both] - 1)))
        for kept, mine, theirs in (
            (skies, seen == SKY, label == SKY),
            (grounds, seen == ROAD, np.isin(label, GROUND)),
        ):
            known = label != 255
            kept.append((mine & theirs & known).sum() / ((mine | theirs) & known).sum())
    assert np.mean(offs) < 0.2
    assert np.mean(skies) > 0.85
    assert np.mean(grounds) > 0.85


def _sky_border_missed() -> int:
    """Pixels on the wrong side of a border of teeth that are finer than the copy worked on."""
    image = np.full((540, 960, 3), (150, 182, 226), np.uint8)
    skyline = 200 + 3 * (np.arange(960) // 4 % 2)
    land = np.arange(540)[:, None] >= skyline
    image[land] = (60, 70, 50)
    found = depth_from_picture(image, focal_px=830.0, principal_px=(479.5, 269.5))
    return int(np.count_nonzero(np.isfinite(found) != land))


def test_the_border_of_the_sky_is_the_pictures_own(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _sky_border_missed() < 20
    monkeypatch.setattr(alone, "_parted_by_colour", lambda image, share, *_: share > 0.5)
    assert _sky_border_missed() > 500


def test_narrow_things_stand_before_what_is_behind() -> None:
    edge = np.full(320, 130, np.int32)
    edge[100:130] = 160
    edge[200:320] = 160
    behind = edge_behind(edge, 110.0)
    np.testing.assert_array_equal(130, behind[:200])
    np.testing.assert_array_equal(160, behind[200:])


def test_no_column_has_ground_above_the_horizon() -> None:
    image = np.random.Generator(np.random.Philox(5)).integers(0, 256, (60, 80, 3), np.uint8)
    sky = np.zeros((60, 80), bool)
    view: dict[str, Any] = dict(focal_px=70.0, principal_x_px=40.0)
    assert (ground_edge(image, sky, horizon_px=30.5, **view) > 30).all()
    assert (ground_edge(image, sky, horizon_px=500.0, **view) == 60).all()
    assert ground_edge(image, sky, horizon_px=-500.0, **view).min() >= 0


PICTURES = {
    "black": lambda shape: np.zeros((*shape, 3), np.uint8),
    "white": lambda shape: np.full((*shape, 3), 255, np.uint8),
    "blue": lambda shape: np.full((*shape, 3), (120, 160, 230), np.uint8),
    "noise": lambda shape: np.random.Generator(np.random.Philox(7)).integers(
        0, 256, (*shape, 3), np.uint8
    ),
}


@settings(max_examples=60)
@given(
    picture=st.sampled_from(sorted(PICTURES)),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)) | st.just((3, 400)) | st.just((900, 2)),
    focal_px=st.sampled_from([1e-2, 30.0, 500.0, 1e7]),
    principal_px=st.tuples(*2 * [st.sampled_from([-1e5, 0.0, 20.0, 1e5])]),
)
def test_any_picture_has_a_depth(
    picture: str, shape: tuple[int, int], focal_px: float, principal_px: tuple[float, float]
) -> None:
    image = PICTURES[picture](shape)
    image.flags.writeable = False
    before = random.getstate(), np.random.get_state()[1].tobytes(), torch.get_rng_state()  # noqa: NPY002
    depth = depth_from_picture(image, focal_px=focal_px, principal_px=principal_px)
    after = random.getstate(), np.random.get_state()[1].tobytes(), torch.get_rng_state()  # noqa: NPY002
    assert (depth.shape, depth.dtype) == (shape, np.float32)
    known = depth[np.isfinite(depth)]
    assert not np.isnan(depth).any()
    assert ((known >= MIN_DEPTH_M) & (known <= MAX_DEPTH_M * 1.001)).all()
    assert before[:2] == after[:2]
    assert torch.equal(before[2], after[2])
    again = depth_from_picture(image.copy(), focal_px=focal_px, principal_px=principal_px)
    np.testing.assert_array_equal(depth, again)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(focal_px=0.0),
        dict(focal_px=math.nan),
        dict(principal_px=(math.inf, 0.0)),
        dict(camera_height_m=-1.0),
        dict(image=np.zeros((4, 4), np.uint8)),
        dict(image=np.zeros((4, 4, 3), np.float32)),
        dict(image=np.zeros((0, 4, 3), np.uint8)),
    ],
    ids=str,
)
def test_wrong_arguments_are_named(wrong: dict[str, Any]) -> None:
    right: dict[str, Any] = dict(
        image=np.zeros((8, 8, 3), np.uint8), focal_px=8.0, principal_px=(4.0, 4.0)
    )
    with pytest.raises(ArgumentError, match=next(iter(wrong))):
        depth_from_picture(**(right | wrong))


def test_the_copy_that_is_worked_on_is_bounded() -> None:
    for shape in ((2000, 3000), (5000, 3), (3, 5000)):
        small, _ = horizon.shrunk(np.zeros((*shape, 3), np.uint8))
        assert small.shape[0] <= horizon.TALLEST_PX
        assert small.shape[1] <= horizon.WIDEST_PX
