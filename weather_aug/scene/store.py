"""The scene folder: one JSON manifest and, per frame, a picture and arrays.

    scene.json                          version, street axes, cameras, light, files, own digest
    frames/000012_front.png             the recorded picture, lossless
    frames/000012_front.depth.npy       (H, W) float16 z-depth, metres, inf for the sky
    frames/000012_front.label.npy       (H, W) uint8 train ids, where the clip is labelled
    frames/000012_front.boxes.json      tracked boxes, where there are any
    frames/000012_front.layers.npy …    what the editor knows of it; see `weather_aug.scene.layers`
    backgrounds/snow/000012_front.png   the picture in a style, where an editor made them before
    backgrounds/trained_on.txt          digests of what trained that editor, where it is known
    shelter.npy                         (A, L) float32 undersides over the street, if there are any
    gaussians/…                         the drive as Gaussians, if they were asked for; see
                                        `weather_aug.scene.reconstruction`

Data only: nothing in it can run code, every file has its size and SHA-256 in the manifest, and the
manifest has its own.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug._png import png_bytes
from weather_aug.clip.types import Camera, Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.diffusion.leakage import TrainedOn
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError, DataError, IntegrityError, SceneError, printable
from weather_aug.particles.shelter import Shelter
from weather_aug.scene.arrays import mapped, npy_bytes
from weather_aug.scene.backgrounds_record import TRAINED_ON, parse_backgrounds
from weather_aug.scene.boxes import encode_boxes, read_boxes
from weather_aug.scene.layers import PARTS as LAYER_PARTS
from weather_aug.scene.layers import read_layers as stored_layers
from weather_aug.scene.reconstruction_record import parse_reconstruction
from weather_aug.scene.records import (
    LIGHTS,
    SHELTER,
    Manifest,
    StoredFile,
    axes_of,
    check_name,
    check_scale,
    light_of,
    parse_frame,
    parse_shelter,
    part_path,
)

# Writers name a frame's record as this module's.
from weather_aug.scene.records import FrameRecord as FrameRecord
from weather_aug.taxonomy import CLASSES, IGNORE

FORMAT = "weather_aug scene"
VERSION = 1
MANIFEST = "scene.json"
MAX_FRAMES = 20_000
MAX_MANIFEST_BYTES = 112 * 2**20
"""More than MAX_FRAMES entries of the longest names take, so that what is built can be opened."""

_DEPTH, _LABEL, _COVER = "<f2", "|u1", "<f4"
_PNG_START = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_MALFORMED = (
    *(KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError),
    RecursionError,
)


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
    parts = {"image": png_bytes(frame.image), "depth": npy_bytes(stored, _DEPTH)}
    if frame.label is not None:
        parts["label"] = npy_bytes(frame.label, _LABEL)
    if frame.boxes:
        parts["boxes"] = encode_boxes(frame.key, frame.boxes)
    return parts


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
        "files": {part: part_path(frame.key, part) for part in present if present[part]},
    }


def encode_shelter(shelter: Shelter) -> tuple[dict[str, Any], bytes]:
    """The manifest's entry for a map of covers, as JSON values, and the bytes of its file."""
    record = {
        "file": SHELTER,
        "origin_m": shelter.origin_m.tolist(),
        "cell_m": shelter.cell_m,
        "shape": list(shelter.cover_m.shape),
    }
    return record, npy_bytes(shelter.cover_m, _COVER)


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
    image = read_picture(folder / record.files["image"], record.camera)
    depth, label = read_surfaces(folder, record)
    boxes = read_boxes(folder / record.files["boxes"]) if "boxes" in record.files else ()
    return Frame(record.key, record.time_s, record.camera, image, label, depth, boxes=boxes)


def read_layers(
    folder: Path, record: FrameRecord, label: NDArray[np.uint8] | None
) -> Layers | None:
    """What the editor knows of a frame with this label, memory-mapped; None if nothing is stored.

    Raises:
        SceneError: If a file of it cannot be read.
    """
    if record.layers is None:
        return None
    paths = {part: folder / record.files[part] for part in LAYER_PARTS if part in record.files}
    return stored_layers(record.layers, record.camera, label, paths)


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
        mapped(folder / record.files["depth"], _DEPTH, shape),
        None if label is None else mapped(folder / label, _LABEL, shape),
    )


def read_shelter(folder: Path, manifest: Manifest) -> Shelter | None:
    """The map of covers; None where the scene has none.

    Raises:
        SceneError: If its file cannot be read.
    """
    record = manifest.shelter
    if record is None:
        return None
    cover_m = mapped(folder / SHELTER, _COVER, record.shape)
    try:
        return Shelter(cover_m, record.origin_m, manifest.axes_world, record.cell_m)
    except ArgumentError as error:
        raise SceneError(
            f"{printable(folder / SHELTER, 200)}: {error}; build the scene again"
        ) from None


def read_trained_on(folder: Path, manifest: Manifest) -> TrainedOn | None:
    """What the editor of the backgrounds was trained on, as far as the scene knows; else None.

    Raises:
        DataError: If its file cannot be read.
        IntegrityError: If it has other bytes than were recorded.
    """
    if manifest.backgrounds is None or not manifest.backgrounds.recorded:
        return None
    return TrainedOn.read_file(folder / TRAINED_ON, manifest.files[TRAINED_ON].sha256)


def _check_label(frame: Frame) -> None:
    if frame.label is None:
        return
    unknown = frame.label[(frame.label >= len(CLASSES)) & (frame.label != IGNORE)]
    if unknown.size:
        raise SceneError(
            f"frame {frame.key}: label holds {int(unknown[0])}, which is no train id; choose the "
            "clip's taxonomy with taxonomy=…"
        )


def read_picture(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of a camera's size.

    Raises:
        SceneError: If the file is no PNG of that size.
    """
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
    manifest = manifest_of(content)
    frames, files = manifest.frames, manifest.files
    if not frames or len({record.key for record in frames}) < len(frames):
        raise SceneError(f"{printable(path, 200)} has no frames, or one twice; build it again")
    for record in frames:
        unlisted = sorted(set(record.files.values()) - set(files))
        if unlisted:
            raise SceneError(f"{printable(path, 200)}: {printable(unlisted[0])} has no digest")
    return replace(manifest, digest=_files.sha256_of_file(path))


def manifest_of(content: Mapping[str, Any]) -> Manifest:
    """The manifest of these JSON values; whatever is malformed raises."""
    files = {
        str(relative): StoredFile(int(entry["size"]), str(entry["sha256"]))
        for relative, entry in content["files"].items()
    }
    frames = tuple(parse_frame(entry) for entry in content["frames"])
    return Manifest(
        name=check_name("name", content["name"]),
        editor=check_name("editor", content["editor"]),
        weathers=tuple(check_name("weather", name) for name in content["weathers"]),
        axes_world=axes_of(content["axes_world"]),
        airlight=None if content["airlight"] is None else light_of(content["airlight"]),
        frames=frames,
        files=files,
        shelter=parse_shelter(content.get("shelter"), files),
        # Scenes of before there were any, or built without, have none.
        reconstruction=parse_reconstruction(content.get("reconstruction"), files),
        backgrounds=parse_backgrounds(content.get("backgrounds"), frames, files),
    )
