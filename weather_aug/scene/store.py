"""The scene folder: one JSON manifest and, per frame, a picture and two arrays.

    scene.json                          version, street axes, cameras, light, files, own digest
    frames/000012_front.png             the recorded picture, lossless
    frames/000012_front.depth.npy       (H, W) float16 z-depth, metres, inf for the sky
    frames/000012_front.label.npy       (H, W) uint8 train ids, where the clip is labelled
    frames/000012_front.boxes.json      tracked boxes, where there are any
    shelter.npy                         (A, L) float32 undersides over the street, if there are any

Data only: nothing in it can run code, every file has its size and SHA-256 in the manifest, and the
manifest has its own.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug._checks import MAX_PIXELS
from weather_aug._png import png_bytes
from weather_aug.clip.types import RIGID_TOLERANCE, Camera, Frame, FrameKey
from weather_aug.edit.ambience import CAMERA_HEIGHT_M, CAMERA_HEIGHT_RANGE_M, Ambience
from weather_aug.errors import ArgumentError, DataError, IntegrityError, SceneError, printable
from weather_aug.particles.shelter import CELL_M, Shelter
from weather_aug.scene.boxes import encode_boxes, read_boxes
from weather_aug.taxonomy import CLASSES, IGNORE

FORMAT = "weather_aug scene"
VERSION = 1
MANIFEST = "scene.json"
FRAMES = "frames"
SHELTER = "shelter.npy"
LIGHTS = ("sky", "middle", "ground", "airlight")
MAX_FRAMES = 20_000
MAX_MANIFEST_BYTES = 64 * 2**20
"""More than MAX_FRAMES entries of the longest names take, so that what is built can be opened."""

LARGEST = 1e10
"""No coordinate (metres, pixels), speed or time (seconds) of a drive is greater."""

_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_SUFFIXES = {"image": "png", "depth": "depth.npy", "label": "label.npy", "boxes": "boxes.json"}
"""Of the file of each part of a frame."""
_DEPTH, _LABEL, _COVER = "<f2", "|u1", "<f4"
_PNG_START = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_MALFORMED = (
    *(KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError),
    RecursionError,
)


@dataclass(frozen=True)
class StoredFile:
    """A file's size and digest, as the manifest records them."""

    size: int
    sha256: str


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What the manifest says of one frame."""

    key: FrameKey
    time_s: float
    camera: Camera
    light: Mapping[str, NDArray[np.float64]]
    """Linear RGB of `sky`, `middle` and `ground` (medians) and of the frame's own `airlight`."""
    files: Mapping[str, str]
    """Relative path by part: `image`, `depth`, and `label` and `boxes` where there are any."""
    camera_height_m: float = CAMERA_HEIGHT_M
    """Over the road, as this frame shows it."""


@dataclass(frozen=True, eq=False)
class ShelterRecord:
    """What the manifest says of the map of covers."""

    origin_m: NDArray[np.float64]
    cell_m: float
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Manifest:
    """A scene folder's table of contents."""

    name: str
    editor: str
    weathers: tuple[str, ...]
    axes_world: NDArray[np.float64]
    airlight: NDArray[np.float64] | None
    """Of the whole drive, linear RGB; None where pictures are unrelated and each has its own."""
    frames: tuple[FrameRecord, ...]
    files: Mapping[str, StoredFile]
    shelter: ShelterRecord | None = None
    digest: str = ""
    """SHA-256 of the manifest's bytes; it names the scene's content, since it lists all digests."""
    by_key: Mapping[FrameKey, FrameRecord] = field(init=False)
    _height_by_camera_m: Mapping[str, float] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_key", {record.key: record for record in self.frames})
        heights: dict[str, list[float]] = {}
        for record in self.frames:
            heights.setdefault(record.key.camera, []).append(record.camera_height_m)
        median = {camera: float(np.median(values)) for camera, values in heights.items()}
        object.__setattr__(self, "_height_by_camera_m", median)

    def camera_height_m(self, camera: str) -> float:
        """Height of a camera over the road, metres: the median of its frames."""
        return self._height_by_camera_m[camera]


def check_name(what: str, name: Any) -> str:
    """Return a name that may stand in a file name and on a terminal, or refuse it."""
    if not isinstance(name, str) or not _SAFE_NAME.fullmatch(name):
        raise SceneError(f"{what} {printable(name)!r} must be letters, digits, '-' and '_'")
    return name


