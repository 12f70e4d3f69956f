"""What a scene's manifest says, as checked values: of the drive, of each frame, of the files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import MAX_PIXELS
from weather_aug.clip.types import RIGID_TOLERANCE, Camera, Frame, FrameKey
from weather_aug.edit.ambience import CAMERA_HEIGHT_M, CAMERA_HEIGHT_RANGE_M, Ambience
from weather_aug.errors import SceneError, printable
from weather_aug.particles.shelter import CELL_M
from weather_aug.render.fields import RigMotion
from weather_aug.scene.layers import PARTS as LAYER_PARTS
from weather_aug.scene.layers import LayersRecord, Street, parse_layers
from weather_aug.scene.route import route_of
from weather_aug.scene.viewpoint import raised_height_m

if TYPE_CHECKING:
    from weather_aug.scene.backgrounds_record import BackgroundsRecord
    from weather_aug.scene.reconstruction_record import ReconstructionRecord

FRAMES = "frames"
SHELTER = "shelter.npy"
LIGHTS = ("sky", "middle", "ground", "airlight")
LARGEST = 1e10
"""No coordinate (metres, pixels), speed or time (seconds) of a drive is greater."""
SUFFIXES = {"image": "png", "depth": "depth.npy", "label": "label.npy", "boxes": "boxes.json"}
SUFFIXES |= {part: f"{part}.npy" for part in LAYER_PARTS}
"""Of the file of each part of a frame."""

_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


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
    """Relative path by part: `image`, `depth`, and of all others those that there are."""
    camera_height_m: float = CAMERA_HEIGHT_M
    """Over the road, as this frame shows it."""
    layers: LayersRecord | None = None
    """None in a scene of before they were stored."""


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
    reconstruction: ReconstructionRecord | None = None
    """None in a scene that was built without Gaussians."""
    backgrounds: BackgroundsRecord | None = None
    """None in a scene whose editor edits while rendering."""
    digest: str = ""
    """SHA-256 of the manifest's bytes; it names the scene's content, since it lists all digests."""
    by_key: Mapping[FrameKey, FrameRecord] = field(init=False)
    _height_by_camera_m: Mapping[str, float] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_key", {record.key: record for record in self.frames})
        object.__setattr__(self, "_height_by_camera_m", _heights_m(self.frames))

    @property
    def is_drive(self) -> bool:
        """Whether the pictures are of one drive; unrelated ones have no airlight in common."""
        return self.airlight is not None

    @property
    def styles(self) -> tuple[str, ...]:
        """Of the stored backgrounds; none without."""
        return () if self.backgrounds is None else self.backgrounds.styles

    def camera_height_m(self, camera: str) -> float:
        """Height of a camera over the road, metres: the median of its frames."""
        return self._height_by_camera_m[camera]

    def raised_m(self, frame: Frame) -> float:
        """How much higher a frame's camera stands than the recorded one."""
        here, there = frame.camera, self.by_key[frame.key].camera
        return float(self.axes_world[2] @ (here.centre_world - there.centre_world))

    def ambience(self, record: FrameRecord, raised_m: float = 0.0) -> Ambience:
        """Light around a frame whose camera stands `raised_m` higher than it was recorded."""
        light = dict(record.light)
        if self.airlight is not None:
            light["airlight"] = self.airlight
        height_m = raised_height_m(self.camera_height_m(record.key.camera), raised_m)
        return Ambience(self.axes_world, **light, camera_height_m=height_m)


def _heights_m(frames: Iterable[FrameRecord]) -> dict[str, float]:
    heights: dict[str, list[float]] = {}
    for record in frames:
        heights.setdefault(record.key.camera, []).append(record.camera_height_m)
    return {camera: float(np.median(values)) for camera, values in heights.items()}


