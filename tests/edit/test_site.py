"""Where the editor thinks surfaces are and what they are, against a street that is known."""

from dataclasses import replace

import numpy as np
import pytest
from edit_scene import CAMERA_HEIGHT_M, FORWARD, Street, points_of
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.physical import site as module
from weather_aug.edit.physical.site import CELLS_ACROSS, GAP_PX, shrunk, site_of
from weather_aug.taxonomy import IGNORE, ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID, VEGETATION

AXES = np.eye(3)
BUILDING = TRAIN_ID["building"]


def looked_at(frame, height_m=CAMERA_HEIGHT_M):
    return site_of(frame, AXES, height_m)


def tilted_road(slope_ahead, slope_left, above_m=1.4, noise_m=0.0, labelled=True):
    """A road that climbs, and walls of outliers on it."""
    width, height, focal = 200, 120, 160.0
    pose = np.eye(4)
    pose[:3, :3] = FORWARD
    pose[:3, 3] = 100.0, -40.0, 7.0
    intrinsics = np.array([[focal, 0, 99.5], [0, focal, 59.5], [0, 0, 1.0]])
    camera = Camera(intrinsics, pose, width, height)
    v, u = np.mgrid[:height, :width]
    x, y = (u - 99.5) / focal, (v - 59.5) / focal
    climb = -y - slope_ahead + slope_left * x
    depth = np.where(climb < -1e-3, above_m / np.maximum(-climb, 1e-3), np.inf)
    rng = np.random.default_rng(0)
    depth += noise_m * rng.standard_normal(depth.shape)
    # A lorry's shade of wrong depth.
    depth[95:110, 60:90] *= 0.8
    label = np.where(np.isfinite(depth), ROAD, SKY).astype(np.uint8)
    image = np.full((height, width, 3), 100, np.uint8)
    key = FrameKey(0, "front")
    return Frame(key, 0.0, camera, image, label if labelled else None, depth.astype(np.float32))


def check_plane(frame, slope_ahead, slope_left, above_m):
    """The road's plane, from 3 to 30 m ahead, to 4 cm and its slope to 0.003."""
    plane = looked_at(frame).plane
    assert abs(plane[1] - slope_ahead) < 0.003
    assert abs(plane[2] - slope_left) < 0.003
    x, y, z = frame.camera.centre_world
    for ahead in (3.0, 10.0, 30.0):
        true = z - above_m + slope_ahead * ahead
        assert abs(plane[0] + plane[1] * (x + ahead) + plane[2] * y - true) < 0.04 + 0.004 * ahead


ROADS = [(0.0, 0.0), (0.04, 0.0), (0.09, 0.01), (-0.05, 0.02), (-0.07, 0.0), (0.02, -0.04)]


@pytest.mark.parametrize("slopes", ROADS)
@pytest.mark.parametrize("labelled", [True, False])
def test_the_roads_plane_is_found_among_outliers(slopes, labelled):
    check_plane(tilted_road(*slopes, labelled=labelled), *slopes, 1.4)


def test_a_start_from_the_level_alone_is_found(monkeypatch):
    """It never gets to a road that climbs by a tenth."""
    monkeypatch.setattr(module, "SURE_SHARE", 0.0)
    with pytest.raises(AssertionError):
        check_plane(tilted_road(0.09, 0.01), 0.09, 0.01, 1.4)


def test_depth_may_be_noisy():
    check_plane(tilted_road(0.02, 0.0, noise_m=0.05), 0.02, 0.0, 1.4)


def test_a_plain_fit_is_found(monkeypatch):
    """One round and no limit on outliers: the lorry's shade tilts the road."""
    frame = tilted_road(0.03, 0.0)
    monkeypatch.setattr(module, "PLANE_TOLERANCE_M", 9.0)
    with pytest.raises(AssertionError):
        check_plane(frame, 0.03, 0.0, 1.4)


def test_where_too_little_road_is_seen_it_is_level_below_the_camera():
    frame = Street().frame
    frame = replace(frame, label=np.full_like(frame.label, BUILDING))
    np.testing.assert_allclose(looked_at(frame, 2.2).plane, [CAMERA_HEIGHT_M - 2.2, 0, 0])


def check_places(street, within_m=0.01):
    """Of the ground: level to a centimetre; and all offsets are those of the pixels' centres."""
    site = looked_at(street.frame)
    ground = site.is_ground & (site.depth_m < 30)
    assert np.abs(site.height_m[ground]).max() < within_m
    assert np.isposinf(site.height_m[site.small_classes == SKY]).all()
    places = points_of(street.frame) - street.camera.centre_world
    if site.step == 1:
        np.testing.assert_allclose(
            places[np.isfinite(site.depth_m)],
            site.offsets[np.isfinite(site.depth_m)],
            rtol=1e-5,
            atol=1e-4,
        )


TILTS = [{}, {"pitch_deg": -8}, {"roll_deg": 7}, {"yaw_deg": 40, "pitch_deg": 4}]


@pytest.mark.parametrize("view", TILTS)
def test_the_ground_lies_level_however_the_camera_looks(view):
    check_places(Street(**view))


