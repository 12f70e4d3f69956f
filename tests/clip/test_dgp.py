"""The DGP reader on the shared DDAD scenes, and on damaged copies of their small files."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from weather_aug.clip.dgp import DgpClip
from weather_aug.clip.open import open_clip
from weather_aug.clip.types import Box, Clip, FrameKey
from weather_aug.errors import ArgumentError, CalibrationError, ClipError

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "dgp-ddad"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no shared DDAD data")

UNIT_POSE = {
    "rotation": {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0},
    "translation": {"x": 5.0, "y": 0.0, "z": 1.0},
}
# Camera axes from a level world: x right is world -y, z forward is world x.
CAMERA_POSE = {
    "rotation": {"qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5},
    "translation": {"x": 5.0, "y": 0.0, "z": 1.0},
}


def _inside(points_world: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    to_box = np.linalg.inv(box.world_from_box)
    local = points_world @ to_box[:3, :3].T + to_box[:3, 3]
    return np.asarray((np.abs(local) <= np.array(box.size_m) / 2 + 0.05).all(axis=1))


@needs_data
def test_boxes_hold_the_points_that_were_counted_in_them() -> None:
    clip = DgpClip(DATA, scene="scene_01", scale=0.1, frames=slice(1, 2), cameras=("CAMERA_01",))
    boxes = clip.frame(clip.keys[0]).boxes
    scene = DATA / "test_scene" / "scene_01"
    stamp = "15569195939203480"
    annotations = json.loads((scene / f"bounding_box_3d/LIDAR/{stamp}.json").read_text())
    counted = {item["instance_id"]: item["num_points"] for item in annotations["annotations"]}
    with np.load(scene / f"point_cloud/LIDAR/{stamp}.npz") as archive:
        points = archive["data"][:, :3]
    poses = json.loads(next(scene.glob("scene_*.json")).read_text())["data"]
    pose = next(
        item["datum"]["point_cloud"]["pose"]
        for item in poses
        if stamp in item["datum"].get("point_cloud", {}).get("filename", "")
    )
    world_from_lidar = _motion(pose)
    points_world = points @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]
    assert len(boxes) == len(counted) == 96
    found = np.array([_inside(points_world, box).sum() for box in boxes])
    expected = np.array([counted[box.track_id] for box in boxes])
    well_hit = expected >= 200
    assert well_hit.sum() > 10
    # The published cloud holds every fifth point of those that were counted.
    share = found[well_hit] / expected[well_hit]
    assert np.median(share) == pytest.approx(0.2, abs=0.02)
    assert share.min() > 0.08 and share.max() < 0.25
    assert {"Car"} <= {box.class_name for box in boxes}


@needs_data
def test_tracked_cars_drive_the_way_they_look() -> None:
    clip = DgpClip(DATA, scene="scene_02", scale=0.1)
    speeds = []
    for key in clip.keys[::6]:
        for box in clip.frame(key).boxes:
            if box.class_name != "Car" or box.velocity_m_per_s is None:
                continue
            speed = float(np.linalg.norm(box.velocity_m_per_s))
            speeds.append(speed)
            if speed > 2:
                assert box.velocity_m_per_s @ box.world_from_box[:3, 0] > 0.98 * speed
    assert len(speeds) > 20 and min(speeds) < 0.2 and 10 < max(speeds) < 30


def _shifted(ahead_m: float) -> dict[str, Any]:
    """The sweep's pose of the first moment, moved on."""
    place = UNIT_POSE["translation"]
    return {**UNIT_POSE, "translation": {**place, "x": place["x"] + ahead_m}}


def _second_sweep(cloud: str, pose: Any) -> Callable[[Any], None]:
    """A sweep of its own for the second moment, 0.1 s later, whose sensor has moved on."""

    def apply(description: Any) -> None:
        first = description["data"][-1]
        second = copy.deepcopy(first) | {"key": cloud}
        second["datum"]["point_cloud"]["pose"] = pose
        second["id"]["timestamp"] = description["data"][1]["id"]["timestamp"]
        description["data"].append(second)
        description["samples"][1]["datum_keys"][1] = cloud

    return apply


