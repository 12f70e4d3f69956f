"""Viewpoints: where a moved camera stands, and that draws hang on their key alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_clip import TinyClip

from weather_aug._keys import key_of
from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene import viewpoint as viewpoints
from weather_aug.scene.viewpoint import LIMITS, Viewpoint, ViewpointJitter, moved

AXES = np.eye(3)
ANGLES = st.floats(-180, 180)
LENGTHS = st.floats(-100, 100)
ANY = st.builds(Viewpoint, LENGTHS, LENGTHS, LENGTHS, ANGLES, ANGLES, ANGLES)


@pytest.fixture
def camera(tiny_clip: TinyClip) -> Camera:
    """Looks along x; left is y, up is z. It turns to the left."""
    front = tiny_clip.frame(FrameKey(1, "front")).camera
    return replace(front, angular_velocity_rad_per_s=np.array([0.0, -0.5, 0.0]))


def turned_pose(camera: Camera) -> tuple[Any, Any, Any]:
    """Right, top and view in world axes."""
    rotation = camera.world_from_camera[:3, :3]
    return rotation[:, 0], -rotation[:, 1], rotation[:, 2]


def test_no_move_gives_the_same_camera(camera: Camera) -> None:
    assert moved(camera, AXES, Viewpoint()) is camera


def test_places_are_to_the_left_up_and_ahead_of_a_level_heading(camera: Camera) -> None:
    there = moved(camera, AXES, Viewpoint(lateral_m=1.5, height_m=0.5, forward_m=2.0))
    assert np.allclose(there.centre_world - camera.centre_world, (2.0, 1.5, 0.5))
    assert (there.world_from_camera[:3, :3] == camera.world_from_camera[:3, :3]).all()
    assert (there.intrinsics == camera.intrinsics).all()


def test_the_heading_is_the_cameras_own_and_level(tiny_clip: TinyClip) -> None:
    right = tiny_clip.frame(FrameKey(0, "right")).camera
    tilted = moved(right, AXES, Viewpoint(pitch_deg=40.0))
    there = moved(tilted, AXES, Viewpoint(forward_m=1.0))
    expected = (np.cos(np.radians(30)), -np.sin(np.radians(30)), 0.0)
    assert np.allclose(there.centre_world - right.centre_world, expected)


@pytest.mark.parametrize(
    ("viewpoint", "right", "top", "view"),
    [
        (Viewpoint(yaw_deg=90), (1, 0, 0), (0, 0, 1), (0, 1, 0)),
        (Viewpoint(pitch_deg=90), (0, -1, 0), (-1, 0, 0), (0, 0, 1)),
        (Viewpoint(roll_deg=90), (0, 0, -1), (0, -1, 0), (1, 0, 0)),
        (Viewpoint(yaw_deg=90, pitch_deg=90), (1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ],
    ids=["yaw to the left", "pitch upwards", "roll clockwise", "yaw, then pitch"],
)
def test_turns_go_the_written_way(
    camera: Camera, viewpoint: Viewpoint, right: Any, top: Any, view: Any
) -> None:
    there = moved(camera, AXES, viewpoint)
    assert np.allclose(turned_pose(there), (right, top, view))
    assert np.allclose(there.centre_world, camera.centre_world)


def test_a_wrong_turn_is_noticed(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check above fails for a rotation that turns the other way."""
    right_way = viewpoints._turned
    monkeypatch.setattr(viewpoints, "_turned", lambda axis, deg: right_way(axis, -deg))
    there = moved(camera, AXES, Viewpoint(yaw_deg=90))
    assert not np.allclose(turned_pose(there)[2], (0, 1, 0))


def test_a_camera_that_looks_straight_down_moves_towards_its_top(camera: Camera) -> None:
    down = moved(camera, AXES, Viewpoint(pitch_deg=-90))
    there = moved(down, AXES, Viewpoint(forward_m=1.0, lateral_m=2.0))
    assert np.allclose(there.centre_world - camera.centre_world, (1.0, 2.0, 0.0))


def test_it_is_carried_by_the_same_turning_car(camera: Camera) -> None:
    """0.5 rad/s to the left, 2 m to the left of the centre: 1 m/s slower. The turn is the same."""
    there = moved(camera, AXES, Viewpoint(lateral_m=2.0, yaw_deg=90))
    assert np.allclose(there.velocity_m_per_s, camera.velocity_m_per_s - (1.0, 0.0, 0.0))
    spin = there.world_from_camera[:3, :3] @ there.angular_velocity_rad_per_s
    assert np.allclose(spin, (0.0, 0.0, 0.5))


@given(viewpoint=ANY)
def test_every_viewpoint_is_a_rigid_motion_at_its_distance(viewpoint: Viewpoint) -> None:
    camera = TinyClip().frame(FrameKey(0, "right")).camera
    there = moved(camera, AXES, viewpoint)
    length = np.linalg.norm([viewpoint.lateral_m, viewpoint.height_m, viewpoint.forward_m])
    assert np.isclose(np.linalg.norm(there.centre_world - camera.centre_world), length)
    rotation = there.world_from_camera[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert Viewpoint.from_dict(viewpoint.to_dict()) == viewpoint


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize("value", [float("nan"), 1e3, "1", None])
def test_numbers_out_of_their_limits_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ArgumentError, match=name):
        Viewpoint(**{name: value})


@given(seed=st.integers(0, 2**40), item=st.integers(0, 2**40))
def test_draws_hang_on_the_key_and_stay_in_range(seed: int, item: int) -> None:
    jitter = ViewpointJitter(lateral_m=1.5, height_m=(0.1, 0.2), yaw_deg=(-3, 3), roll_deg=1)
    key = key_of("viewpoint", seed, 0, item)
    drawn = jitter.draw(key)
    assert drawn == jitter.draw(key)
    assert drawn != jitter.draw(key_of("viewpoint", seed, 1, item))
    assert -1.5 <= drawn.lateral_m <= 1.5
    assert 0.1 <= drawn.height_m <= 0.2
    assert drawn.forward_m == 0
    wider = replace(jitter, lateral_m=3.0).draw(key)
    assert replace(wider, lateral_m=drawn.lateral_m) == drawn
    assert np.isclose(wider.lateral_m, 2 * drawn.lateral_m)


def test_draws_fill_their_range() -> None:
    drawn = [ViewpointJitter(lateral_m=2.0).draw(key_of("v", i)).lateral_m for i in range(400)]
    assert abs(np.mean(drawn)) < 0.2
    assert np.isclose(np.std(drawn), 4 / np.sqrt(12), rtol=0.1)


@pytest.mark.parametrize(
    "value", [(1.0, -1.0), (0.0, np.inf), -1.0, (1.0,), (0.0, 1.0, 2.0), "wide", None, (0, 1e4)]
)
def test_ranges_that_are_none_are_refused(value: Any) -> None:
    with pytest.raises(ArgumentError, match="height_m"):
        ViewpointJitter(height_m=value)


def test_jitter_comes_back_from_json_values() -> None:
    jitter = ViewpointJitter(lateral_m=2, pitch_deg=(-1, 3))
    assert ViewpointJitter.from_dict(jitter.to_dict()) == jitter
    with pytest.raises(ArgumentError, match="no field sideways_m"):
        ViewpointJitter.from_dict({"sideways_m": 1})
    with pytest.raises(ArgumentError, match="Viewpoint is read from an object"):
        Viewpoint.from_dict([1, 2])  # type: ignore[arg-type]
