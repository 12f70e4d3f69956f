"""Where snow can settle and where wheels run, against places that are known."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from edit_scene import CAMERA_HEIGHT_M, Street, points_of
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.edit.physical import settling
from weather_aug.edit.physical.settling import FARTHEST_SIDE_M, facing_up, lateral_m
from weather_aug.edit.physical.site import site_of
from weather_aug.taxonomy import ROAD, SKY, TRAIN_ID

AXES = np.eye(3)
ROOF = ("car", (5.0, 12.0), (-2.0, 2.0), (0.0, 0.7))
WALL = ("building", (10.0, 12.0), (-9.0, 9.0), (0.0, 8.0))


def site(**view):
    return site_of(Street(**view).frame, AXES, CAMERA_HEIGHT_M)


def inside(mask):
    """Without its border: maps are blurred by a cell."""
    padded = np.pad(mask, 2)
    shifts = [np.roll(padded, (y, x), (0, 1)) for y in (-2, 0, 2) for x in (-2, 0, 2)]
    return np.logical_and.reduce(shifts)[2:-2, 2:-2]


def check_facing(function, **view):
    """Ground and roofs are level, walls are not, the sky holds nothing."""
    here = site(boxes=(ROOF, WALL), **view)
    up = function(here)
    points = points_of(here.frame)
    kinds = here.frame.label
    roof = inside((kinds == TRAIN_ID["car"]) & (np.abs(points[..., 2] - 0.7) < 1e-3))
    side = inside((kinds == TRAIN_ID["car"]) & (points[..., 2] < 0.6))
    wall = inside(kinds == TRAIN_ID["building"])
    assert roof.sum() > 20
    assert side.sum() > 20
    assert (up[roof] > 0.8).all()
    assert (up[side] < 0.3).all()
    assert (up[wall] < 0.3).all()
    assert (up[inside(kinds == ROAD)] == 1).all()
    assert (up[inside(kinds == SKY)] == 0).all()
    assert up.min() >= 0
    assert up.max() <= 1


@pytest.mark.parametrize("view", [{}, {"pitch_deg": -10}, {"roll_deg": 8}])
def test_roofs_are_level_and_walls_are_not(view):
    check_facing(facing_up, width=256, height=160, focal_px=200.0, **view)


def test_another_up_is_found():
    def leaning(here):
        return facing_up(replace(here, axes_world=np.roll(AXES, 1, axis=0)))

    with pytest.raises(AssertionError):
        check_facing(leaning, width=256, height=160, focal_px=200.0)


def test_it_is_the_same_in_a_maps_coordinates():
    frame = Street(boxes=(ROOF, WALL)).frame
    pose = frame.camera.world_from_camera.copy()
    pose[:3, 3] += (4.5e5, -5.4e6, 300.0)
    far = replace(frame, camera=replace(frame.camera, world_from_camera=pose))
    maps = [facing_up(site_of(f, AXES, CAMERA_HEIGHT_M)) for f in (frame, far)]
    np.testing.assert_allclose(*maps, atol=1e-6)


def check_sides(function, here, path, truth):
    """Metres left of the way, of the road's pixels within 30 m."""
    near = (here.small_classes == ROAD) & (here.depth_m < 30)
    points = points_of(here.frame)[near]
    np.testing.assert_allclose(truth(points), function(here, path)[near], atol=0.02)


STRAIGHT = np.array([[-5.0, 0.5], [0.0, 0.5], [9.0, 0.5]])


def test_left_of_a_straight_way_counts_as_it_should():
    check_sides(lateral_m, site(), STRAIGHT, lambda p: p[:, 1] - 0.5)


def test_the_other_side_is_found():
    def mirrored(here, path):
        return -lateral_m(here, path)

    with pytest.raises(AssertionError):
        check_sides(mirrored, site(), STRAIGHT, lambda p: p[:, 1] - 0.5)


