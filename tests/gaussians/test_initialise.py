"""Where a fit starts: as many Gaussians as asked for, on the surfaces that stand still."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import moving_street
import numpy as np
import pytest
import torch
from box_street import FACADES, BoxStreet
from moving_street import BLUE, CAR, PARKED, RED, SIZE_M
from tiny_clip import TinyClip

from weather_aug.clip.kitti import KittiOdometryClip
from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import Box, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import initialise
from weather_aug.gaussians.harmonics import colours_seen
from weather_aug.gaussians.initialise import (
    actor_points,
    initial_gaussians,
    moving_tracks,
    scene_radius_m,
)
from weather_aug.gaussians.pool import Pool
from weather_aug.gaussians.rasterise import Drawn, rasterise
from weather_aug.gaussians.types import Gaussians, Pinhole
from weather_aug.taxonomy import SKY

KITTI = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "kitti-odom02-stereo20"
FIELDS = ("means_m", "quaternions", "log_scales", "logit_opacities", "sh")


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    clip = StreetClip(frames=7, width=160, height=96)
    return [clip.frame(FrameKey(t, "front")) for t in (0, 2, 4, 6)]


def same(one: Gaussians, other: Gaussians) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


def colours_of(gaussians: Gaussians) -> np.ndarray:
    return 0.5 + 0.28209479177387814 * gaussians.sh[:, 0]


def rotations_of(quaternions: np.ndarray) -> np.ndarray:
    w, x, y, z = quaternions.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def drawn(gaussians: Gaussians, frame: Frame) -> Drawn:
    pool = Pool.of(gaussians)
    camera, means = frame.camera, pool.parameters["means_m"]
    with torch.no_grad():
        return rasterise(
            means,
            pool.parameters["quaternions"],
            pool.scales_m,
            pool.opacities,
            colours_seen(pool.sh, means, torch.tensor(camera.centre_world, dtype=torch.float32)),
            torch.tensor(np.linalg.inv(camera.world_from_camera), dtype=torch.float32),
            Pinhole.of(camera),
        )


@pytest.mark.parametrize("count", [1, 100, 3000, 12_000])
def test_the_count_is_met(street: list[Frame], count: int) -> None:
    assert len(initial_gaussians(street, count=count, seed=1)) == count


def test_there_are_no_more_than_pixels_of_surface(street: list[Frame]) -> None:
    one = street[:1]
    got = len(initial_gaussians(one, count=10**6, seed=1))
    assert 0.8 < got / np.isfinite(one[0].depth_m).sum() <= 1


def test_the_order_of_frames_does_not_matter_and_the_seed_does(street: list[Frame]) -> None:
    first = initial_gaussians(street, count=2000, seed=1)
    mixed = list(street)
    random.Random(0).shuffle(mixed)
    assert same(first, initial_gaussians(mixed, count=2000, seed=1))
    assert not same(first, initial_gaussians(street, count=2000, seed=2))


def test_all_lie_in_some_picture_that_shows_surface_there(street: list[Frame]) -> None:
    means = initial_gaussians(street, count=3000, seed=0).means_m
    shown = np.zeros(len(means), bool)
    for frame in street:
        camera = frame.camera
        local = (means - camera.centre_world) @ camera.world_from_camera[:3, :3]
        pixels = local @ camera.intrinsics.T
        column, row = np.rint(pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-6)).astype(int).T
        seen = (local[:, 2] > 0.3) & (0 <= row) & (row < 96) & (0 <= column) & (column < 160)
        assert frame.depth_m is not None
        depth = frame.depth_m[np.where(seen, row, 0), np.where(seen, column, 0)]
        # A cell's mean may be a pixel off its surface's edge.
        shown |= seen & (np.abs(depth - local[:, 2]) < 0.2 * local[:, 2])
    assert shown.mean() > 0.97


def test_a_picture_from_between_looks_like_the_street(street: list[Frame]) -> None:
    given = [street[0], street[1], street[3]]
    sharp = initial_gaussians(given, count=12_000, seed=0, opacity=0.9)
    held, picture = street[2], drawn(sharp, street[2])
    surface = held.label != SKY
    assert float(picture.opacity.numpy()[surface].mean()) > 0.9
    error = (picture.colours.numpy() - held.image / 255.0)[surface]
    assert -10 * np.log10((error**2).mean()) > 17
    solid = surface & (picture.opacity.numpy() > 0.9) & np.isfinite(held.depth_m)
    ratio = picture.depth_m.numpy()[solid] / np.asarray(held.depth_m, np.float64)[solid]
    assert abs(np.median(ratio) - 1) < 0.04


def test_gaussians_lie_flat_in_road_and_walls_and_are_as_large_as_their_cells() -> None:
    frames = [BoxStreet(boxes=FACADES).frame(FrameKey(t, "front")) for t in range(3)]
    found = initial_gaussians(frames, count=4000, seed=0)
    thin = np.argmin(found.log_scales, axis=1)
    normals = rotations_of(found.quaternions)[np.arange(len(thin)), :, thin]
    assert np.allclose(np.linalg.det(rotations_of(found.quaternions)), 1)
    x, y, z = found.means_m.T
    road = (np.abs(z) < 0.01) & (np.abs(y) < 8) & (x < 30)
    wall = (np.abs(np.abs(y) - 9) < 0.01) & (z > 0.5) & (x > 51) & (x < 67)
    for plane, axis in ((road, 2), (wall, 1)):
        assert plane.sum() > 100
        assert np.median(np.abs(normals[plane, axis])) > 0.99
    sizes = np.exp(found.log_scales)
    assert (sizes.max(axis=1) / sizes.min(axis=1)).max() < 10.01
    # In the picture that sees them best, those near by are as round as cells, but for thickness.
    near = road & (x > 17) & (x < 22) & (np.abs(y) < 0.5 * (x - 10))
    local = found.means_m[near] - frames[2].camera.centre_world
    right, down, depth = (local @ frames[2].camera.world_from_camera[:3, :3]).T
    zero, focal = np.zeros_like(depth), frames[2].camera.focal_px[0]
    rows = [[focal / depth, zero, -focal * right / depth**2]]
    rows += [[zero, focal / depth, -focal * down / depth**2]]
    slopes = np.moveaxis(np.array(rows), -1, 0) @ frames[2].camera.world_from_camera[:3, :3].T
    drawn_px = slopes @ rotations_of(found.quaternions[near]) * sizes[near][:, None]
    covariance = drawn_px @ np.swapaxes(drawn_px, 1, 2)
    assert covariance[:, 0, 0].std() < 0.05 * covariance[:, 0, 0].mean()
    assert (np.abs(covariance[:, 0, 1]) < 0.1 * covariance[:, 0, 0]).all()
    ratio = covariance[:, 1, 1] / covariance[:, 0, 0]
    assert ratio.min() > 0.95 and ratio.max() < 2.05


def test_skies_have_no_gaussians_and_far_things_stand_on_a_shell() -> None:
    frame = BoxStreet(boxes=FACADES).frame(FrameKey(0, "front"))
    assert frame.label is not None and frame.depth_m is not None
    label, depth = frame.label.copy(), frame.depth_m.copy()
    above = (frame.label == SKY) & (np.mgrid[:180, :320][0] > 20)
    label[above] = 8
    found = initial_gaussians([replace(frame, label=label)], count=3000, seed=0)
    far = found.means_m[:, 0] > 299
    assert far.sum() > 50
    bare = initial_gaussians([frame], count=3000, seed=0)
    assert not ((bare.means_m[:, 2] > 5) & (bare.means_m[:, 0] > 150)).any()
    assert np.isinf(depth[above]).all()


def is_coloured(gaussians: Gaussians, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(colours_of(gaussians) - np.array(colour) / 255) < 0.15).all(axis=1)


def test_what_moves_is_left_out_and_what_stands_is_not() -> None:
    frames = moving_street.frames()
    assert moving_tracks(frames) == {CAR}
    found = initial_gaussians(frames, count=20_000, seed=0)
    assert is_coloured(found, BLUE).sum() > 100
    assert not is_coloured(found, RED).any()
    ghosts = initial_gaussians(frames, count=20_000, seed=0, left_out=())
    assert is_coloured(ghosts, RED).sum() > 100
    neither = initial_gaussians(frames, count=20_000, seed=0, left_out={CAR, PARKED})
    assert not is_coloured(neither, BLUE).any()


@pytest.mark.parametrize("labelled", [True, False])
def test_points_of_an_actor_lie_on_its_own_hull(labelled: bool) -> None:
    frames = moving_street.frames(labelled=labelled)
    found = actor_points(frames, CAR, count=600)
    assert 200 < len(found) <= 600 and same(found, actor_points(frames[::-1], CAR, count=600))
    share = np.abs(found.means_m) / (0.5 * np.array(SIZE_M))
    assert share.max() <= 1.05
    red = is_coloured(found, RED)
    assert red.all() if labelled else red.mean() > 0.8
    # A thing driven away from shows its back.
    assert (found.means_m[red, 0] < 0).mean() > 0.5
    assert (np.abs(share[red].max(axis=1) - 1) < 0.03).mean() > 0.95


def test_an_actors_box_of_another_moment_smears_it() -> None:
    frames = moving_street.frames(3, speed_m=4.0)
    still = [replace(frame, boxes=frames[0].boxes) for frame in frames]
    on_hull = []
    for given in (frames, still):
        share = np.abs(actor_points(given, CAR).means_m) / (0.5 * np.array(SIZE_M))
        on_hull.append((np.abs(share.max(axis=1) - 1) < 0.03).mean())
    assert on_hull[0] > 0.95 > 0.8 > on_hull[1]


def test_actors_nobody_saw() -> None:
    frames = moving_street.frames(2)
    pose = np.eye(4)
    pose[:3, 3] = (-30, 0, 1)
    hidden = [replace(frame, boxes=(Box(3, "Car", pose, SIZE_M),)) for frame in frames]
    assert len(actor_points(hidden, 3)) == 0
    with pytest.raises(ArgumentError, match="track_id 99 is in no frame"):
        actor_points(frames, 99)


def test_tracks_of_one_moment_move_by_their_velocity() -> None:
    frame = moving_street.frames(1)[0]
    fast, slow = (
        replace(frame.boxes[0], track_id=track, velocity_m_per_s=np.array([speed, 0, 0]))
        for track, speed in ((1, 3.0), (2, 0.5))
    )
    assert moving_tracks([replace(frame, boxes=(fast, slow, *frame.boxes))]) == {1}
    assert moving_tracks(moving_street.frames(6, speed_m=0.15)) == frozenset()


def test_the_radius_is_how_far_away_things_are() -> None:
    one, long = (
        [BoxStreet(boxes=FACADES).frame(FrameKey(t, "front")) for t in range(n)] for n in (1, 6)
    )
    depth = np.asarray(one[0].depth_m)
    expected = np.median(depth[depth <= 80])
    assert scene_radius_m(one) == pytest.approx(expected, rel=0.1)
    assert scene_radius_m(long) == pytest.approx(expected, rel=0.2)


def test_quaternions_turn_as_their_matrices_do() -> None:
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.standard_normal((200, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    halves = np.array([np.diag(d) for d in ((1.0, -1, -1), (-1, 1, -1), (-1, -1, 1), (1, 1, 1))])
    for rotations in (turns, halves):
        assert np.allclose(rotations_of(initialise._quaternions(rotations)), rotations, atol=1e-12)


def test_every_nth_pixel_of_long_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [BoxStreet(boxes=FACADES).frame(FrameKey(t, "front")) for t in range(3)]
    monkeypatch.setattr(initialise, "MAX_PIXELS", 30_000)
    found = initial_gaussians(frames, count=1500, seed=0, opacity=0.9)
    assert len(found) == 1500
    surface = frames[2].label != SKY
    assert float(drawn(found, frames[2]).opacity.numpy()[surface].mean()) > 0.85


def test_what_cannot_be_started_from_is_refused() -> None:
    frame = TinyClip().frame(FrameKey(0, "front"))
    blind = replace(frame, depth_m=None)
    sky = replace(frame, label=None, depth_m=np.full((48, 64), np.inf, np.float32))
    assert len(initial_gaussians([frame, blind], count=100, seed=0, sh_degree=3)) == 100
    cases = [
        (lambda: initial_gaussians([blind], count=9, seed=0), "carry no depth"),
        (lambda: initial_gaussians([], count=9, seed=0), "carry no depth"),
        (lambda: initial_gaussians([sky], count=9, seed=0), "no surface that stands still"),
        (lambda: initial_gaussians([frame], count=0, seed=0), "count must be"),
        (lambda: initial_gaussians([frame], count=9, seed=0, sh_degree=4), "sh_degree must be"),
        (lambda: initial_gaussians([frame], count=9, seed=0, opacity=1.0), "opacity must be"),
        (lambda: initial_gaussians([frame], count=9, seed=0.5), "seed must be"),  # type: ignore[arg-type]
        (lambda: scene_radius_m([blind]), "carry no depth"),
        (lambda: scene_radius_m([sky]), "no surface within 80 m"),
        (lambda: actor_points([blind], 1), "carry no depth"),
    ]
    for call, message in cases:
        with pytest.raises(ArgumentError, match=message):
            call()


@pytest.mark.skipif(not KITTI.is_dir(), reason="no shared KITTI odometry data")
def test_kitti_starts_from_stereo() -> None:
    clip = KittiOdometryClip(KITTI, scale=0.25)
    keys = [key for key in clip.keys if key.camera == clip.cameras[0]][:3]
    frames = [clip.frame(key) for key in keys]
    found = initial_gaussians([frames[0], frames[2]], count=8000, seed=0, opacity=0.9)
    assert len(found) == 8000 and 3 < scene_radius_m(frames) < 40
    picture, surface = drawn(found, frames[1]), np.isfinite(frames[1].depth_m)
    error = (picture.colours.numpy() - frames[1].image / 255.0)[surface]
    assert -10 * np.log10((error**2).mean()) > 15