def encode_frame(frame: Frame) -> dict[str, bytes]:
    """Bytes of each part of a frame; the same frame gives the same bytes."""
    assert frame.depth_m is not None
    depth = np.asarray(frame.depth_m, np.float32)
    if np.isnan(depth).all():
        raise SceneError(f"frame {frame.key}: depth is NaN everywhere; repair the depth source")
    _check_label(frame)
    check_scale(frame.key, frame.camera, frame.time_s)
    with np.errstate(over="ignore"):
        stored = np.where(depth > 0, depth, np.inf).astype(np.float16)
    parts = {"image": png_bytes(frame.image), "depth": _npy(stored, _DEPTH)}
    if frame.label is not None:
        parts["label"] = _npy(frame.label, _LABEL)
    if frame.boxes:
        parts["boxes"] = encode_boxes(frame.key, frame.boxes)
    return parts


def part_path(key: FrameKey, part: str) -> str:
    """Relative path of one part of a frame."""
    return f"{FRAMES}/{key}.{_SUFFIXES[part]}"


def frame_record(frame: Frame, ambience: Ambience) -> dict[str, Any]:
    """The manifest's entry for a frame, as JSON values."""
    camera = frame.camera
    present = {"image": True, "depth": True, "label": frame.label is not None}
    present["boxes"] = bool(frame.boxes)
    return {
        "time_index": frame.key.time_index,
        "camera": frame.key.camera,
        "time_s": frame.time_s,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": camera.intrinsics.tolist(),
        "world_from_camera": camera.world_from_camera.tolist(),
        "exposure_s": camera.exposure_s,
        "aperture_m": camera.aperture_m,
        "velocity_m_per_s": camera.velocity_m_per_s.tolist(),
        "angular_velocity_rad_per_s": camera.angular_velocity_rad_per_s.tolist(),
        "light": {name: getattr(ambience, name).tolist() for name in LIGHTS},
        "camera_height_m": ambience.camera_height_m,
        "files": {part: part_path(frame.key, part) for part in _SUFFIXES if present[part]},
    }


def encode_shelter(shelter: Shelter) -> tuple[dict[str, Any], bytes]:
    """The manifest's entry for a map of covers, as JSON values, and the bytes of its file."""
    record = {
        "file": SHELTER,
        "origin_m": shelter.origin_m.tolist(),
        "cell_m": shelter.cell_m,
        "shape": list(shelter.cover_m.shape),
    }
    return record, _npy(shelter.cover_m, _COVER)


def manifest_bytes(content: dict[str, Any]) -> bytes:
    """The manifest as it stands on disk, with its own digest as the last field."""
    content = {"format": FORMAT, "version": VERSION} | content
    sealed = content | {"sha256": _seal_of(content)}
    return (json.dumps(sealed, indent=1, allow_nan=False) + "\n").encode()


