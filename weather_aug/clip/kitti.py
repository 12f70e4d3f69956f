"""KITTI: the odometry benchmark (stereo) and the raw recordings (LiDAR).

Convention:
    The world is the rectified camera 0 of the first pose; poses files give world_from_camera0, one
    row-major 3x4 matrix a line. Frame numbers are those of the files. Up is the road's normal, see
    `up_from_travel`. Both benchmarks expose for about 2 ms in daylight.

Source: Geiger et al. 2013, "Vision meets robotics: the KITTI dataset", and the odometry readme.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.images import read_image, read_only, resized_image
from weather_aug.clip.lidar import lidar_depth
from weather_aug.clip.motion import velocities
from weather_aug.clip.poses import Float64, inverse_motion, rigid_motion, up_from_travel
from weather_aug.clip.records import (
    checked_scale,
    chosen_indices,
    folder_at,
    folder_name,
    numbers_of,
    read_array,
    read_floats,
    read_lines,
    read_numbers,
    scaled_size,
    shown,
)
from weather_aug.clip.stereo import right_depth, stereo_depth
from weather_aug.clip.types import Camera, Frame, FrameKey, check_key
from weather_aug.errors import ArgumentError, CalibrationError, ClipError, printable

EXPOSURE_S = 0.002
_PROJECTION_BY_SIDE = {"left": "P2", "right": "P3"}
_FOLDER_BY_SIDE = {"left": "image_2", "right": "image_3"}


class KittiOdometryClip:
    """A sequence of the KITTI odometry benchmark, colour cameras, depth from stereo.

    Args:
        root: The sequence's folder with image_2, image_3, calib.txt and times.txt.
        frames: Which frames to offer, by file number; None for all.
        cameras: Of "left" and "right"; depth always uses both pictures.
        poses: Poses file, relative to `root` or absolute. Otherwise ../../poses/<sequence>.txt as
            in the benchmark, otherwise the only poses*.txt in `root`.
        scale: Pictures and intrinsics are scaled down by this factor, in (0, 1].

    Raises:
        ClipError: If a file or folder is missing or damaged.
        CalibrationError: If calibration or poses cannot be used.
        ArgumentError: If an option is outside what is accepted.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        frames: slice | None = None,
        cameras: tuple[str, ...] = ("left",),
        poses: str | None = None,
        scale: float = 1.0,
    ) -> None:
        self._root = folder_at(root, "KITTI odometry sequence")
        self._scale = checked_scale(scale)
        self.name = folder_name("kitti-odometry", self._root.resolve().name)
        self.cameras = _sides(cameras)
        calibration_path = self._root / "calib.txt"
        calibration = _named_rows(calibration_path)
        self._projections = {
            side: _projection(_row(calibration, name, 12, calibration_path), calibration_path)
            for side, name in _PROJECTION_BY_SIDE.items()
        }
        sequence = self._root.resolve().name
        official = self._root.resolve().parent.parent / "poses" / f"{sequence}.txt"
        poses_path = _poses_path(self._root, poses, official)
        world_from_camera0 = read_poses(poses_path)
        self._times_s = read_numbers(self._root / "times.txt", 1)[:, 0]
        self._files = {
            side: _numbered_files(self._root / folder, ".png")
            for side, folder in _FOLDER_BY_SIDE.items()
        }
        present = sorted(self._files["left"])
        known = min(len(world_from_camera0), len(self._times_s))
        if present[-1] >= known:
            raise ClipError(
                f"{shown(poses_path)} and times.txt cover {known} frames, but the pictures go up "
                f"to number {present[-1]}; complete them or choose frames with frames=a:b"
            )
        self._motions = {
            side: _Motion(world_from_camera0, self._projections[side][1], self._times_s)
            for side in self.cameras
        }
        self.up_world = read_only(up_from_travel(world_from_camera0))
        chosen = [present[i] for i in chosen_indices(frames, len(present))]
        self.keys = tuple(FrameKey(index, side) for index in chosen for side in self.cameras)

    def frame(self, key: FrameKey) -> Frame:
        """Read one frame and match its stereo pair; see `Clip.frame`."""
        index, side = key = check_key(self, key)
        views = {name: self._view(name, index) for name in _FOLDER_BY_SIDE}
        left, right = (_shrunk(views[name], self._scale) for name in ("left", "right"))
        if left.shape != right.shape:
            raise ClipError(
                f"{shown(self._files['right'][index])} has another size than its left picture; "
                "take both from one sequence"
            )
        intrinsics, camera_from_camera0 = self._projections[side]
        image = views[side]
        camera = self._motions[side].camera(index, intrinsics, image).resized(*_size(left))
        other = self._projections["right" if side == "left" else "left"][1]
        baseline_m = abs(float(camera_from_camera0[0, 3] - other[0, 3]))
        measure = stereo_depth if side == "left" else right_depth
        depth_m = measure(left, right, focal_px=camera.focal_px[0], baseline_m=baseline_m)
        picture = left if side == "left" else right
        return Frame(
            key, float(self._times_s[index]), camera, read_only(picture), depth_m=read_only(depth_m)
        )

    def _view(self, side: str, index: int) -> NDArray[np.uint8]:
        path = self._files[side].get(index)
        if path is None:
            raise ClipError(
                f"{shown(self._root / _FOLDER_BY_SIDE[side])} has no picture number {index}; "
                "depth needs both views, download the colour sequence again"
            )
        return read_image(path)


