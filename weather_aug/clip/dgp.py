"""DGP scenes, the layout of DDAD: several cameras, a LiDAR, poses per picture, tracked boxes.

Convention:
    The world is the data set's own: metres, z up, far from the origin. Each picture has its own
    time and pose; boxes and LiDAR are those of its sample, moved into the world by the sweep's own
    pose. Boxes have length along x, width along y, height along z.

Source: TRI-ML/dgp, dgp/proto (scene, sample, annotations).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.images import read_image, read_only, resized_image
from weather_aug.clip.lidar import lidar_depth
from weather_aug.clip.motion import velocities
from weather_aug.clip.poses import Float64, inverse_motion, motion_from_quaternion
from weather_aug.clip.records import (
    Record,
    checked_scale,
    chosen_indices,
    folder_at,
    folder_name,
    inside,
    read_array,
    read_json,
    scaled_size,
    shown,
)
from weather_aug.clip.types import (
    MAX_SPEED_M_PER_S,
    Box,
    Camera,
    Frame,
    FrameKey,
    check_key,
)
from weather_aug.errors import ArgumentError, CalibrationError, ClipError, printable

_BOXES_3D = "1"
_FIRST_IMPOSSIBLE_YEAR = 2200


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A LiDAR sweep: its points, its pose, its boxes."""

    time_s: float
    points_path: Path
    world_from_lidar: Float64
    boxes_path: Path | None


@dataclass(frozen=True, eq=False)
class _Shot:
    """A picture: its file, its moment, its camera."""

    image_path: Path
    time_s: float
    camera: Camera
    sweep: _Sweep | None
    others: tuple[_Sweep, ...] = ()
    """Sweeps of the samples before and after."""


class DgpClip:
    """A scene in the DGP layout (DDAD and kin), depth from the sample's LiDAR sweep.

    Args:
        root: The folder that holds scene_dataset*.json, or the folder above it.
        scene: Folder name of the scene; may be left out where there is one only.
        cameras: Names of cameras to offer; empty for all.
        frames: Which samples to offer, by their order in time; None for all.
        scale: Pictures and intrinsics are scaled down by this factor, in (0, 1].

    Raises:
        ClipError: If a file is missing or damaged, or a field of it is missing or of another type.
        CalibrationError: If a pose or the intrinsics cannot be used.
        ArgumentError: If an option is outside what is accepted.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        scene: str | None = None,
        cameras: tuple[str, ...] = (),
        frames: slice | None = None,
        scale: float = 1.0,
    ) -> None:
        self._scale = checked_scale(scale)
        scene_path = _scene_path(folder_at(root, "DGP data set"), scene)
        self._folder = scene_path.parent
        self.name = folder_name("dgp", self._folder.resolve().name)
        self.up_world = read_only(np.array([0.0, 0.0, 1.0]))
        record = read_json(scene_path)
        shots = _shots(record, self._folder)
        present = sorted({camera for _, camera in shots})
        unknown = sorted(set(cameras) - set(present))
        if unknown:
            raise ArgumentError(
                f"cameras: no {printable(', '.join(unknown))}; the scene has {', '.join(present)}"
            )
        self.cameras = tuple(name for name in present if not cameras or name in cameras)
        count = 1 + max(index for index, _ in shots)
        indices = chosen_indices(frames, count)
        self.keys = tuple(
            FrameKey(index, name)
            for index in indices
            for name in self.cameras
            if (index, name) in shots
        )
        self._shots = {key: shots[key] for key in self.keys}
        self._class_names = _class_names(record, self._folder)

    def frame(self, key: FrameKey) -> Frame:
        """Read one picture, its boxes and its depth; see `Clip.frame`."""
        key = check_key(self, key)
        shot = self._shots[key]
        image = read_image(shot.image_path)
        camera = shot.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise ClipError(
                f"{shown(shot.image_path)} is {image.shape[1]}x{image.shape[0]}, the scene says "
                f"{camera.width}x{camera.height}; copy the picture again"
            )
        size = scaled_size(camera.width, camera.height, self._scale)
        image, camera = read_only(resized_image(image, *size)), camera.resized(*size)
        if shot.sweep is None:
            return Frame(key, shot.time_s, camera, image)
        points_world = _points_world(shot.sweep)
        camera_from_world = inverse_motion(camera.world_from_camera)
        points_camera = points_world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        depth_m = read_only(lidar_depth(points_camera, camera.intrinsics, image))
        boxes = _boxes(shot.sweep, shot.others, self._class_names)
        return Frame(key, shot.time_s, camera, image, depth_m=depth_m, boxes=boxes)


def _scene_path(root: Path, scene: str | None) -> Path:
    """The scene's JSON file, by the list in scene_dataset*.json."""
    found = sorted(root.glob("scene_dataset*.json")) or sorted(root.glob("*/scene_dataset*.json"))
    if len(found) != 1:
        raise ClipError(
            f"{shown(root)} has {len(found)} files scene_dataset*.json in it or one folder below; "
            "give the folder of one data set"
        )
    paths: dict[str, Path] = {}
    for split in read_json(found[0])["scene_splits"].members().values():
        for name in split["filenames"]:
            path = inside(found[0].parent, name.text(), name.where)
            paths[path.parent.name] = path
    if scene is None and len(paths) == 1:
        return next(iter(paths.values()))
    if scene is None or scene not in paths:
        raise ArgumentError(
            f"scene={printable(scene)} is not in {shown(found[0])}; choose one of "
            f"{printable(', '.join(sorted(paths)), 400)}"
        )
    return paths[scene]