def streets(
    frames: Sequence[FrameRecord], axes_world: NDArray[np.float64], *, is_drive: bool
) -> dict[str, Street]:
    """What layers need to know of the drive, by camera.

    Args:
        frames: All of a scene.
        axes_world: (3, 3) of the street.
        is_drive: False for unrelated pictures; none of them tells where another was driven.
    """
    # One way for the rig: wheels leave the same tracks in all of its cameras.
    places: dict[int, list[NDArray[np.float64]]] = {}
    for record in frames:
        place = (axes_world @ record.camera.centre_world)[:2]
        places.setdefault(record.key.time_index, []).append(place)
    route = None
    if is_drive:
        route = route_of(np.array([np.mean(places[time], axis=0) for time in sorted(places)]))
    heights_m = _heights_m(frames)
    return {camera: Street(axes_world, height_m, route) for camera, height_m in heights_m.items()}


def rig_motion(frames: Sequence[FrameRecord], key: FrameKey) -> RigMotion:
    """Of a clip's first camera up to the moment of a frame, or to the last one before it."""
    first = frames[0]
    seen = [record for record in frames if record.key.camera == first.key.camera]
    before = [record for record in seen if record.key.time_index <= key.time_index]
    now = before[-1] if before else seen[0]
    return RigMotion(first.camera.world_from_camera, now.camera.world_from_camera)


def check_name(what: str, name: Any) -> str:
    """Return a name that may stand in a file name and on a terminal, or refuse it."""
    if not isinstance(name, str) or not _SAFE_NAME.fullmatch(name):
        raise SceneError(f"{what} {printable(name)!r} must be letters, digits, '-' and '_'")
    return name


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


def part_path(key: FrameKey, part: str) -> str:
    """Relative path of one part of a frame."""
    return f"{FRAMES}/{key}.{SUFFIXES[part]}"


def part_of(relative: str) -> str:
    """Which part of a frame a path of `part_path` holds."""
    suffix = relative.split(".", 1)[1]
    return next(part for part, known in SUFFIXES.items() if known == suffix)


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
    # Scenes of before boxes and layers were stored have none.
    files = {part: str(entry["files"][part]) for part in SUFFIXES if part in entry["files"]}
    layers = parse_layers(entry["layers"]) if "layers" in entry else None
    _check_parts(files, has_layers=layers is not None)
    light = {name: light_of(entry["light"][name]) for name in LIGHTS}
    key = FrameKey(int(entry["time_index"]), check_name("camera", entry["camera"]))
    time_s = float(entry["time_s"])
    check_scale(key, camera, time_s)
    # Scenes of before it was measured have none.
    height_m = float(entry.get("camera_height_m", CAMERA_HEIGHT_M))
    if not CAMERA_HEIGHT_RANGE_M[0] <= height_m <= CAMERA_HEIGHT_RANGE_M[1]:
        raise ValueError("camera_height_m is out of its range")
    return FrameRecord(key, time_s, camera, light, files, height_m, layers)


def _check_parts(files: Mapping[str, str], *, has_layers: bool) -> None:
    needed = {"image", "depth"}
    if has_layers:
        needed |= {"layers", "small"} | (set() if "label" in files else {"classes"})
    missing = needed - set(files)
    if missing or (not has_layers and "layers" in files):
        raise ValueError(f"a frame has no {min(missing, default='record of its layers')}")


def parse_shelter(entry: Any, files: Mapping[str, StoredFile]) -> ShelterRecord | None:
    """The record of the map of covers; whatever is malformed raises."""
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


def axes_of(value: Any) -> NDArray[np.float64]:
    """Perpendicular unit vectors (3, 3), or ValueError."""
    axes = _array(value, (3, 3))
    if np.abs(axes @ axes.T - np.eye(3)).max() > RIGID_TOLERANCE:
        raise ValueError("axes_world are not perpendicular unit vectors")
    return axes


def light_of(value: Any) -> NDArray[np.float64]:
    """Linear light (3,) in [0, 1], or ValueError."""
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