def test_velocity_is_from_where_the_track_is_around_it(tmp_path: Path) -> None:
    pose = _shifted(1.2)
    clip = DgpClip(_written(tmp_path, _second_sweep("later", pose)))
    for key in clip.keys:
        (box,) = clip.frame(key).boxes
        np.testing.assert_allclose([12.0, 0.0, 0.0], box.velocity_m_per_s, atol=1e-4)


def test_velocity_of_one_moment_or_of_a_jump_is_unknown(tmp_path: Path) -> None:
    (box,) = DgpClip(_written(tmp_path / "one")).frame(FrameKey(0, "CAM")).boxes
    assert box.velocity_m_per_s is None
    clip = DgpClip(_written(tmp_path / "jump", _second_sweep("later", _shifted(80.0))))
    assert clip.frame(FrameKey(0, "CAM")).boxes[0].velocity_m_per_s is None


@needs_data
def test_depth_meets_the_boxes() -> None:
    clip = DgpClip(DATA, scene="scene_01", scale=0.25, frames=slice(1, 2), cameras=("CAMERA_01",))
    frame = clip.frame(clip.keys[0])
    assert frame.depth_m is not None
    camera_from_world = np.linalg.inv(frame.camera.world_from_camera)
    met = []
    for box in frame.boxes:
        centre = camera_from_world @ box.world_from_box @ np.array([0, 0, 0, 1.0])
        if not 3 < centre[2] < 45:
            continue
        column, row, _ = frame.camera.intrinsics @ centre[:3] / centre[2]
        if not (0 <= column < frame.camera.width and 0 <= row < frame.camera.height):
            continue
        off_m = frame.depth_m[int(row), int(column)] - centre[2]
        # In the queue some cars hide others; but nothing is seen through a box.
        assert off_m < max(box.size_m)
        met.append(off_m > -max(box.size_m))
    assert sum(met) >= 3


@needs_data
def test_six_cameras_move_together() -> None:
    clip = open_clip(f"dgp:{DATA}?scene=scene_02&scale=0.1")
    assert isinstance(clip, Clip)
    assert len(clip.cameras) == 6 and len(clip.keys) == 18
    frames = [clip.frame(key) for key in clip.keys[6:12]]
    speeds = [float(np.linalg.norm(frame.camera.velocity_m_per_s)) for frame in frames]
    np.testing.assert_allclose(12.7, speeds, atol=0.1)
    for frame in frames:
        assert frame.time_s == pytest.approx(0.1, abs=1e-3)
        # The cameras look along the road: their pictures stand upright in the world.
        assert frame.camera.world_from_camera[:3, 1] @ clip.up_world < -0.98
    forward = {frame.key.camera: frame.camera.world_from_camera[:3, 2] for frame in frames}
    assert forward["CAMERA_01"] @ forward["CAMERA_09"] < -0.98


@needs_data
def test_ground_is_below_all_cameras_at_one_height() -> None:
    clip = DgpClip(DATA / "test_scene", scene="scene_02", scale=0.2, frames=slice(1, 2))
    heights = []
    for key in clip.keys:
        if key.camera not in ("CAMERA_01", "CAMERA_05", "CAMERA_06"):
            continue
        frame = clip.frame(key)
        assert frame.depth_m is not None
        row, column = int(0.62 * frame.camera.height), frame.camera.width // 2
        ray = np.linalg.inv(frame.camera.intrinsics) @ np.array([column, row, 1.0])
        point = frame.camera.world_from_camera @ np.array([*ray * frame.depth_m[row, column], 1])
        heights.append(point[2])
    assert np.ptp(heights) < 0.25