def _seal_of(content: Mapping[str, Any]) -> str:
    """SHA-256 of the content without its own digest, however its text is laid out."""
    unsealed = {name: value for name, value in content.items() if name != "sha256"}
    text = json.dumps(unsealed, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return _files.sha256_of(text.encode())


def read_manifest(folder: Path) -> Manifest:
    """Read and check a scene's manifest; every file must be there with its recorded size.

    Raises:
        SceneError: If the folder is no scene, of a newer version, or its manifest is malformed.
        IntegrityError: If the manifest has changed, or a file is missing or has another size.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise SceneError(
            f"{printable(folder, 200)} is not a scene (no {MANIFEST}); make one with "
            "`weather-aug build CLIP --out SCENE`"
        )
    content = _files.read_json(path, MAX_MANIFEST_BYTES)
    try:
        # A stranger's numbers overflow before they are refused.
        with np.errstate(over="ignore"):
            manifest = _parse(content, path)
        intact = content.get("sha256") == _seal_of(content)
    except SceneError:
        raise
    except _MALFORMED as error:
        raise SceneError(
            f"{printable(path, 200)} is malformed: {type(error).__name__} {printable(error)}; "
            "build the scene again"
        ) from None
    if not intact:
        raise IntegrityError(
            f"{printable(path, 200)} has changed since it was written; build the scene again"
        )
    for relative, stored in manifest.files.items():
        file = _existing(folder, relative)
        if file.stat().st_size != stored.size:
            raise IntegrityError(
                f"{printable(file, 200)} has {file.stat().st_size} bytes, {stored.size} were "
                "written; build the scene again"
            )
    return manifest


def damaged_files(folder: Path, manifest: Manifest) -> list[str]:
    """One sentence for each file whose bytes differ from the recorded ones."""
    problems = []
    for relative, stored in manifest.files.items():
        file = folder / relative
        try:
            changed = _files.sha256_of_file(file) != stored.sha256
        except OSError as error:
            problems.append(f"{printable(file, 200)} cannot be read: {error.strerror}")
            continue
        if changed:
            problems.append(
                f"{printable(file, 200)} has changed since the scene was built; build it again"
            )
    return problems


def read_frame(folder: Path, record: FrameRecord) -> Frame:
    """One frame; depth and label are memory-mapped, picture and boxes are decoded.

    Raises:
        SceneError: If a file of it cannot be read.
    """
    image = _picture(folder / record.files["image"], record.camera)
    depth, label = read_surfaces(folder, record)
    boxes = read_boxes(folder / record.files["boxes"]) if "boxes" in record.files else ()
    return Frame(record.key, record.time_s, record.camera, image, label, depth, boxes=boxes)


def read_surfaces(
    folder: Path, record: FrameRecord
) -> tuple[NDArray[Any], NDArray[np.uint8] | None]:
    """Depth and label of one frame, memory-mapped.

    Raises:
        SceneError: If a file of it cannot be read.
    """
    shape = (record.camera.height, record.camera.width)
    label = record.files.get("label")
    return (
        _mapped(folder / record.files["depth"], _DEPTH, shape),
        None if label is None else _mapped(folder / label, _LABEL, shape),
    )


def read_shelter(folder: Path, manifest: Manifest) -> Shelter | None:
    """The map of covers; None where the scene has none.

    Raises:
        SceneError: If its file cannot be read.
    """
    record = manifest.shelter
    if record is None:
        return None
    cover_m = _mapped(folder / SHELTER, _COVER, record.shape)
    try:
        return Shelter(cover_m, record.origin_m, manifest.axes_world, record.cell_m)
    except ArgumentError as error:
        raise SceneError(
            f"{printable(folder / SHELTER, 200)}: {error}; build the scene again"
        ) from None


def check_scale(key: FrameKey, camera: Camera, time_s: float) -> None:
    """Refuse numbers that no drive has and that arithmetic in single precision cannot hold."""
    lengths = (camera.intrinsics, camera.world_from_camera)
    speeds = (camera.velocity_m_per_s, camera.angular_velocity_rad_per_s)
    largest = max(float(np.abs(value).max()) for value in (*lengths, *speeds))
    if not (largest <= LARGEST and abs(time_s) <= LARGEST and min(camera.focal_px) >= 1):
        raise SceneError(
            f"frame {key}: its calibration, pose, velocity or time ({time_s:g} s) holds a number "
            f"beyond {LARGEST:g}, or a focal length below 1 pixel; repair the clip's files"
        )


def _check_label(frame: Frame) -> None:
    if frame.label is None:
        return
    unknown = frame.label[(frame.label >= len(CLASSES)) & (frame.label != IGNORE)]
    if unknown.size:
        raise SceneError(
            f"frame {frame.key}: label holds {int(unknown[0])}, which is no train id; choose the "
            "clip's taxonomy with taxonomy=…"
        )


def _npy(array: NDArray[Any], dtype: str) -> bytes:
    return _npy_header(dtype, array.shape) + np.ascontiguousarray(array, dtype).tobytes()


def _npy_header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """The only header that is written and read: numpy's parser runs a tokenizer over the text."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + text.ljust(117).encode() + b"\n"


def _picture(path: Path, camera: Camera) -> NDArray[np.uint8]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{printable(path, 200)} cannot be read: {error.strerror}") from None
    # Checked before decoding: a small file may claim gigabytes of pixels.
    expected = _PNG_START + struct.pack(">II", camera.width, camera.height)
    image = None
    if data.startswith(expected):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise SceneError(
            f"{printable(path, 200)} is not a readable PNG of {camera.width}x{camera.height} "
            "pixels; build the scene again"
        )
    return np.asarray(image, np.uint8)


def _mapped(path: Path, dtype: str, shape: tuple[int, int]) -> NDArray[Any]:
    header = _npy_header(dtype, shape)
    try:
        with path.open("rb") as file:
            start = file.read(len(header))
        array = np.memmap(path, dtype, "r", len(header), shape) if start == header else None
    except (OSError, ValueError) as error:
        raise SceneError(f"{printable(path, 200)} cannot be read: {printable(error)}") from None
    if array is None:
        raise SceneError(
            f"{printable(path, 200)} is not a {dtype} array of shape {shape}; build the scene again"
        )
    return np.asarray(array)


def _existing(folder: Path, relative: str) -> Path:
    try:
        return _files.file_inside(folder, relative)
    except DataError as error:
        raise IntegrityError(f"{error}; build the scene again") from None


def _parse(content: Any, path: Path) -> Manifest:
    if content["format"] != FORMAT:
        raise SceneError(f"{printable(path, 200)} is not a {FORMAT}")
    if content["version"] != VERSION:
        raise SceneError(
            f"{printable(path, 200)} has version {printable(content['version'])}, this program "
            f"reads version {VERSION}; update weather_aug or build the scene again"
        )
    files = {
        str(relative): StoredFile(int(entry["size"]), str(entry["sha256"]))
        for relative, entry in content["files"].items()
    }
    frames = tuple(parse_frame(entry) for entry in content["frames"])
    if not frames or len({record.key for record in frames}) < len(frames):
        raise SceneError(f"{printable(path, 200)} has no frames, or one twice; build it again")
    for record in frames:
        unlisted = sorted(set(record.files.values()) - set(files))
        if unlisted:
            raise SceneError(f"{printable(path, 200)}: {printable(unlisted[0])} has no digest")
    return Manifest(
        name=check_name("name", content["name"]),
        editor=check_name("editor", content["editor"]),
        weathers=tuple(check_name("weather", name) for name in content["weathers"]),
        axes_world=_axes(content["axes_world"]),
        airlight=None if content["airlight"] is None else _light(content["airlight"]),
        frames=frames,
        files=files,
        shelter=_parse_shelter(content.get("shelter"), files),
        digest=_files.sha256_of_file(path),
    )


def parse_frame(entry: Any) -> FrameRecord:
    """A frame's record from the manifest's entry; whatever is malformed raises."""
    camera = Camera(
        intrinsics=entry["intrinsics"],
        world_from_camera=entry["world_from_camera"],
        width=int(entry["width"]),
        height=int(entry["height"]),
        exposure_s=float(entry["exposure_s"]),
        aperture_m=float(entry["aperture_m"]),
        velocity_m_per_s=entry["velocity_m_per_s"],
        angular_velocity_rad_per_s=entry["angular_velocity_rad_per_s"],
    )
    files = {part: str(entry["files"][part]) for part in ("image", "depth")}
    # Scenes of before boxes were stored have none.
    files |= {
        part: str(entry["files"][part]) for part in ("label", "boxes") if part in entry["files"]
    }
    light = {name: _light(entry["light"][name]) for name in LIGHTS}
    key = FrameKey(int(entry["time_index"]), check_name("camera", entry["camera"]))
    time_s = float(entry["time_s"])
    check_scale(key, camera, time_s)
    # Scenes of before it was measured have none.
    height_m = float(entry.get("camera_height_m", CAMERA_HEIGHT_M))
    if not CAMERA_HEIGHT_RANGE_M[0] <= height_m <= CAMERA_HEIGHT_RANGE_M[1]:
        raise ValueError("camera_height_m is out of its range")
    return FrameRecord(key, time_s, camera, light, files, height_m)


def _parse_shelter(entry: Any, files: Mapping[str, StoredFile]) -> ShelterRecord | None:
    if entry is None:
        return None
    shape = (int(entry["shape"][0]), int(entry["shape"][1]))
    if entry["file"] != SHELTER or SHELTER not in files or len(entry["shape"]) != 2:
        raise ValueError("the shelter map has no file, or another shape")
    if not 0 < min(shape) <= max(shape) <= MAX_PIXELS // min(shape):
        raise ValueError("the shelter map is empty, or too large")
    cell_m = float(entry["cell_m"])
    if cell_m != CELL_M:
        raise ValueError("the shelter map has cells of another size")
    return ShelterRecord(_array(entry["origin_m"], (3,)), cell_m, shape)


def _axes(value: Any) -> NDArray[np.float64]:
    axes = _array(value, (3, 3))
    if np.abs(axes @ axes.T - np.eye(3)).max() > RIGID_TOLERANCE:
        raise ValueError("axes_world are not perpendicular unit vectors")
    return axes


def _light(value: Any) -> NDArray[np.float64]:
    light = _array(value, (3,))
    if not ((light >= 0) & (light <= 1)).all():
        raise ValueError("light must be in [0, 1]")
    return light


def _array(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}")
    array.flags.writeable = False
    return array
