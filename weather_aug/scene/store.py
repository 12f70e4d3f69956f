"""The scene folder: one JSON manifest and, per frame, a picture and two arrays.

    scene.json                          version, street axes, airlight, cameras, files
    frames/000012_front.png             the recorded picture, lossless
    frames/000012_front.depth.npy       (H, W) float16 z-depth, metres, inf for the sky
    frames/000012_front.label.npy       (H, W) uint8 train ids, where the clip is labelled

Data only: nothing in it can run code, and every file has its size and SHA-256 in the manifest.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import DataError, IntegrityError, SceneError, printable
from weather_aug.render.light import Ambience

FORMAT = "weather_aug scene"
VERSION = 1
MANIFEST = "scene.json"
FRAMES = "frames"

_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_PNG_LEVEL = 3


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
    light: Mapping[str, list[float]]
    """Linear RGB medians of `sky`, `middle` and `ground`."""
    files: Mapping[str, str]
    """Relative path by part: `image`, `depth`, and `label` where there is one."""


@dataclass(frozen=True, eq=False)
class Manifest:
    """A scene folder's table of contents."""

    name: str
    editor: str
    weathers: tuple[str, ...]
    axes_world: NDArray[np.float64]
    airlight: NDArray[np.float64]
    frames: tuple[FrameRecord, ...]
    files: Mapping[str, StoredFile]
    digest: str = ""
    """SHA-256 of the manifest's bytes; it names the scene's content, since it lists all digests."""
    by_key: Mapping[FrameKey, FrameRecord] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_key", {record.key: record for record in self.frames})


def check_name(what: str, name: str) -> str:
    """Return a name that may stand in a file name, or refuse it."""
    if not _SAFE_NAME.fullmatch(name):
        raise SceneError(f"{what} {printable(name)!r} must be letters, digits, '-' and '_'")
    return name


def encode_frame(frame: Frame) -> dict[str, bytes]:
    """Bytes of each part of a frame; the same frame gives the same bytes."""
    assert frame.depth_m is not None
    depth = np.asarray(frame.depth_m, np.float32)
    if np.isnan(depth).all():
        raise SceneError(f"frame {frame.key}: depth is NaN everywhere; repair the depth source")
    with np.errstate(over="ignore"):
        stored = np.where(depth > 0, depth, np.inf).astype(np.float16)
    ok, png = cv2.imencode(
        ".png",
        cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR),
        [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL],
    )
    if not ok:
        raise SceneError(f"frame {frame.key}: the picture cannot be encoded as PNG")
    parts = {"image": png.tobytes(), "depth": _npy(stored)}
    if frame.label is not None:
        parts["label"] = _npy(np.ascontiguousarray(frame.label))
    return parts


def part_path(key: FrameKey, part: str) -> str:
    """Relative path of one part of a frame."""
    suffix = {"image": "png", "depth": "depth.npy", "label": "label.npy"}[part]
    return f"{FRAMES}/{key}.{suffix}"


def frame_record(frame: Frame, ambience: Ambience) -> dict[str, Any]:
    """The manifest's entry for a frame, as JSON values."""
    camera = frame.camera
    parts = ("image", "depth") if frame.label is None else ("image", "depth", "label")
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
        "light": {name: getattr(ambience, name).tolist() for name in ("sky", "middle", "ground")},
        "files": {part: part_path(frame.key, part) for part in parts},
    }


def manifest_bytes(content: dict[str, Any]) -> bytes:
    """The manifest as it stands on disk."""
    head = {"format": FORMAT, "version": VERSION}
    return (json.dumps(head | content, indent=1, allow_nan=False) + "\n").encode()


def read_manifest(folder: Path) -> Manifest:
    """Read and check a scene's manifest; every file must be there with its recorded size.

    Raises:
        SceneError: If the folder is no scene, of a newer version, or its manifest is malformed.
        IntegrityError: If a file is missing or has another size.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise SceneError(
            f"{printable(folder, 200)} is not a scene (no {MANIFEST}); make one with "
            "`weather-aug build CLIP --out SCENE`"
        )
    content = _files.read_json(path)
    try:
        manifest = _parse(content, path)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(
            f"{printable(path, 200)} is malformed: {type(error).__name__} {printable(error)}; "
            "build the scene again"
        ) from None
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
        if _files.sha256_of_file(file) != stored.sha256:
            problems.append(f"{printable(file, 200)} has changed since the scene was built")
    return problems


def read_frame(folder: Path, record: FrameRecord) -> Frame:
    """One frame; depth and label are memory-mapped, the picture is decoded."""
    key = record.key
    image_path = folder / record.files["image"]
    encoded = np.frombuffer(image_path.read_bytes(), np.uint8)
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise SceneError(f"{printable(image_path, 200)} is not a readable PNG; build it again")
    label = record.files.get("label")
    return Frame(
        key,
        record.time_s,
        record.camera,
        image,
        None if label is None else _mapped(folder / label, np.uint8),
        _mapped(folder / record.files["depth"], np.float16),
    )


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _mapped(path: Path, dtype: type) -> NDArray[Any]:
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise SceneError(f"{printable(path, 200)} cannot be read: {printable(error)}") from None
    if array.dtype != dtype:
        raise SceneError(f"{printable(path, 200)} holds {array.dtype}, not {np.dtype(dtype)}")
    return array


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
    frames = tuple(_parse_frame(entry) for entry in content["frames"])
    for record in frames:
        unlisted = sorted(set(record.files.values()) - set(files))
        if unlisted:
            raise SceneError(f"{printable(path, 200)}: {printable(unlisted[0])} has no digest")
    return Manifest(
        name=str(content["name"]),
        editor=str(content["editor"]),
        weathers=tuple(str(w) for w in content["weathers"]),
        axes_world=_array(content["axes_world"], (3, 3)),
        airlight=_array(content["airlight"], (3,)),
        frames=frames,
        files=files,
        digest=_files.sha256_of_file(path),
    )


def _parse_frame(entry: Any) -> FrameRecord:
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
    if "label" in entry["files"]:
        files["label"] = str(entry["files"]["label"])
    light = {name: entry["light"][name] for name in ("sky", "middle", "ground")}
    for value in light.values():
        _array(value, (3,))
    key = FrameKey(int(entry["time_index"]), str(entry["camera"]))
    return FrameRecord(key, float(entry["time_s"]), camera, light, files)


def _array(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}")
    array.flags.writeable = False
    return array