def test_a_small_scene_reads(tmp_path: Path) -> None:
    clip = DgpClip(_written(tmp_path))
    frame = clip.frame(clip.keys[0])
    assert clip.cameras == ("CAM",) and clip.name == "dgp-scene_a"
    assert frame.depth_m is not None
    np.testing.assert_allclose(10.0, frame.depth_m, rtol=0.02)
    assert not frame.image.flags.writeable and not frame.depth_m.flags.writeable
    assert [box.class_name for box in frame.boxes] == ["Car"]
    np.testing.assert_allclose([15.0, 0, 1], frame.boxes[0].world_from_box[:3, 3])
    assert clip.frame(clip.keys[1]).time_s == pytest.approx(0.1)
    np.testing.assert_allclose([10, 0, 0], frame.camera.velocity_m_per_s, atol=1e-6)


def _edit(*path: str | int, value: Any) -> Callable[[Any], None]:
    def apply(node: Any) -> None:
        for step in path[:-1]:
            node = node[step]
        if value is None:
            del node[path[-1]]
        else:
            node[path[-1]] = value

    return apply


IMAGE = ("data", 0, "datum", "image")


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (_edit("samples", value=None), "has no 'samples'"),
        (_edit("samples", value=3), "samples must be a list, is a number"),
        (_edit("samples", value=[]), "samples is empty"),
        (_edit(*IMAGE, "pose", "rotation", "qw", value="x"), r"qw must be a number, is text"),
        (_edit(*IMAGE, "pose", "rotation", "qw", value=float("nan")), "qw must be a finite"),
        (_edit(*IMAGE, "pose", "rotation", "qw", value=5.0), "quaternion of length"),
        (_edit(*IMAGE, "filename", value="../../../etc/passwd"), "which leaves"),
        (_edit(*IMAGE, "filename", value="/etc/passwd"), "which leaves"),
        (_edit(*IMAGE, "filename", value="rgb/\0.png"), "which leaves"),
        (_edit(*IMAGE, "width", value=10**9), "camera size"),
        (_edit("data", 0, "id", "timestamp", value="noon"), "timestamp is not a time"),
        (_edit("data", 0, "id", "name", value="../CAM"), "must be letters"),
        (_edit("data", 0, "id", "name", value="OTHER"), "not in the sample's calibration"),
        (_edit("samples", 0, "datum_keys", value=["nobody"]), "not the key of any datum"),
    ],
)
def test_damaged_fields_are_named(
    tmp_path: Path, edit: Callable[[Any], None], expected: str
) -> None:
    root = _written(tmp_path, edit)
    with pytest.raises((ClipError, CalibrationError), match=expected) as caught:
        DgpClip(root)
    assert "scene_1.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"{", b"[" * 100_000, b"\xff\xfe{}", b"[]", b'"text"'])
def test_json_that_is_none_is_named(tmp_path: Path, content: bytes) -> None:
    root = _written(tmp_path)
    (root / "scene_a" / "scene_1.json").write_bytes(content)
    with pytest.raises(ClipError, match=r"scene_1\.json"):
        DgpClip(root)


def test_missing_files_are_named(tmp_path: Path) -> None:
    root = _written(tmp_path)
    for name in ("rgb.png", "cloud.npz", "boxes.json"):
        clip = DgpClip(root)
        (root / "scene_a" / name).rename(tmp_path / "aside")
        with pytest.raises(ClipError, match=name):
            clip.frame(clip.keys[0])
        (tmp_path / "aside").rename(root / "scene_a" / name)
    (root / "scene_a" / "calibration" / "k.json").unlink()
    with pytest.raises(ClipError, match=r"k\.json is missing"):
        DgpClip(root)
    with pytest.raises(ClipError, match="0 files scene_dataset"):
        DgpClip(tmp_path / "data" / "scene_a")


def test_a_pickled_cloud_is_refused(tmp_path: Path) -> None:
    root = _written(tmp_path)
    np.savez(root / "scene_a" / "cloud.npz", data=np.array([{"a": 1}], object))
    clip = DgpClip(root)
    with pytest.raises(ClipError, match=r"cloud\.npz cannot be read as an array"):
        clip.frame(clip.keys[0])


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    root = _written(tmp_path)
    Image.new("RGB", (10, 10)).save(root / "scene_a" / "rgb.png")
    clip = DgpClip(root)
    with pytest.raises(ClipError, match=r"rgb\.png is 10x10, the scene says 80x48"):
        clip.frame(clip.keys[0])


def test_unknown_scene_and_camera_list_the_choices(tmp_path: Path) -> None:
    root = _written(tmp_path)
    with pytest.raises(ArgumentError, match=r"choose one of scene_a"):
        DgpClip(root, scene="scene_9")
    with pytest.raises(ArgumentError, match="the scene has CAM"):
        DgpClip(root, cameras=("FRONT",))


def _motion(pose: dict[str, dict[str, float]]) -> NDArray[np.float64]:
    w, x, y, z = (pose["rotation"][part] for part in ("qw", "qx", "qy", "qz"))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    motion[:3, :3] += 2 * (w * cross + cross @ cross)
    motion[:3, 3] = [pose["translation"][axis] for axis in "xyz"]
    return motion


def _written(folder: Path, edit: Callable[[Any], None] | None = None) -> Path:
    """A data set of one scene with two moments before a wall 10 m ahead; its folder."""
    root = folder / "data"
    scene = root / "scene_a"
    for name in ("calibration", "ontology"):
        (scene / name).mkdir(parents=True)
    moved = {**CAMERA_POSE, "translation": {"x": 6.0, "y": 0.0, "z": 1.0}}
    data = [
        {
            "datum": {"image": {"filename": "rgb.png", "width": 80, "height": 48, "pose": pose}},
            "id": {"name": "CAM", "timestamp": f"2019-06-27T14:30:2{index}.{1 - index}00000Z"},
            "key": f"image{index}",
        }
        for index, pose in enumerate((CAMERA_POSE, moved))
    ]
    data[1]["id"]["timestamp"] = "2019-06-27T14:30:20.200000Z"  # type: ignore[index]
    cloud = {"filename": "cloud.npz", "annotations": {"1": "boxes.json"}, "pose": UNIT_POSE}
    data.append(
        {
            "datum": {"point_cloud": cloud},
            "id": {"name": "LIDAR", "timestamp": data[0]["id"]["timestamp"]},  # type: ignore[index]
            "key": "cloud",
        }
    )
    samples = [
        {
            "id": {"timestamp": item["id"]["timestamp"]},  # type: ignore[index]
            "calibration_key": "k",
            "datum_keys": [item["key"], "cloud"],
        }
        for item in data[:2]
    ]
    description = copy.deepcopy({"data": data, "samples": samples, "ontologies": {"1": "o"}})
    if edit is not None:
        edit(description)
    lens = {"fx": 60.0, "fy": 60.0, "cx": 39.5, "cy": 23.5, "skew": 0.0}
    box = {
        "length": 4.0,
        "width": 2.0,
        "height": 1.5,
        "pose": {**UNIT_POSE, "translation": {"x": 10.0, "y": 0.0, "z": 0.0}},
    }
    files = {
        root / "scene_dataset_v1.json": {
            "scene_splits": {"0": {"filenames": ["scene_a/scene_1.json"]}}
        },
        scene / "scene_1.json": description,
        scene / "calibration" / "k.json": {"names": ["CAM"], "intrinsics": [lens]},
        scene / "ontology" / "o.json": {"items": [{"id": 2, "name": "Car"}]},
        scene / "boxes.json": {"annotations": [{"box": box, "class_id": 2, "instance_id": 7}]},
    }
    for path, content in files.items():
        path.write_text(json.dumps(content))
    Image.fromarray(np.full((48, 80, 3), (90, 60, 40), np.uint8)).save(scene / "rgb.png")
    sideways, upward = np.meshgrid(np.linspace(-8, 8, 60), np.linspace(-5, 5, 40))
    wall = np.stack([np.full_like(sideways, 10.0), sideways, upward], axis=-1).reshape(-1, 3)
    np.savez(scene / "cloud.npz", data=wall)
    return root