def _shots(scene: Record, folder: Path) -> dict[tuple[int, str], _Shot]:
    """All pictures of a scene by (sample index in time, camera)."""
    data = {item["key"].text(): item for item in scene["data"]}
    samples = sorted(scene["samples"], key=lambda sample: _microseconds(sample["id"]["timestamp"]))
    if not samples:
        raise scene["samples"].fault("is empty")
    start = min(_microseconds(item["id"]["timestamp"]) for item in data.values())
    shots: dict[tuple[int, str], _Shot] = {}
    sweeps: list[_Sweep | None] = []
    for index, sample in enumerate(samples):
        members = [_datum(key, data) for key in sample["datum_keys"]]
        sweep = _sweep(members, folder, start)
        sweeps.append(sweep)
        intrinsics = _intrinsics(folder, sample["calibration_key"])
        for member in members:
            picture = member["datum"].get("image")
            if picture is None:
                continue
            name = _camera_name(member["id"]["name"])
            if name not in intrinsics:
                raise member["id"]["name"].fault(f"{name!r} is not in the sample's calibration")
            camera = _camera(picture, intrinsics[name])
            path = inside(folder, picture["filename"].text(), picture["filename"].where)
            time_s = (_microseconds(member["id"]["timestamp"]) - start) / 1e6
            shots[index, name] = _Shot(path, time_s, camera, sweep)
    if not shots:
        raise scene["data"].fault("holds no picture")
    return _moving(_with_others(shots, sweeps))


def _with_others(
    shots: dict[tuple[int, str], _Shot], sweeps: list[_Sweep | None]
) -> dict[tuple[int, str], _Shot]:
    """The same shots with the sweeps of the samples before and after."""
    return {
        key: replace(
            shot,
            others=tuple(
                other
                for other in (
                    *sweeps[max(key[0] - 1, 0) : key[0]],
                    *sweeps[key[0] + 1 : key[0] + 2],
                )
                if other is not None
            ),
        )
        for key, shot in shots.items()
    }


def _datum(key: Record, data: dict[str, Record]) -> Record:
    if key.text() not in data:
        raise key.fault(f"{printable(key.text())!r} is not the key of any datum")
    return data[key.text()]


def _camera_name(name: Record) -> str:
    text = name.text()
    if not text or folder_name(text) != text:
        raise name.fault("must be letters, digits, dot and dash")
    return text


def _sweep(members: list[Record], folder: Path, start: float) -> _Sweep | None:
    """The sample's LiDAR sweep, None where it has none."""
    for member in members:
        cloud = member["datum"].get("point_cloud")
        if cloud is None:
            continue
        boxes = cloud["annotations"].get(_BOXES_3D)
        return _Sweep(
            (_microseconds(member["id"]["timestamp"]) - start) / 1e6,
            inside(folder, cloud["filename"].text(), cloud["filename"].where),
            _pose(cloud["pose"]),
            None if boxes is None else inside(folder, boxes.text(), boxes.where),
        )
    return None


def _intrinsics(folder: Path, key: Record) -> dict[str, Float64]:
    """(3, 3) intrinsics by sensor name; the LiDAR's zeros are left out."""
    name = f"calibration/{key.text()}.json"
    calibration = read_json(inside(folder, name, key.where))
    names, values = list(calibration["names"]), list(calibration["intrinsics"])
    if len(names) != len(values):
        raise calibration["names"].fault(f"has {len(names)} entries for {len(values)} intrinsics")
    intrinsics = {}
    for sensor, value in zip(names, values, strict=True):
        fx, fy, cx, cy, skew = (value[part].number() for part in ("fx", "fy", "cx", "cy", "skew"))
        if fx != 0:
            intrinsics[sensor.text()] = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
    return intrinsics


def _camera(picture: Record, intrinsics: Float64) -> Camera:
    width, height = picture["width"].integer(), picture["height"].integer()
    world_from_camera = _pose(picture["pose"])
    try:
        return Camera(intrinsics, world_from_camera, width, height)
    except CalibrationError as error:
        raise CalibrationError(f"{picture.where}: {error}") from None


