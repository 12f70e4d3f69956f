"""Views of a reconstruction: what is where, what it is, and whether anybody ever saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_reconstruction import (
    CAR,
    HALF_WIDTH_M,
    TRACK_ID,
    camera_at,
    tiny_reconstruction,
)

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import draw as module
from weather_aug.gaussians.draw import FIELDS, facings, view
from weather_aug.gaussians.gather import one_thread_of_torch
from weather_aug.gaussians.types import Sky
from weather_aug.taxonomy import BUILDING, IGNORE, ROAD, SKY, VEGETATION

STREET = tiny_reconstruction(styles=("snow",))
CAMERA = camera_at(2.0, 0.3)
TIME_S = 0.3
HERE = view(STREET, CAMERA, TIME_S)
BEHIND_THE_WALL = camera_at(20.0, HALF_WIDTH_M + 5.0, -90.0)


@pytest.fixture(autouse=True)
def one_thread():
    with one_thread_of_torch():
        yield


def rays(camera) -> np.ndarray:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    local = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(rows.shape)], axis=-1)
    return local @ camera.world_from_camera[:3, :3].T


def inside(mask: np.ndarray) -> np.ndarray:
    """Pixels of `mask` with two more of it on each side."""
    kept = mask.copy()
    for axis in (0, 1):
        for step in (-2, -1, 1, 2):
            kept &= np.roll(mask, step, axis)
    kept[:2], kept[-2:], kept[:, :2], kept[:, -2:] = False, False, False, False
    return kept


def test_every_surface_has_its_class_depth_and_normal():
    towards = rays(CAMERA)
    _, y, z = CAMERA.centre_world
    fine = view(tiny_reconstruction(spacing_m=0.2), CAMERA, TIME_S)
    surfaces = {
        ROAD: (2, -z, (0, 0, 1)),
        BUILDING: (1, HALF_WIDTH_M - y, (0, -1, 0)),
        VEGETATION: (1, -HALF_WIDTH_M - y, (0, 1, 0)),
    }
    for train_id, (axis, distance, normal) in surfaces.items():
        with np.errstate(divide="ignore"):
            depth = distance / towards[..., axis]
        sure = inside(HERE.label == train_id) & (depth < 15)
        assert sure.sum() > 100
        # A mean over Gaussians 0.24 m wide.
        assert np.abs(fine.depth_m[sure] / depth[sure] - 1).max() < 0.08
        assert (HERE.normals_world[sure] @ np.array(normal)).min() > 0.99
    sky = inside(HERE.label == SKY)
    assert sky.sum() > 100
    assert np.isinf(HERE.depth_m[sky]).all()
    assert not HERE.normals_world[sky].any()
    assert HERE.opacity[sky].max() < 0.5
    assert HERE.seen.all()


def test_types_and_shapes_are_those_promised():
    shape = (CAMERA.height, CAMERA.width)
    assert (HERE.image.dtype, HERE.image.shape) == (np.uint8, (*shape, 3))
    assert (HERE.depth_m.dtype, HERE.depth_m.shape) == (np.float32, shape)
    assert (HERE.label.dtype, HERE.label.shape) == (np.uint8, shape)
    assert (HERE.seen.dtype, HERE.seen.shape) == (np.bool_, shape)
    assert (HERE.opacity.dtype, HERE.opacity.shape) == (np.float32, shape)
    assert (HERE.normals_world.dtype, HERE.normals_world.shape) == (np.float32, (*shape, 3))
    lengths = np.linalg.norm(HERE.normals_world, axis=2)
    assert (np.isclose(lengths, 1, atol=1e-5) | (lengths == 0)).all()


def test_without_a_car_the_picture_is_that_of_a_street_without_it():
    assert (HERE.label == CAR).sum() > 50
    left_out = view(STREET, CAMERA, TIME_S, without=(TRACK_ID,))
    empty = view(tiny_reconstruction(car=False), CAMERA, TIME_S)
    for one, other in zip(left_out, empty, strict=True):
        np.testing.assert_array_equal(one, other)
    behind = left_out.label[HERE.label == CAR]
    assert not (behind == CAR).any()
    assert set(np.unique(behind)) <= {ROAD, SKY, BUILDING, VEGETATION}


def test_a_car_put_to_the_left_is_seen_at_the_left():
    pose = STREET.actors[0].world_from_actor[0].copy()
    pose[1, 3] = 2.5
    moved = view(STREET, CAMERA, TIME_S, poses={TRACK_ID: pose})
    middle = (CAMERA.width - 1) / 2
    assert np.nonzero(HERE.label == CAR)[1].min() > middle - 5
    assert np.nonzero(moved.label == CAR)[1].max() < middle


def test_a_style_has_amounts():
    def image(**arguments):
        return view(STREET, CAMERA, TIME_S, want=("image",), **arguments).image

    own, snow = image(), image(style="snow")
    np.testing.assert_array_equal(own, image(style="snow", amount=0.0))
    np.testing.assert_array_equal(snow, image(style={"snow": 1.0}))
    np.testing.assert_array_equal(image(style="snow", amount=0.5), image(style={"snow": 0.5}))
    half = image(style="snow", amount=0.5).astype(int)
    low, high = np.minimum(own, snow).astype(int), np.maximum(own, snow).astype(int)
    assert ((half >= low - 1) & (half <= high + 1)).all()
    assert np.abs(2 * half - own - snow).max() <= 3
    assert snow.mean() > own.mean() + 40


def test_the_wall_seen_from_outside_was_never_seen(monkeypatch):
    outside = view(STREET, BEHIND_THE_WALL, TIME_S)
    wall = inside(outside.label == BUILDING)
    assert wall.sum() > 500
    assert not outside.seen[wall].any()
    # Who asks only whether a Gaussian was ever seen takes the wall's back for its front.
    monkeypatch.setattr(module, "facings", lambda r: np.zeros_like(r.background.means_m))
    assert view(STREET, BEHIND_THE_WALL, TIME_S).seen[wall].all()


def test_a_little_beside_the_recorded_way_everything_is_seen():
    for camera in (camera_at(3.0, 1.5, 8.0), camera_at(3.0, -1.5, -8.0)):
        shot = view(STREET, camera, TIME_S)
        assert shot.seen.mean() > 0.99


def test_gaussians_that_made_up_nothing_were_not_seen():
    is_left = STREET.background.means_m[:, 1] > HALF_WIDTH_M - 0.1
    shot = view(
        replace(STREET, support=np.where(is_left, 0.2, STREET.support).astype(np.float32)),
        CAMERA,
        TIME_S,
    )
    assert not shot.seen[inside(HERE.label == BUILDING)].any()
    assert shot.seen[inside(HERE.label == ROAD)].all()


def test_sky_that_no_frame_showed_is_neither_seen_nor_labelled():
    dark = replace(STREET, sky=Sky(STREET.sky.faces, np.zeros_like(STREET.sky.seen)))
    shot = view(dark, CAMERA, TIME_S)
    sky = inside(HERE.label == SKY)
    assert not shot.seen[sky].any()
    assert (shot.label[sky] == IGNORE).all()
    np.testing.assert_array_equal(HERE.image, shot.image)


def test_a_class_that_few_vote_for_is_not_named():
    scores = STREET.background.class_scores.astype(np.float32)
    split = replace(STREET.background, class_scores=0.3 * scores)
    shot = view(replace(STREET, background=split), CAMERA, TIME_S, want=("label",))
    assert (shot.label[inside(HERE.label == ROAD)] == IGNORE).all()
    assert (shot.label[inside(HERE.label == CAR)] == CAR).all()


def test_facings_turn_to_where_the_cameras_were():
    means, towards = STREET.background.means_m, facings(STREET)
    known = (towards != 0).any(axis=1)
    assert known.mean() > 0.5
    left, right = (means[:, 1] * side > HALF_WIDTH_M - 0.1 for side in (1, -1))
    assert (towards[known & left, 1] < 0).all()
    assert (towards[known & right, 1] > 0).all()
    assert (towards[known & ~left & ~right, 2] > 0).all()


def test_an_exposure_is_applied_when_a_frame_is_named():
    matrix = np.array([[0.8, 0, 0, 0.1], [0, 0.9, 0, 0], [0, 0.1, 0.7, 0]], np.float32)
    keys = [FrameKey(0, "front"), FrameKey(5, "front")]
    exposures = {keys[0]: np.eye(3, 4, dtype=np.float32), keys[1]: matrix}
    street = replace(STREET, exposures=exposures)

    def image(key):
        return view(street, CAMERA, TIME_S, key=key, want=("image",)).image

    own = image(None)
    np.testing.assert_array_equal(own, image(keys[0]))
    expected = own @ matrix[:, :3].T + 255 * matrix[:, 3]
    assert np.abs(image(keys[1]) - expected).max() <= 1.5
    np.testing.assert_array_equal(image(keys[1]), image(FrameKey(4, "front")))


@pytest.mark.parametrize("field", FIELDS)
def test_a_field_alone_has_the_bytes_that_it_has_among_others(field):
    alone = view(STREET, CAMERA, TIME_S, want=(field,))
    names = {"depth": "depth_m", "normals": "normals_world"}
    for name, one, other in zip(alone._fields, alone, HERE, strict=True):
        if name in ("opacity", names.get(field, field)):
            np.testing.assert_array_equal(one, other)
        else:
            assert one is None


def test_threads_do_not_matter():
    for one, other in zip(HERE, view(STREET, CAMERA, TIME_S, threads=2), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_nothing_is_known_of_is_none():
    background, shells = (
        replace(part, class_scores=np.zeros((len(part), 0), np.float16))
        for part in (STREET.background, STREET.actor_gaussians)
    )
    bare = replace(
        STREET, background=background, actor_gaussians=shells, support=np.zeros(0, np.float32)
    )
    shot = view(bare, CAMERA, TIME_S)
    assert shot.label is None
    assert shot.seen is None
    np.testing.assert_array_equal(HERE.image, shot.image)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"want": ("image", "colour")}, "got 'colour'"),
        ({"want": "image"}, "collection"),
        ({"key": FrameKey(0, "rear")}, "no exposure of camera 'rear' is known"),
        ({"style": "rain"}, "style 'rain' is unknown"),
        ({"without": (3,)}, "track 3"),
    ],
)
def test_what_is_unknown_is_refused(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        view(STREET, CAMERA, TIME_S, **arguments)
