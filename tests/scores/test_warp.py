"""Warp error: exactly nothing on an exact scene, and something as soon as the geometry is wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from analytic_scene import (
    BOX,
    BOX_HIGH_M,
    BOX_LOW_M,
    NOTHING,
    camera,
    directions,
    sampled_from_one_face,
    truly_visible,
    view,
)
from hypothesis import assume, given
from hypothesis import strategies as st

from weather_aug.clip.types import Box, Camera, Frame
from weather_aug.errors import ArgumentError
from weather_aug.scene.scene import WeatherScene
from weather_aug.scores import warp
from weather_aug.scores.warp import correspondence, warp_error
from weather_aug.taxonomy import SKY, TRAIN_ID

A = camera((0.0, 0.0, 0.0), 0.02, 0.01)
B = camera((0.7, -0.2, 1.0), -0.05, -0.02, width=80, height=60, focal_px=61.0)
ROUNDING = 1e-12
"""Of float64, in sRGB of at most 1."""


def check_exact(a: Camera = A, b: Camera = B, sky: warp.Sky = "out", least_share: float = 0.3):
    """No error where sampling is exact, and the compared pixels are those that b truly sees."""
    frame_a, picture_a, face_a = view(a, b)
    frame_b, picture_b, face_b = view(b, b)
    clean = sampled_from_one_face(a, b, frame_a.depth_m, face_b)
    found = correspondence(frame_a, frame_b, sky=sky, mask=clean)
    error = found.error(picture_a, picture_b)
    assert error.absolute < ROUNDING
    assert error.squared < ROUNDING
    assert error.share == found.mask.mean() > least_share
    seen = truly_visible(a, b, frame_a.depth_m)
    solid = face_a != NOTHING
    assert (found.mask & solid == seen & clean).all()
    if sky == "rotation":
        assert (found.mask & ~solid).sum() > 100


def test_an_exact_scene_has_no_error():
    check_exact()


def test_neither_has_its_sky():
    check_exact(sky="rotation")


MOTION = st.tuples(*[st.floats(-0.6, 0.6)] * 3)
TURN = st.floats(-0.1, 0.1)


@given(shift_m=MOTION, yaw_rad=TURN, pitch_rad=TURN)
def test_an_exact_scene_has_no_error_from_anywhere(shift_m, yaw_rad, pitch_rad):
    check_exact(b=camera(shift_m, yaw_rad, pitch_rad), sky="rotation", least_share=0.2)


def inverted(monkeypatch: pytest.MonkeyPatch) -> None:
    right = warp._projected

    def wrong(a: Camera, b: Camera, *args: Any) -> Any:
        turned = (
            replace(a, world_from_camera=b.world_from_camera),
            replace(b, world_from_camera=a.world_from_camera),
        )
        return right(*turned, *args)

    monkeypatch.setattr(warp, "_projected", wrong)


def range_for_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    right = warp._depth

    def wrong(name: str, frame: Frame) -> Any:
        return right(name, frame) * np.linalg.norm(directions(frame.camera), axis=-1)

    monkeypatch.setattr(warp, "_depth", wrong)


def everything_is_visible(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp, "_agreeing", lambda corners, *_: np.ones(corners[0].shape[1], bool))


def shifted(columns_px: float, rows_px: float) -> Any:
    def plant(monkeypatch: pytest.MonkeyPatch) -> None:
        right = warp._projected

        def wrong(*args: Any) -> Any:
            columns, rows, z = right(*args)
            return columns + columns_px, rows + rows_px, z

        monkeypatch.setattr(warp, "_projected", wrong)

    return plant


def nearest_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    right = warp._corners
    monkeypatch.setattr(
        warp, "_corners", lambda columns, rows, s: right(np.round(columns), np.round(rows), s)
    )


def rows_for_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    right = warp._corners

    def wrong(*args: Any) -> Any:
        indices, weights = right(*args)
        return indices, weights[[0, 2, 1, 3]]

    monkeypatch.setattr(warp, "_corners", wrong)


FAULTS = {
    "pose inverted": inverted,
    "range for depth": range_for_depth,
    "no occlusion": everything_is_visible,
    "half a pixel": shifted(0.5, 0.5),
    "half a pixel aside": shifted(0.5, 0.0),
    "half a pixel down": shifted(0.0, 0.5),
    "nearest": nearest_pixel,
    "weights swapped": rows_for_columns,
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_a_fault_is_found_out(fault, monkeypatch):
    fault(monkeypatch)
    with pytest.raises(AssertionError):
        check_exact()


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_the_error_itself_tells_of_a_fault(fault, monkeypatch):
    """Not only the mask: a picture of the scene is off by more than its rounding to levels."""
    frame_a, picture_a, _ = view(A, B)
    frame_b, picture_b, face_b = view(B, B)
    clean = sampled_from_one_face(A, B, frame_a.depth_m, face_b)
    right = warp_error(frame_a, frame_b, picture_a, picture_b, mask=clean).absolute
    fault(monkeypatch)
    assert warp_error(frame_a, frame_b, picture_a, picture_b, mask=clean).absolute > right + 1e-4


def test_a_sky_that_is_near_is_found_out(monkeypatch):
    right = warp._projected

    def wrong(a: Camera, b: Camera, depth: Any, pixels: Any, far: Any) -> Any:
        near = np.where(np.isinf(depth), 50.0, depth)
        return right(a, b, near, pixels, np.zeros_like(far))

    monkeypatch.setattr(warp, "_projected", wrong)
    with pytest.raises(AssertionError):
        check_exact(sky="rotation")


@given(seed=st.integers(0, 2**32 - 1))
def test_a_frame_is_its_own_neighbour(seed):
    frame, _, _ = view(A, A)
    picture = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    error = warp_error(frame, frame, picture, picture, sky="rotation")
    assert error.absolute < 1e-6
    # Outlines before the sky are left out, and nothing else.
    assert error.share > 0.97


@given(level=st.integers(0, 255), other=st.integers(0, 255))
def test_the_error_is_in_srgb_from_0_to_1(level, other):
    frame, _, _ = view(A, A)
    a, b = (np.full((48, 64, 3), value, np.uint8) for value in (level, other))
    error = warp_error(frame, frame, a, b)
    off = abs(level - other) / 255
    assert error.absolute == pytest.approx(off)
    assert error.squared == pytest.approx(off**2)
    assert error.contrast == pytest.approx(0)
    as_floats = warp_error(frame, frame, a / 255.0, (b / 255.0).astype(np.float32))
    assert as_floats.absolute == pytest.approx(off, abs=1e-6)


def test_contrast_is_of_the_compared_pixels():
    frame, _, _ = view(A, A)
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, ::2] = 255
    mask = np.zeros((48, 64), bool)
    mask[30:40, 10:50] = True
    error = warp_error(frame, frame, picture, picture, mask=mask)
    assert (error.count, error.share) == (400, 400 / (48 * 64))
    assert error.contrast == pytest.approx(0.5)
    mask[:, 1::2] = False
    assert warp_error(frame, frame, picture, picture, mask=mask).contrast == pytest.approx(0)


def labelled(frame: Frame, faces: Any, name: str) -> Frame:
    label = np.where(faces >= BOX, TRAIN_ID[name], 0).astype(np.uint8)
    return replace(frame, label=label)


@pytest.mark.parametrize("name", ["person", "rider", "car", "train", "bicycle"])
@pytest.mark.parametrize("which", ["a", "b"])
def test_what_a_label_calls_a_mover_is_left_out(name, which):
    """In either frame; and nothing else is, but its outline."""
    (frame_a, _, face_a), (frame_b, _, face_b) = view(A, B), view(B, B)
    everything = correspondence(frame_a, frame_b).mask
    if which == "a":
        frame_a = labelled(frame_a, face_a, name)
    else:
        frame_b = labelled(frame_b, face_b, name)
    found = correspondence(frame_a, frame_b).mask
    on_box = face_a >= BOX
    assert (everything & on_box).sum() > 50
    assert not (found & on_box).any()
    assert (everything & ~on_box & ~found).sum() <= (0 if which == "a" else 40)
    assert (correspondence(frame_a, frame_b, movers=True).mask == everything).all()


def test_what_stands_is_compared():
    (frame_a, _, face_a), (frame_b, _, _) = view(A, B), view(B, B)
    for name in ("building", "sky"):
        found = correspondence(labelled(frame_a, face_a, name), frame_b).mask
        assert (found & (face_a >= BOX)).any() == (name == "building")
    assert TRAIN_ID["sky"] == SKY


def test_what_lies_in_a_box_is_left_out():
    (frame_a, _, face_a), (frame_b, _, _) = view(A, B), view(B, B)
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    pose[:3, 3] = (BOX_LOW_M + BOX_HIGH_M) / 2
    size = (BOX_HIGH_M - BOX_LOW_M) @ pose[:3, :3]
    box = Box(1, "Car", pose, tuple(size))
    everything = correspondence(frame_a, frame_b).mask
    found = correspondence(replace(frame_a, boxes=(box,)), frame_b).mask
    assert (found == everything & (face_a < BOX)).all()
    other = correspondence(frame_a, replace(frame_b, boxes=(box,))).mask
    assert not (other & (face_a >= BOX)).any()
    elsewhere = replace(box, world_from_box=np.eye(4))
    assert (correspondence(replace(frame_a, boxes=(elsewhere,)), frame_b).mask == everything).all()


def test_half_precision_finds_the_same_surfaces():
    (frame_a, picture_a, _), (frame_b, picture_b, _) = view(A, B), view(B, B)
    rounded = [replace(f, depth_m=f.depth_m.astype(np.float16)) for f in (frame_a, frame_b)]
    exact, found = correspondence(frame_a, frame_b), correspondence(*rounded)
    assert (exact.mask != found.mask).mean() < 0.01
    off = found.error(picture_a, picture_b).absolute - exact.error(picture_a, picture_b).absolute
    assert abs(off) < 1e-3


@given(gain=st.floats(0.1, 1.0), shift=st.floats(0, 0.2))
def test_editing_both_alike_scales_the_error(gain, shift):
    """The pixels compared do not depend on the pictures; error and contrast fall together."""
    assume(gain + shift <= 1)
    (frame_a, picture_a, _), (frame_b, picture_b, _) = view(A, B), view(B, B)
    picture_b = np.clip(picture_b[::-1], 0, 1)
    same = correspondence(frame_a, frame_b)
    clear = same.error(picture_a, picture_b)
    edited = same.error(gain * picture_a + shift, gain * picture_b + shift)
    assert edited.count == clear.count
    assert edited.absolute == pytest.approx(gain * clear.absolute)
    assert edited.contrast == pytest.approx(gain * clear.contrast)


def test_nothing_in_common_is_an_error():
    behind = camera(yaw_rad=np.pi)
    (frame_a, picture_a, _), (frame_b, picture_b, _) = view(A, A), view(behind, behind)
    assert correspondence(frame_a, frame_b).count == 0
    with pytest.raises(ArgumentError, match="no common surface"):
        warp_error(frame_a, frame_b, picture_a, picture_b)


def test_results_are_read_only_and_inputs_stay():
    frame_a, _, _ = view(A, A)
    before = frame_a.depth_m.copy()
    found = correspondence(frame_a, frame_a, mask=np.ones((48, 64), bool))
    assert not any(a.flags.writeable for a in (found.pixels_a, found.columns_b, found.rows_b))
    assert (frame_a.depth_m == before).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sky": "above"}, "sky must be"),
        ({"mask": np.ones((4, 4), bool)}, "mask must have"),
        ({"mask": np.ones((48, 64), np.uint8)}, "mask must be a bool"),
        ({"mask": [True]}, "mask must be a bool"),
        ({"image_a": np.zeros((4, 4, 3), np.uint8)}, "image_a must have"),
        ({"image_b": np.zeros((48, 64, 3), np.int32)}, "image_b must be uint8"),
        ({"image_b": np.full((48, 64, 3), 255.0)}, "image_b must be uint8"),
        ({"image_b": np.full((48, 64, 3), np.nan)}, "image_b must be uint8"),
        ({"image_a": [0]}, "image_a must be a numpy array"),
        ({"frame_b": None}, "frame_b must be a Frame"),
    ],
    ids=str,
)
def test_what_does_not_fit_is_refused(change, says):
    frame, _, _ = view(A, A)
    with pytest.raises(ArgumentError, match=says):
        warp_error(**({"frame_a": frame, "frame_b": frame} | change))


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan])
def test_a_depth_that_is_none_is_refused(bad):
    frame, _, _ = view(A, A)
    depth = frame.depth_m.copy()
    depth[3, 4] = bad
    with pytest.raises(ArgumentError, match="above 0 m"):
        warp_error(frame, replace(frame, depth_m=depth))
    with pytest.raises(ArgumentError, match=r"frame_a.*has no depth"):
        warp_error(replace(frame, depth_m=None), frame)


def test_neighbours_of_a_scene_are_steady(tiny_scene: WeatherScene):
    """Over time and between cameras the street is closer to itself than to what it is not."""
    now, right, later = (tiny_scene.frame(key) for key in tiny_scene.keys[:3])
    for other in (right, later):
        error = warp_error(now, other)
        away = warp_error(now, other, image_b=np.ascontiguousarray(other.image[::-1]))
        assert 0 < error.absolute < 0.5 * away.absolute
        assert error.share > 0.15