def _moving(shots: dict[tuple[int, str], _Shot]) -> dict[tuple[int, str], _Shot]:
    """The same shots with each camera's velocity, from its own poses and times."""
    moving = dict(shots)
    for name in {camera for _, camera in shots}:
        keys = sorted(key for key in shots if key[1] == name)
        times_s = np.array([shots[key].time_s for key in keys])
        poses = np.stack([shots[key].camera.world_from_camera for key in keys])
        for key, linear, angular in zip(keys, *velocities(times_s, poses), strict=True):
            camera = replace(
                shots[key].camera, velocity_m_per_s=linear, angular_velocity_rad_per_s=angular
            )
            moving[key] = replace(shots[key], camera=camera)
    return moving


def _pose(record: Record) -> Float64:
    rotation, translation = record["rotation"], record["translation"]
    wxyz = np.array([rotation[part].number() for part in ("qw", "qx", "qy", "qz")])
    xyz = np.array([translation[part].number() for part in ("x", "y", "z")])
    return motion_from_quaternion(wxyz, xyz, record.where)


def _microseconds(record: Record) -> float:
    """Unix time of a timestamp, microseconds."""
    try:
        moment = datetime.fromisoformat(record.text())
    except ValueError:
        raise record.fault("is not a time (ISO 8601)") from None
    if moment.tzinfo is None:
        raise record.fault("has no time zone")
    unix = (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)
    # The scenes published with DGP carry ten times the Unix time (they say 2464 for a drive of
    # 2019, whose files are named by the true time), which would slow the car down tenfold.
    return unix / 10 if moment.year >= _FIRST_IMPOSSIBLE_YEAR else float(unix)


def _points_world(sweep: _Sweep) -> Float64:
    """(N, 3) points of a sweep in world axes."""
    points: NDArray[np.float64] = read_array(sweep.points_path, "data")
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind != "f":
        raise ClipError(
            f"{shown(sweep.points_path)}: data must be floats (N, 3 or more), is {points.dtype} "
            f"{points.shape}"
        )
    points = points[:, :3].astype(np.float64)
    if not np.isfinite(points).all():
        raise ClipError(f"{shown(sweep.points_path)} holds NaN or infinity; copy it again")
    return np.asarray(points @ sweep.world_from_lidar[:3, :3].T + sweep.world_from_lidar[:3, 3])


def _boxes(
    sweep: _Sweep, others: tuple[_Sweep, ...], class_names: dict[int, str]
) -> tuple[Box, ...]:
    """Boxes of a sweep; their velocities are from where their tracks are in the sweeps around."""
    annotations = _annotations(sweep)
    places = [(other.time_s, _places(other)) for other in others if annotations]
    boxes = []
    for annotation in annotations:
        box = annotation["box"]
        track = annotation["instance_id"].integer()
        class_id = annotation["class_id"].integer()
        size = tuple(box[side].number() for side in ("length", "width", "height"))
        world_from_box = sweep.world_from_lidar @ _pose(box["pose"])
        seen = [(time_s, place[track]) for time_s, place in places if track in place]
        try:
            found = Box(
                track,
                class_names.get(class_id, str(class_id)),
                world_from_box,
                (size[0], size[1], size[2]),
                _velocity([*seen, (sweep.time_s, world_from_box[:3, 3])]),
            )
        except CalibrationError as error:
            raise CalibrationError(f"{annotation.where}: {error}") from None
        boxes.append(found)
    return tuple(boxes)


def _annotations(sweep: _Sweep) -> list[Record]:
    return [] if sweep.boxes_path is None else list(read_json(sweep.boxes_path)["annotations"])


def _places(sweep: _Sweep) -> dict[int, Float64]:
    """(3,) world place of each track's box, metres."""
    return {
        annotation["instance_id"].integer(): np.asarray(
            (sweep.world_from_lidar @ _pose(annotation["box"]["pose"]))[:3, 3]
        )
        for annotation in _annotations(sweep)
    }


def _velocity(seen: list[tuple[float, Float64]]) -> Float64 | None:
    """(3,) m/s from the first to the last moment; None of one moment, or where the track jumps."""
    (first_s, first), (last_s, last) = (
        ends(seen, key=lambda moment: moment[0]) for ends in (min, max)
    )
    if last_s <= first_s:
        return None
    velocity: Float64 = (last - first) / (last_s - first_s)
    # An id that was given anew to something else.
    return velocity if np.linalg.norm(velocity) <= MAX_SPEED_M_PER_S else None


def _class_names(scene: Record, folder: Path) -> dict[int, str]:
    """Class name by id of the 3D boxes' ontology; empty where the scene has none."""
    key = scene["ontologies"].get(_BOXES_3D)
    if key is None:
        return {}
    ontology = read_json(inside(folder, f"ontology/{key.text()}.json", key.where))
    return {item["id"].integer(): item["name"].text() for item in ontology["items"]}