@pytest.mark.parametrize("width", [448, 449, 900])
def test_it_does_so_on_any_grid(width):
    street = Street(width, 140, 0.8 * width, pitch_deg=-5)
    site = looked_at(street.frame)
    assert site.shape[1] <= CELLS_ACROSS
    check_places(street)


def test_rays_half_a_cell_off_are_found(monkeypatch):
    right = module.street_rays

    def shifted(camera, axes, shape, step):
        return right(camera, axes, shape, step) + np.float32([0, 0, 0.5 / camera.focal_px[1]])

    monkeypatch.setattr(module, "street_rays", shifted)
    with pytest.raises(AssertionError):
        check_places(Street(pitch_deg=-5))


def far_from_the_origin(offset):
    """What the editor knows, in a map's coordinates."""
    frame = Street().frame
    pose = frame.camera.world_from_camera.copy()
    pose[:3, 3] += offset
    site = looked_at(replace(frame, camera=replace(frame.camera, world_from_camera=pose)))
    near = looked_at(frame)
    seen = np.isfinite(near.depth_m)
    return np.abs(site.height_m[seen] - near.height_m[seen]).max()


def test_heights_do_not_suffer_from_a_maps_coordinates():
    assert far_from_the_origin((4.5e5, -5.4e6, 300.0)) < 0.002
    # What float32 places would make of them.
    assert abs(np.float32(5.4e6 + 0.2) - 5.4e6 - 0.2) > 0.1


def test_what_is_no_depth_is_far():
    frame = Street().frame
    depth = frame.depth_m.copy()
    depth[-1, :4] = [np.nan, 0.0, -2.0, 7e4]
    site = looked_at(replace(frame, depth_m=depth))
    assert np.isposinf(site.depth_m[-1, :4]).all()
    assert np.isposinf(site.depth_m[site.small_classes == SKY]).all()


def test_half_precision_is_the_same_site():
    single, half = (looked_at(Street(depth_type=t).frame) for t in (np.float32, np.float16))
    np.testing.assert_array_equal(single.classes, half.classes)
    seen = np.isfinite(single.depth_m)
    np.testing.assert_allclose(single.depth_m[seen], half.depth_m[seen], rtol=1e-3)


def test_a_label_is_believed():
    frame = Street().frame
    np.testing.assert_array_equal(frame.label, looked_at(frame).classes)


def test_narrow_gaps_are_closed_and_wide_ones_are_not():
    label = np.full((80, 128), ROAD, np.uint8)
    label[:, 64:] = SIDEWALK
    label[10:14, 20:60] = IGNORE
    label[30:80, 90:128] = IGNORE
    classes = looked_at(replace(Street().frame, label=label)).classes
    assert (classes[10:14, 20:60] == ROAD).all()
    assert (classes[30 + GAP_PX + 1 :, 90 + GAP_PX + 1 :] == IGNORE).all()
    assert (classes[31, 91:] == SIDEWALK).all()
    assert (label[10:14, 20:60] == IGNORE).all()


def check_guess(street, classes):
    """Most of each kind is told without a label."""
    told = street.frame.label
    near = street.frame.depth_m < 25
    kinds = {
        ROAD: (ROAD,),
        SIDEWALK: (ROAD, SIDEWALK),
        TERRAIN: (TERRAIN,),
        VEGETATION: (VEGETATION,),
        BUILDING: (BUILDING,),
        SKY: (SKY,),
    }
    for kind, allowed in kinds.items():
        here = (told == kind) & (near | (kind == SKY))
        assert np.isin(classes[here], allowed).mean() > 0.85, kind


@pytest.mark.parametrize("view", [{}, {"pitch_deg": -6, "roll_deg": 3}])
def test_what_nobody_labelled_is_guessed(view):
    street = Street(road_half_m=1.5, **view)
    check_guess(street, looked_at(replace(street.frame, label=None)).classes)


def test_a_guess_over_a_road_too_deep_is_found(monkeypatch):
    street = Street(road_half_m=1.5)
    right = module._road_plane
    monkeypatch.setattr(module, "_road_plane", lambda *args: right(*args) - [0.5, 0.0, 0.0])
    with pytest.raises(AssertionError):
        check_guess(street, looked_at(replace(street.frame, label=None)).classes)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 7), st.integers(0, 99))
def test_cells_are_means_of_levels(height, width, step, seed):
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    rows, columns = -(-height // step) * step - height, -(-width // step) * step - width
    padded = np.pad(image, ((0, rows), (0, columns), (0, 0)), "edge").astype(float)
    cells = padded.reshape(-(-height // step), step, -(-width // step), step, 3).mean(axis=(1, 3))
    # A level is a whole number.
    np.testing.assert_allclose(cells, shrunk(image, step), atol=0.51)


def test_nothing_given_is_changed():
    frame = Street(labelled=False).frame
    before = frame.image.copy(), frame.depth_m.copy()
    site = looked_at(frame)
    assert site.light is site.light
    np.testing.assert_array_equal(before[0], frame.image)
    np.testing.assert_array_equal(before[1], frame.depth_m)