def test_a_bend_is_followed():
    turn = np.linspace(-0.4, 1.2, 200)
    radius = 30.0
    path = np.column_stack([radius * np.sin(turn), radius * (1 - np.cos(turn))])

    def truth(points):
        return radius - np.hypot(points[:, 0], points[:, 1] - radius)

    check_sides(lateral_m, site(road_half_m=6.0), path, truth)
    with pytest.raises(AssertionError):
        check_sides(lateral_m, site(road_half_m=6.0), path[[0, -1]], truth)


@pytest.mark.parametrize(
    "path",
    [None, np.zeros((0, 2)), np.zeros((1, 2)), np.full((6, 2), 3.0)],
    ids=["unknown", "empty", "one place", "parked"],
)
@pytest.mark.parametrize("yaw_deg", [0.0, 20.0])
def test_who_has_not_driven_looks_where_the_way_goes(path, yaw_deg):
    yaw = np.radians(yaw_deg)
    here = site(yaw_deg=yaw_deg, boxes=())
    check_sides(lateral_m, here, path, lambda p: np.cos(yaw) * p[:, 1] - np.sin(yaw) * p[:, 0])


def test_standing_still_on_the_way_changes_nothing():
    halted = np.repeat(STRAIGHT, [3, 1, 2], axis=0)
    np.testing.assert_array_equal(lateral_m(site(), STRAIGHT), lateral_m(site(), halted))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-40, 40), st.floats(-40, 40)), min_size=2, max_size=6))
def test_the_distance_is_that_of_the_nearest_point_of_the_way(corners):
    path = np.array(corners)
    if not (np.hypot(*np.diff(path, axis=0).T) > 0.5).all():
        return
    places = np.stack(np.meshgrid(np.linspace(-30, 30, 9), np.linspace(-30, 30, 9)), -1)
    ends = [
        path[:1] + 200 * _unit(path[0] - path[1]),
        path,
        path[-1:] + 200 * _unit(path[-1] - path[-2]),
    ]
    nodes = np.concatenate(ends)
    dense = np.concatenate(
        [a + np.linspace(0, 1, 1500)[:, None] * (b - a) for a, b in pairwise(nodes)]
    )
    brute = np.hypot(*(places[..., None, :] - dense).transpose(3, 0, 1, 2)).min(-1)
    found = np.abs(settling._signed_distance(places, path))
    np.testing.assert_allclose(np.minimum(brute, FARTHEST_SIDE_M), found, atol=0.1)


def _unit(step):
    return step / np.hypot(*step)


def test_nothing_is_farther_than_the_map_can_hold():
    here = site(boxes=(), width=256, focal_px=60.0)
    side = lateral_m(here, None)
    assert side.dtype == np.float32
    assert np.abs(side).max() <= FARTHEST_SIDE_M
    assert np.isfinite(side).all()


def test_normals_keep_a_rough_depth_from_making_ledges_of_a_wall():
    """As of Gaussians drawn from elsewhere; without the normals the wall would hold snow."""
    frame = Street(boxes=(ROOF, WALL), width=256, height=160, focal_px=200.0).frame
    rough = frame.depth_m * (
        1 + 0.02 * np.random.default_rng(0).standard_normal(frame.depth_m.shape)
    )
    rough = replace(frame, depth_m=rough.astype(np.float32))
    kinds, points = frame.label, points_of(frame)
    wall = inside(kinds == TRAIN_ID["building"])
    roof = inside((kinds == TRAIN_ID["car"]) & (np.abs(points[..., 2] - 0.7) < 1e-3))
    normals = np.zeros((*kinds.shape, 3), np.float32)
    normals[..., 2] = 1.0
    normals[kinds == TRAIN_ID["building"]] = (-1.0, 0.0, 0.0)

    def up(of):
        return facing_up(site_of(of, AXES, CAMERA_HEIGHT_M))

    assert up(rough)[wall].mean() > 0.3
    assert up(replace(rough, normals_world=normals))[wall].max() < 1e-3
    # Where they agree, nothing changes.
    assert (up(replace(frame, normals_world=normals))[roof] > 0.8).all()
