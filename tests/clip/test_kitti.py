"""The KITTI readers on the shared recordings and on small folders written here."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from weather_aug.clip.kitti import KittiOdometryClip, KittiRawClip, read_poses
from weather_aug.clip.types import Clip, Frame, FrameKey
from weather_aug.errors import ArgumentError, CalibrationError, ClipError

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
ODOMETRY, RAW = DATA / "kitti-odom02-stereo20", DATA / "kitti-sfnd-12f"
needs_odometry = pytest.mark.skipif(not ODOMETRY.is_dir(), reason="no shared KITTI odometry data")
needs_raw = pytest.mark.skipif(not RAW.is_dir(), reason="no shared KITTI raw data")

IDENTITY_LINE = "1 0 0 0 0 1 0 0 0 0 1 0"


def warp_error(now: Frame, before: Frame) -> tuple[float, float]:
    """Mean grey difference of `now` to `before` warped by depth and pose, and unwarped."""
    assert now.depth_m is not None
    known = np.isfinite(now.depth_m) & (now.depth_m < 60)
    before_from_now = np.linalg.inv(before.camera.world_from_camera)
    points = points_world(now) @ before_from_now[:3, :3].T + before_from_now[:3, 3]
    projected = points @ before.camera.intrinsics.T
    at = (projected[..., :2] / np.maximum(projected[..., 2:], 0.1)).astype(np.float32)
    grey_now, grey_before = (
        cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) for frame in (now, before)
    )
    limit = (now.camera.width - 1, now.camera.height - 1)
    seen = known & (at > 0).all(axis=-1) & (at < limit).all(axis=-1)
    warped = cv2.remap(grey_before, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return (
        float(np.abs(warped - grey_now)[seen].mean()),
        float(np.abs(grey_before - grey_now)[seen].mean()),
    )


def _stepping(now: Frame, before: Frame, share: float) -> Frame:
    """`now` with only a share of its translation since `before`."""
    motion = now.camera.world_from_camera.copy()
    start = before.camera.centre_world
    motion[:3, 3] = start + share * (motion[:3, 3] - start)
    return replace(now, camera=replace(now.camera, world_from_camera=motion))


def _odometry_folder(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (40, 140, 3), np.uint8), (0, 0), 1)
    for index in range(2):
        for name, start in (("image_2", 0), ("image_3", 6)):
            (folder / name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(wide[:, start : start + 120]).save(folder / name / f"{index:06d}.png")
    projection = "100 0 60 {} 0 100 20 0 0 0 1 0"
    lines = [f"P2: {projection.format(0)}", f"P3: {projection.format(-50)}"]
    (folder / "calib.txt").write_text("\n".join(lines))
    (folder / "times.txt").write_text("0.0\n0.1\n")
    (folder / "poses.txt").write_text(
        f"{IDENTITY_LINE}\n{IDENTITY_LINE.replace('1 0 0 0', '1 0 0 2', 1)}"
    )
    return folder


@needs_odometry
def test_depth_and_poses_predict_the_frame_before() -> None:
    clip = KittiOdometryClip(ODOMETRY, frames=slice(4, 6), scale=0.5)
    before, now = (clip.frame(key) for key in clip.keys)
    warped, unwarped = warp_error(now, before)
    assert 2 * warped < unwarped


@needs_odometry
def test_motion_is_that_of_the_car() -> None:
    clip = KittiOdometryClip(ODOMETRY, frames=slice(0, 1), scale=0.1)
    assert isinstance(clip, Clip)
    camera = clip.frame(clip.keys[0]).camera
    forward = camera.world_from_camera[:3, 2]
    # 1.53 m in 0.1036 s.
    assert float(camera.velocity_m_per_s @ forward) == pytest.approx(14.76, abs=0.1)
    assert clip.up_world @ np.array([0, -1, 0]) > np.cos(np.radians(2))


@needs_odometry
def test_colour_cameras_sit_beside_camera_0() -> None:
    clip = KittiOdometryClip(ODOMETRY, frames=slice(0, 1), scale=0.1, cameras=("right", "left"))
    left, right = (clip.frame(key).camera for key in clip.keys)
    assert clip.cameras == ("left", "right")
    # Figure 3 of the data set's paper: colour left is 6 cm left of grey left, baseline 54 cm.
    assert left.centre_world[0] == pytest.approx(-0.06, abs=1e-3)
    baseline_m = float(np.linalg.norm(right.centre_world - left.centre_world))
    assert baseline_m == pytest.approx(0.532, abs=2e-3)


@needs_odometry
def test_up_is_the_normal_of_the_road() -> None:
    clip = KittiOdometryClip(ODOMETRY, frames=slice(0, 1), scale=0.5)
    frame = clip.frame(clip.keys[0])
    points = points_world(frame)
    road = points[150:185, 240:360].reshape(-1, 3)
    _, _, axes = np.linalg.svd(road - road.mean(axis=0), full_matrices=False)
    assert abs(axes[2] @ clip.up_world) > np.cos(np.radians(1.5))
    height_m = float((frame.camera.centre_world - road.mean(axis=0)) @ clip.up_world)
    assert height_m == pytest.approx(1.65, abs=0.12)


@needs_odometry
def test_a_clip_travels_to_a_worker_and_frames_repeat() -> None:
    clip = KittiOdometryClip(ODOMETRY, frames=slice(3, 4), scale=0.25)
    twin = pickle.loads(pickle.dumps(clip))
    first, second = clip.frame(clip.keys[0]), twin.frame(clip.keys[0])
    assert first.depth_m is not None
    assert not first.image.flags.writeable and not first.depth_m.flags.writeable
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.depth_m, second.depth_m)
    with pytest.raises(ClipError, match="has no frame"):
        clip.frame(FrameKey(2, "left"))


@needs_raw
def test_lidar_depth_explains_the_picture_of_the_car_creeping_forward() -> None:
    clip = KittiRawClip(RAW, frames=slice(4, 6))
    before, now = (clip.frame(key) for key in clip.keys)
    assert now.depth_m is not None
    height, width = now.depth_m.shape
    road = np.zeros((height, width), bool)
    road[int(0.7 * height) :, int(0.33 * width) : int(0.62 * width)] = True
    now = replace(now, depth_m=np.where(road, now.depth_m, np.inf))
    # The shared poses were derived among moving traffic; half of each step fits the road best.
    errors = {share: warp_error(_stepping(now, before, share), before)[0] for share in (-1, 0, 0.5)}
    assert errors[0.5] < 0.9 * errors[0] < errors[0] < 0.8 * errors[-1]


@needs_raw
def test_lidar_stands_upright_in_the_camera() -> None:
    clip = KittiRawClip(RAW, frames=slice(0, 1), scale=0.5)
    frame = clip.frame(clip.keys[0])
    road = points_world(frame)[150:180, 200:240].reshape(-1, 3)
    height_m = float(np.median((frame.camera.centre_world - road) @ clip.up_world))
    assert height_m == pytest.approx(1.65, abs=0.15)


def test_a_small_sequence_reads(tmp_path: Path) -> None:
    clip = KittiOdometryClip(_odometry_folder(tmp_path / "07"))
    frame = clip.frame(clip.keys[1])
    assert clip.name == "kitti-odometry-07"
    assert frame.depth_m is not None
    # Focal length 100 px, baseline 0.5 m, disparity 6 px.
    assert np.median(frame.depth_m) == pytest.approx(100 * 0.5 / 6, rel=0.03)
    np.testing.assert_allclose([20.0, 0, 0], frame.camera.velocity_m_per_s, atol=1e-9)


def test_poses_are_found_in_the_benchmarks_place(tmp_path: Path) -> None:
    folder = _odometry_folder(tmp_path / "sequences" / "07")
    (tmp_path / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "poses" / "07.txt")
    assert len(KittiOdometryClip(folder).keys) == 2
    (tmp_path / "poses" / "07.txt").unlink()
    with pytest.raises(ClipError, match=r"0 files poses\*\.txt.*07\.txt does not exist.*poses="):
        KittiOdometryClip(folder)


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", "image_2", "image_3/000001.png"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    folder = _odometry_folder(tmp_path / "07")
    (folder / name).rename(tmp_path / "aside")
    with pytest.raises(ClipError, match=name.split("/")[0]):
        clip = KittiOdometryClip(folder)
        clip.frame(clip.keys[1])


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        (
            "poses.txt",
            f"{IDENTITY_LINE}\n{IDENTITY_LINE.replace('1 0 0 0', 'nan 0 0 0', 1)}",
            "line 2.*NaN",
        ),
        ("poses.txt", f"{IDENTITY_LINE}\n1 0 0", "line 2 holds 3 numbers instead of 12"),
        ("poses.txt", f"{IDENTITY_LINE}\n2{IDENTITY_LINE[1:]}", "line 2 is not a rigid motion"),
        ("poses.txt", IDENTITY_LINE, "cover 1 frames, but the pictures go up to number 1"),
        ("calib.txt", "P2: 1 2 3\nP3: 1", "'P2' holds 3 numbers"),
        ("calib.txt", "P0: 1", "no line 'P2'; restore"),
        ("times.txt", "0\nsoon", "line 2 holds something that is not a number"),
    ],
)
def test_damaged_tables_are_named(tmp_path: Path, name: str, text: str, expected: str) -> None:
    folder = _odometry_folder(tmp_path / "07")
    (folder / name).write_text(text)
    with pytest.raises((ClipError, CalibrationError), match=expected) as caught:
        KittiOdometryClip(folder)
    assert name in str(caught.value)


def test_bad_options_are_refused(tmp_path: Path) -> None:
    folder = _odometry_folder(tmp_path / "07")
    with pytest.raises(ArgumentError, match="cameras must name each of left, right"):
        KittiOdometryClip(folder, cameras=("middle",))
    with pytest.raises(ArgumentError, match="chooses none of the 2 frames"):
        KittiOdometryClip(folder, frames=slice(5, 9))
    with pytest.raises(ClipError, match=r"elsewhere\.txt does not exist"):
        KittiOdometryClip(folder, poses="elsewhere.txt")


def test_the_official_raw_layout_reads(tmp_path: Path) -> None:
    drive = _raw_drive(tmp_path / "2011_09_26")
    with pytest.raises(ClipError, match="oxts"):
        KittiRawClip(drive)
    (drive / "poses.txt").write_text(f"{IDENTITY_LINE}\n")
    clip = KittiRawClip(drive)
    frame = clip.frame(clip.keys[0])
    assert frame.depth_m is not None
    np.testing.assert_allclose(10.0, frame.depth_m[20:, 20:100], rtol=0.02)


def test_a_damaged_scan_is_named(tmp_path: Path) -> None:
    drive = _raw_drive(tmp_path / "2011_09_26")
    (drive / "poses.txt").write_text(f"{IDENTITY_LINE}\n")
    scan = drive / "velodyne_points" / "data" / "0000000000.bin"
    scan.write_bytes(scan.read_bytes()[:-3])
    clip = KittiRawClip(drive)
    with pytest.raises(ClipError, match=r"0000000000\.bin has .* bytes"):
        clip.frame(clip.keys[0])


def test_poses_are_made_rigid(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1 -1e-5 0 0 1e-5 1 3e-5 0 0 0 1 0\n")
    rotation = read_poses(path)[0, :3, :3]
    np.testing.assert_allclose(np.eye(3), rotation @ rotation.T, atol=1e-14)


def points_world(frame: Frame) -> NDArray[np.float64]:
    assert frame.depth_m is not None
    rows, columns = np.mgrid[: frame.camera.height, : frame.camera.width]
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    depth = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0)[..., None]
    points = pixels @ np.linalg.inv(frame.camera.intrinsics).T * depth
    motion = frame.camera.world_from_camera
    return points @ motion[:3, :3].T + motion[:3, 3]


def _raw_drive(date: Path) -> Path:
    """One frame that faces a wall 10 m ahead, in the benchmark's own layout."""
    drive = date / "2011_09_26_drive_0001_sync"
    for name in ("image_02/data", "velodyne_points/data"):
        (drive / name).mkdir(parents=True)
    Image.fromarray(np.full((40, 120, 3), (90, 60, 40), np.uint8)).save(
        drive / "image_02" / "data" / "0000000000.png"
    )
    sideways, upward = np.meshgrid(np.linspace(-7, 7, 90), np.linspace(-2.5, 2.5, 40))
    ahead = np.full_like(sideways, 10.0)
    points = np.stack([ahead, sideways, upward, np.zeros_like(ahead)], axis=-1)
    points.astype("<f4").tofile(drive / "velodyne_points" / "data" / "0000000000.bin")
    (drive / "image_02" / "timestamps.txt").write_text("2011-09-26 13:02:25.964389445\n")
    (date / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
        "P_rect_02: 100 0 60 0 0 100 20 0 0 0 1 0\n"
    )
    (date / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    return drive
