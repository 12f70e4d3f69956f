"""What a scene's manifest says of its Gaussians, as checked values: names, and shapes of arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from weather_aug.clip.types import FrameKey
from weather_aug.errors import printable
from weather_aug.scene.boxes import MAX_CLASS_NAME
from weather_aug.scene.records import LARGEST, StoredFile, check_name

GAUSSIANS = "gaussians"
MOST_LOG_SCALE = 40.0
"""exp of it and its square are numbers in single precision."""
MOST_LOGIT = 1000.0
MOST_COLOUR = 1000.0
MOST_HALF = 65504.0


class Kind(NamedTuple):
    """How an array is stored, and the greatest number in it."""

    dtype: str
    dimensions: int
    largest: float


SETS = {
    "means_m": Kind("<f4", 2, LARGEST),
    "quaternions": Kind("<f4", 2, LARGEST),
    "log_scales": Kind("<f4", 2, MOST_LOG_SCALE),
    "logit_opacities": Kind("<f4", 1, MOST_LOGIT),
    "sh": Kind("<f4", 3, MOST_COLOUR),
    "class_scores": Kind("<f2", 2, MOST_HALF),
}
_KINDS = {
    f"{which}_{name}": kind for which in ("background", "actor") for name, kind in SETS.items()
}
SCORES = ("background_class_scores", "actor_class_scores")
_OPTIONAL = (*SCORES, "support")
"""What is found out when the geometry is known."""
_KINDS |= {
    "owners": Kind("<i4", 1, 2**31 - 1),
    "offsets_m": Kind("<f4", 3, LARGEST),
    "sky_faces": Kind("<f4", 4, MOST_COLOUR),
    "sky_seen": Kind("|u1", 3, 1),
    "support": Kind("<f4", 1, 3e38),
    "track_times_s": Kind("<f8", 1, LARGEST),
    "track_poses": Kind("<f8", 3, LARGEST),
    "camera_intrinsics": Kind("<f8", 3, LARGEST),
    "camera_poses": Kind("<f8", 3, LARGEST),
    "camera_motions": Kind("<f8", 3, LARGEST),
    "camera_numbers": Kind("<f8", 2, LARGEST),
    "exposures": Kind("<f4", 3, MOST_COLOUR),
}
STYLE_KINDS = {
    "sh": Kind("<f2", 3, MOST_COLOUR),
    "actor_sh": Kind("<f2", 3, MOST_COLOUR),
    "sky": Kind("<f2", 4, MOST_COLOUR),
}


@dataclass(frozen=True)
class ActorRecord:
    """What the manifest says of a tracked object."""

    track_id: int
    class_name: str
    is_deformable: bool
    size_m: tuple[float, float, float]
    moments: int
    """How many of the tracks' poses are its own."""


@dataclass(frozen=True, eq=False)
class ReconstructionRecord:
    """What the manifest says of the Gaussians."""

    shapes: Mapping[str, tuple[int, ...]]
    """By name of the array."""
    actors: tuple[ActorRecord, ...]
    cameras: tuple[FrameKey, ...]
    """Frames with a refined camera, in the order of their arrays."""
    exposures: tuple[FrameKey, ...]
    styles: tuple[str, ...]
    fit: Mapping[str, float]
    """How well the frames were met: PSNR in dB, SSIM, …"""


def array_path(name: str) -> str:
    """Relative path of an array."""
    return f"{GAUSSIANS}/{name}.npy"


def parse_reconstruction(
    entry: Any, files: Mapping[str, StoredFile]
) -> ReconstructionRecord | None:
    """A record from the manifest's entry, None of None; whatever is malformed raises."""
    if entry is None:
        return None
    styles = tuple(check_name("style", name) for name in entry["styles"])
    if len(set(styles)) < len(styles):
        raise ValueError("a style stands twice")
    kinds = kinds_of(styles)
    shapes = {str(name): tuple(_count(n) for n in shape) for name, shape in entry["arrays"].items()}
    optional = set(_OPTIONAL)
    if not set(kinds) - optional <= set(shapes) <= set(kinds):
        odd = min((set(kinds) - optional - set(shapes)) | (set(shapes) - set(kinds)))
        raise ValueError(f"the Gaussians' array {printable(odd)} is missing, or none is so called")
    for name, shape in shapes.items():
        if len(shape) != kinds[name].dimensions or array_path(name) not in files:
            raise ValueError(f"the Gaussians' array {name} has no file, or another shape")
    fit = {check_name("number", name): float(value) for name, value in entry["fit"].items()}
    return ReconstructionRecord(
        shapes,
        tuple(_parse_actor(actor) for actor in entry["actors"]),
        _parse_keys(entry["cameras"]),
        _parse_keys(entry["exposures"]),
        styles,
        fit,
    )


def style_array(style: str, part: str) -> str:
    """Name of an array of a style; no style's name has a dot."""
    return f"style.{style}.{part}"


def kinds_of(styles: Iterable[str]) -> dict[str, Kind]:
    """All arrays that a reconstruction with these styles may have."""
    return _KINDS | {
        style_array(style, part): kind for style in styles for part, kind in STYLE_KINDS.items()
    }


def kind_of(name: str) -> Kind:
    """How an array of this name is stored."""
    return _KINDS[name] if name in _KINDS else STYLE_KINDS[name.rsplit(".", 1)[1]]


def _count(value: Any) -> int:
    if isinstance(value, bool) or value != int(value) or value < 0:
        raise ValueError("a shape must be of whole numbers")
    return int(value)


def _parse_actor(entry: Any) -> ActorRecord:
    name, track = entry["class_name"], entry["track_id"]
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= MAX_CLASS_NAME:
        raise ValueError(f"class name must be 1 to {MAX_CLASS_NAME} printable characters")
    if isinstance(track, bool) or not -(2**63) <= track.__index__() < 2**64:
        raise ValueError("track id must be an integer in [-2**63, 2**64)")
    if not isinstance(entry["is_deformable"], bool):
        raise ValueError("is_deformable must be true or false")
    length, width, height = (float(side) for side in entry["size_m"])
    if not 0 < min(length, width, height) <= max(length, width, height) <= LARGEST:
        raise ValueError("an actor's size is out of its range")
    moments = _count(entry["moments"])
    size_m = (length, width, height)
    return ActorRecord(int(track), name, entry["is_deformable"], size_m, moments)


def _parse_keys(entries: Any) -> tuple[FrameKey, ...]:
    keys = tuple(FrameKey(int(index), check_name("camera", camera)) for index, camera in entries)
    if len(set(keys)) < len(keys):
        raise ValueError("a frame stands twice")
    return keys