class KittiRawClip:
    """A KITTI raw drive (rectified), left colour camera, depth from the Velodyne.

    Args:
        root: Either the benchmark's <date>_drive_<n>_sync folder (image_02/data,
            velodyne_points/data, and calib_cam_to_cam.txt, calib_velo_to_cam.txt in it or one
            above), or a folder with image_02/*.png, velodyne/*.bin and one calib*.npz holding
            P_rect_02 (3, 4), R_rect_00 and Tr_velo_cam0 (4, 4).
        frames: Which frames to offer, by file number; None for all.
        poses: Poses file of camera 0; otherwise the only poses*.txt in `root`. The raw drives have
            GPS and inertial packets (oxts) instead, which this reader does not integrate.
        scale: Pictures and intrinsics are scaled down by this factor, in (0, 1].
        rate_hz: Frames a second where image_02/timestamps.txt is absent.

    Raises:
        ClipError: If a file or folder is missing or damaged.
        CalibrationError: If calibration or poses cannot be used.
        ArgumentError: If an option is outside what is accepted.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        frames: slice | None = None,
        poses: str | None = None,
        scale: float = 1.0,
        rate_hz: float = 10.0,
    ) -> None:
        self._root = folder_at(root, "KITTI raw drive")
        self._scale = checked_scale(scale)
        self.name = folder_name("kitti-raw", self._root.resolve().name)
        self.cameras: tuple[str, ...] = ("left",)
        official = (self._root / "image_02" / "data").is_dir()
        folders = (
            ("image_02/data", "velodyne_points/data") if official else ("image_02", "velodyne")
        )
        self._images = _numbered_files(self._root / folders[0], ".png")
        self._scans = _numbered_files(self._root / folders[1], ".bin")
        calibration = _official_calibration if official else _packed_calibration
        self._projection, self._camera0_from_velodyne = calibration(self._root)
        poses_path = _poses_path(self._root, poses, None)
        world_from_camera0 = read_poses(poses_path)
        present = sorted(set(self._images) & set(self._scans))
        if not present or present[-1] >= len(world_from_camera0):
            raise ClipError(
                f"{shown(poses_path)} has {len(world_from_camera0)} poses for pictures up to "
                f"number {max(self._images)}, {len(present)} of them with a scan; complete it"
            )
        self._times_s = _raw_times(self._root, len(world_from_camera0), rate_hz)
        self._motion = _Motion(world_from_camera0, self._projection[1], self._times_s)
        self.up_world = read_only(up_from_travel(world_from_camera0))
        chosen = [present[i] for i in chosen_indices(frames, len(present))]
        self.keys = tuple(FrameKey(index, "left") for index in chosen)

    def frame(self, key: FrameKey) -> Frame:
        """Read one frame and complete its LiDAR scan; see `Clip.frame`."""
        key = check_key(self, key)
        index = key.time_index
        whole = read_image(self._images[index])
        image = _shrunk(whole, self._scale)
        intrinsics, camera_from_camera0 = self._projection
        camera = self._motion.camera(index, intrinsics, whole).resized(*_size(image))
        camera_from_velodyne = camera_from_camera0 @ self._camera0_from_velodyne
        points = read_floats(self._scans[index], 4)[:, :3].astype(np.float64)
        points_camera = points @ camera_from_velodyne[:3, :3].T + camera_from_velodyne[:3, 3]
        depth_m = lidar_depth(points_camera, camera.intrinsics, image)
        return Frame(
            key, float(self._times_s[index]), camera, read_only(image), depth_m=read_only(depth_m)
        )


class _Motion:
    """Pose and velocity of one camera at every time of a sequence."""

    def __init__(
        self, world_from_camera0: Float64, camera_from_camera0: Float64, times_s: Float64
    ) -> None:
        self._poses = world_from_camera0 @ inverse_motion(camera_from_camera0)
        count = len(self._poses)
        self._linear, self._angular = velocities(times_s[:count], self._poses)

    def camera(self, index: int, intrinsics: Float64, image: NDArray[np.uint8]) -> Camera:
        width, height = _size(image)
        return Camera(
            intrinsics,
            self._poses[index],
            width,
            height,
            exposure_s=EXPOSURE_S,
            velocity_m_per_s=self._linear[index],
            angular_velocity_rad_per_s=self._angular[index],
        )


def read_poses(path: Path) -> Float64:
    """(N, 4, 4) world_from_camera0 of a KITTI poses file.

    Raises:
        ClipError: If a line is not 12 finite numbers.
        CalibrationError: If a line is not a rigid motion; the line is named.
    """
    rows = read_numbers(path, 12)
    return np.stack(
        [rigid_motion(row, f"{shown(path)} line {line}") for line, row in enumerate(rows, start=1)]
    )


def _poses_path(root: Path, option: str | None, official: Path | None) -> Path:
    if option is not None:
        path = root / option
        if not path.is_file():
            raise ClipError(f"poses file {shown(path)} does not exist; check poses=")
        return path
    if official is not None and official.is_file():
        return official
    found = sorted(root.glob("poses*.txt"))
    if len(found) == 1:
        return found[0]
    places = [] if official is None else [shown(official)]
    raise ClipError(
        f"{shown(root)} has {len(found)} files poses*.txt"
        + "".join(f", and {place} does not exist" for place in places)
        + "; name a file of camera poses with poses=FILE (GPS packets in oxts are not read; an "
        "odometry program gives camera poses)"
    )


def _sides(cameras: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in cameras if name not in _PROJECTION_BY_SIDE]
    if unknown or not cameras or len(set(cameras)) != len(cameras):
        raise ArgumentError(
            f"cameras must name each of left, right at most once, got {printable(list(cameras))}"
        )
    return tuple(sorted(cameras))


def _numbered_files(folder: Path, suffix: str) -> dict[int, Path]:
    folder_at(folder, "folder")
    files = {
        int(path.stem): path
        for path in folder.iterdir()
        if path.suffix == suffix and path.stem.isascii() and path.stem.isdigit()
    }
    if not files:
        raise ClipError(f"{shown(folder)} holds no numbered {suffix} files; check the path")
    return files


def _named_rows(path: Path) -> dict[str, str]:
    """The lines "name: values" of a KITTI calibration file."""
    pairs = (line.partition(":") for line in read_lines(path))
    return {name.strip(): values for name, _, values in pairs}


def _row(rows: dict[str, str], name: str, columns: int, path: Path) -> Float64:
    if name not in rows:
        raise CalibrationError(f"{shown(path)} has no line {name!r}; restore the calibration file")
    return numbers_of(rows[name], columns, f"{shown(path)} line {name!r}")


def _projection(values: Float64, path: Path) -> tuple[Float64, Float64]:
    """Split a rectified projection P = K [I | t] into K and camera_from_camera0."""
    matrix = np.asarray(values, np.float64).reshape(3, 4)
    intrinsics = matrix[:, :3]
    if not (np.isfinite(matrix).all() and abs(np.linalg.det(intrinsics)) > 1e-6):
        raise CalibrationError(f"{shown(path)}: a projection is singular; restore the calibration")
    camera_from_camera0 = np.eye(4)
    camera_from_camera0[:3, 3] = np.linalg.solve(intrinsics, matrix[:, 3])
    return intrinsics, camera_from_camera0


_Calibration = tuple[tuple[Float64, Float64], Float64]


def _packed_calibration(root: Path) -> _Calibration:
    found = sorted(root.glob("calib*.npz"))
    if len(found) != 1:
        raise ClipError(
            f"{shown(root)} has {len(found)} files calib*.npz and no image_02/data; give the "
            "benchmark's layout or one calibration file"
        )
    path = found[0]
    shapes = {"P_rect_02": (3, 4), "R_rect_00": (4, 4), "Tr_velo_cam0": (4, 4)}
    arrays = {name: read_array(path, name) for name in shapes}
    for name, shape in shapes.items():
        if arrays[name].shape != shape or arrays[name].dtype.kind != "f":
            raise CalibrationError(f"{shown(path)}: {name} must be floats of shape {shape}")
    rectified = rigid_motion(arrays["R_rect_00"], f"{shown(path)}: R_rect_00")
    mounted = rigid_motion(arrays["Tr_velo_cam0"], f"{shown(path)}: Tr_velo_cam0")
    return _projection(arrays["P_rect_02"], path), rectified @ mounted


def _official_calibration(root: Path) -> _Calibration:
    places = [root, root.resolve().parent]
    for place in places:
        if (place / "calib_cam_to_cam.txt").is_file():
            break
    else:
        raise ClipError(
            f"calib_cam_to_cam.txt is neither in {shown(places[0])} nor in {shown(places[1])}; "
            "unpack the drive's calibration archive there"
        )
    cameras_path, velodyne_path = place / "calib_cam_to_cam.txt", place / "calib_velo_to_cam.txt"
    cameras, velodyne = _named_rows(cameras_path), _named_rows(velodyne_path)
    rectified = np.eye(4)
    rectified[:3, :3] = _row(cameras, "R_rect_00", 9, cameras_path).reshape(3, 3)
    mounted = np.eye(4)
    mounted[:3, :3] = _row(velodyne, "R", 9, velodyne_path).reshape(3, 3)
    mounted[:3, 3] = _row(velodyne, "T", 3, velodyne_path)
    camera0_from_velodyne = rigid_motion(rectified, f"{shown(cameras_path)}: R_rect_00")
    camera0_from_velodyne = camera0_from_velodyne @ rigid_motion(mounted, shown(velodyne_path))
    projection = _projection(_row(cameras, "P_rect_02", 12, cameras_path), cameras_path)
    return projection, camera0_from_velodyne


def _raw_times(root: Path, count: int, rate_hz: float) -> Float64:
    path = root / "image_02" / "timestamps.txt"
    if not path.is_file():
        if not 0 < rate_hz <= 1000:
            raise ArgumentError(f"rate_hz must be in (0, 1000], got {rate_hz!r}")
        return np.arange(count) / rate_hz
    try:
        # The files give nanoseconds; datetime reads six digits.
        moments = [datetime.fromisoformat(line.strip()[:26]) for line in read_lines(path)]
    except ValueError:
        raise ClipError(f"{shown(path)} holds a line that is not a time; restore it") from None
    if len(moments) < count:
        raise ClipError(f"{shown(path)} has {len(moments)} times for {count} poses; restore it")
    return np.array([(moment - moments[0]).total_seconds() for moment in moments])


def _shrunk(image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    return resized_image(image, *scaled_size(*_size(image), scale))


def _size(image: NDArray[np.uint8]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
