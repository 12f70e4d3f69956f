"""A drive as Gaussians, kept in the scene folder as plain arrays.

    gaussians/background_means_m.npy …  (N, 3) float32, and the other arrays of `Gaussians`
    gaussians/actor_means_m.npy …       (M, 3) float32 of all actors, and `owners`, `offsets_m`
    gaussians/background_class_scores.npy   (N, C) float16, where the clip is labelled
    gaussians/sky_faces.npy, sky_seen.npy   (6, S, S, 3) float32 and (6, S, S) uint8, 0 or 1
    gaussians/support.npy               (N,) float32
    gaussians/track_times_s.npy …       (T,) float64 and (T, 4, 4) of all actors, one after another
    gaussians/camera_poses.npy …        (F, 4, 4) float64 and the rest of the refined cameras
    gaussians/exposures.npy             (E, 3, 4) float32
    gaussians/style.NAME.sh.npy …       float16 colours in one weather

What has names (actors, cameras, styles) and the shape of each array stand in the manifest. Arrays
are read memory-mapped; every number of them is checked then, because kernels check none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import RIGID_TOLERANCE, Camera, FrameKey
from weather_aug.errors import ArgumentError, DataError, SceneError, printable
from weather_aug.gaussians.types import (
    CLASSES,
    SH_COEFFICIENTS,
    Actor,
    Gaussians,
    Reconstruction,
    Sky,
    Style,
)
from weather_aug.scene.arrays import mapped, npy_bytes
from weather_aug.scene.boxes import MAX_CLASS_NAME
from weather_aug.scene.records import LARGEST, StoredFile, check_name, check_scale

GAUSSIANS = "gaussians"
MOST_LOG_SCALE = 40.0
"""exp of it and its square are numbers in single precision."""
MOST_LOGIT = 1000.0
MOST_COLOUR = 1000.0
MOST_HALF = 65504.0
LEAST_QUATERNION = 1e-6
"""Shorter ones have no direction in single precision."""

Arrays = dict[str, NDArray[Any]]
Parts = dict[str, bytes]
Entry = dict[str, Any]


class _Kind(NamedTuple):
    """How an array is stored, and the greatest number in it."""

    dtype: str
    dimensions: int
    largest: float


_SETS = {
    "means_m": _Kind("<f4", 2, LARGEST),
    "quaternions": _Kind("<f4", 2, LARGEST),
    "log_scales": _Kind("<f4", 2, MOST_LOG_SCALE),
    "logit_opacities": _Kind("<f4", 1, MOST_LOGIT),
    "sh": _Kind("<f4", 3, MOST_COLOUR),
    "class_scores": _Kind("<f2", 2, MOST_HALF),
}
_KINDS = {
    f"{which}_{name}": kind for which in ("background", "actor") for name, kind in _SETS.items()
}
_SCORES = ("background_class_scores", "actor_class_scores")
_OPTIONAL = (*_SCORES, "support")
"""What is found out when the geometry is known."""
_KINDS |= {
    "owners": _Kind("<i4", 1, 2**31 - 1),
    "offsets_m": _Kind("<f4", 3, LARGEST),
    "sky_faces": _Kind("<f4", 4, MOST_COLOUR),
    "sky_seen": _Kind("|u1", 3, 1),
    "support": _Kind("<f4", 1, 3e38),
    "track_times_s": _Kind("<f8", 1, LARGEST),
    "track_poses": _Kind("<f8", 3, LARGEST),
    "camera_intrinsics": _Kind("<f8", 3, LARGEST),
    "camera_poses": _Kind("<f8", 3, LARGEST),
    "camera_motions": _Kind("<f8", 3, LARGEST),
    "camera_numbers": _Kind("<f8", 2, LARGEST),
    "exposures": _Kind("<f4", 3, MOST_COLOUR),
}
_STYLE_KINDS = {
    "sh": _Kind("<f2", 3, MOST_COLOUR),
    "actor_sh": _Kind("<f2", 3, MOST_COLOUR),
    "sky": _Kind("<f2", 4, MOST_COLOUR),
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


def encode_geometry(reconstruction: Reconstruction) -> tuple[Entry, Parts]:
    """Where Gaussians are and their own colours: the manifest's entry, and bytes by relative path.

    All but class scores, support and styles.

    Raises:
        SceneError: If it holds what no scene can (an array that is not finite, a name that is
            none, arrays that disagree).
    """
    arrays = _arrays_of(reconstruction)
    actors = [
        {
            "track_id": int(actor.track_id),
            "class_name": actor.class_name,
            "is_deformable": bool(actor.is_deformable),
            "size_m": [float(side) for side in actor.size_m],
            "moments": len(actor.times_s),
        }
        for actor in reconstruction.actors
    ]
    entry, parts = _encoded(arrays)
    entry |= {
        "actors": actors,
        "cameras": [[key.time_index, key.camera] for key in reconstruction.cameras],
        "exposures": [[key.time_index, key.camera] for key in reconstruction.exposures],
        "styles": [],
        "fit": {},
    }
    return entry, parts


def encode_labels(reconstruction: Reconstruction) -> tuple[Entry, Parts]:
    """Class scores and support, as `encode_geometry` gives the rest; only those that there are."""
    scores = (reconstruction.background.class_scores, reconstruction.actor_gaussians.class_scores)
    arrays: Arrays = dict(zip(_SCORES, scores, strict=True)) if scores[0].shape[1] else {}
    if len(reconstruction.support):
        arrays["support"] = reconstruction.support
    return _encoded(arrays)


def encode_style(name: str, style: Style) -> tuple[Entry, Parts]:
    """The colours of a weather, as `encode_geometry` gives the rest."""
    check_name("style", name)
    entry, parts = _encoded(
        {_style_array(name, part): getattr(style, part) for part in _STYLE_KINDS}
    )
    return entry | {"styles": [name]}, parts


def joined(entries: Iterable[Entry]) -> Entry:
    """The manifest's entry of a reconstruction from the entries of its parts."""
    whole: Entry = {"arrays": {}, "styles": []}
    for entry in entries:
        arrays = whole["arrays"] | entry["arrays"]
        styles = whole["styles"] + entry.get("styles", [])
        whole |= entry | {"arrays": arrays, "styles": styles}
    return whole


def parse_reconstruction(
    entry: Any, files: Mapping[str, StoredFile]
) -> ReconstructionRecord | None:
    """A record from the manifest's entry, None of None; whatever is malformed raises."""
    if entry is None:
        return None
    styles = tuple(check_name("style", name) for name in entry["styles"])
    if len(set(styles)) < len(styles):
        raise ValueError("a style stands twice")
    kinds = _kinds(styles)
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


def read_reconstruction(folder: Path, record: ReconstructionRecord) -> Reconstruction:
    """The Gaussians of a scene folder, memory-mapped.

    Raises:
        SceneError: If a file cannot be read, or holds another type, shape or range, or the arrays
            do not fit together.
    """
    kinds = _kinds(record.styles)
    arrays: Arrays = {}
    for name, shape in record.shapes.items():
        path = folder / array_path(name)
        arrays[name] = mapped(path, kinds[name].dtype, shape)
        if not _in_range(arrays[name], kinds[name]):
            raise _wrong(folder, f"{name} holds a number that is not finite, or out of its range")
    try:
        return _assembled(arrays, record)
    except (ArgumentError, DataError, ValueError) as error:
        raise _wrong(folder, printable(error, 200)) from None


def _wrong(folder: Path, what: str) -> SceneError:
    return SceneError(f"{printable(folder / GAUSSIANS, 200)}: {what}; build the scene again")


def _style_array(style: str, part: str) -> str:
    return f"style.{style}.{part}"


def _kinds(styles: Iterable[str]) -> dict[str, _Kind]:
    """All arrays that a reconstruction with these styles may have."""
    return _KINDS | {
        _style_array(style, part): kind for style in styles for part, kind in _STYLE_KINDS.items()
    }


def _arrays_of(scene: Reconstruction) -> Arrays:
    sets = {"background": scene.background, "actor": scene.actor_gaussians}
    arrays: Arrays = {
        f"{which}_{name}": getattr(gaussians, name)
        for which, gaussians in sets.items()
        for name in _SETS
        if name != "class_scores"
    }
    cameras, actors = list(scene.cameras.values()), scene.actors
    numbers = [(c.width, c.height, c.exposure_s, c.aperture_m) for c in cameras]
    motions = [(c.velocity_m_per_s, c.angular_velocity_rad_per_s) for c in cameras]
    return arrays | {
        "owners": scene.owners,
        "offsets_m": scene.offsets_m,
        "sky_faces": scene.sky.faces,
        "sky_seen": scene.sky.seen,
        "track_times_s": np.concatenate([np.zeros(0), *(actor.times_s for actor in actors)]),
        "track_poses": np.concatenate(
            [np.zeros((0, 4, 4)), *(actor.world_from_actor for actor in actors)]
        ),
        "camera_intrinsics": _stacked([c.intrinsics for c in cameras], (3, 3)),
        "camera_poses": _stacked([c.world_from_camera for c in cameras], (4, 4)),
        "camera_motions": _stacked(motions, (2, 3)),
        "camera_numbers": _stacked(numbers, (4,)),
        "exposures": _stacked(list(scene.exposures.values()), (3, 4)),
    }


def _stacked(values: Sequence[Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.array(values, np.float64).reshape(len(values), *shape)


def _encoded(arrays: Arrays) -> tuple[Entry, Parts]:
    shapes, parts = {}, {}
    for name, array in arrays.items():
        kind = _kind_of(name)
        with np.errstate(over="ignore"):
            stored = np.asarray(array).astype(kind.dtype)
        if stored.ndim != kind.dimensions or not _in_range(stored, kind):
            raise SceneError(
                f"the Gaussians cannot be stored: {name} has {stored.ndim} dimensions, not "
                f"{kind.dimensions}, or a number that is not finite or beyond {kind.largest:g}"
            )
        shapes[name] = list(stored.shape)
        parts[array_path(name)] = npy_bytes(stored, kind.dtype)
    return {"arrays": shapes}, parts


def _kind_of(name: str) -> _Kind:
    # No style's name has a dot.
    return _KINDS[name] if name in _KINDS else _STYLE_KINDS[name.rsplit(".", 1)[1]]


def _in_range(array: NDArray[Any], kind: _Kind) -> bool:
    """Whether all are numbers in range; least and most of NaN are NaN, which is in none."""
    if array.size == 0:
        return True
    return bool(array.min() >= -kind.largest and array.max() <= kind.largest)


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


def _assembled(arrays: Arrays, record: ReconstructionRecord) -> Reconstruction:
    """A reconstruction of arrays whose numbers are in range; what does not fit raises."""
    background = _gaussians(arrays, "background")
    movers = _gaussians(arrays, "actor")
    count, moving = len(background), len(movers)
    if background.class_scores.shape[1] != movers.class_scores.shape[1]:
        raise ValueError("background and actors have scores of other classes")
    faces = arrays["sky_faces"]
    side = faces.shape[1]
    frames, moments = len(record.cameras), sum(actor.moments for actor in record.actors)
    _check_shapes(
        arrays,
        {
            "owners": (moving,),
            "offsets_m": (moving, arrays["offsets_m"].shape[1], 3),
            "sky_faces": (6, side, side, 3),
            "sky_seen": (6, side, side),
            "support": (count,),
            "track_times_s": (moments,),
            "track_poses": (moments, 4, 4),
            "camera_intrinsics": (frames, 3, 3),
            "camera_poses": (frames, 4, 4),
            "camera_motions": (frames, 2, 3),
            "camera_numbers": (frames, 4),
            "exposures": (len(record.exposures), 3, 4),
        },
    )
    owners = arrays["owners"]
    if moving and not 0 <= int(owners.min()) <= int(owners.max()) < len(record.actors):
        raise ValueError("owners name an actor that is not there")
    if len({actor.track_id for actor in record.actors}) < len(record.actors):
        raise ValueError("two actors have the same track")
    return Reconstruction(
        background,
        Sky(faces, arrays["sky_seen"].view(np.bool_)),
        _actors(arrays, record),
        movers,
        owners,
        arrays["offsets_m"],
        _cameras(arrays, record),
        dict(zip(record.exposures, arrays["exposures"], strict=True)),
        {name: _style(arrays, name, count, moving, side) for name in record.styles},
        arrays.get("support", np.zeros(0, np.float32)),
    )


def _check_shapes(arrays: Arrays, expected: dict[str, tuple[int, ...]]) -> None:
    for name, shape in expected.items():
        if name in arrays and arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, the others expect {shape}")


def _gaussians(arrays: Arrays, which: str) -> Gaussians:
    count = len(arrays[f"{which}_means_m"])
    fields = {name: arrays.get(f"{which}_{name}") for name in _SETS}
    scores = fields["class_scores"]
    if scores is None:
        fields["class_scores"] = np.zeros((count, 0), np.float16)
    elif scores.shape[1] > CLASSES:
        raise ValueError(f"{which} has scores of {scores.shape[1]} classes, there are {CLASSES}")
    gaussians = Gaussians(**fields)
    squares = np.einsum("ij,ij->i", gaussians.quaternions, gaussians.quaternions)
    if count and float(squares.min()) < LEAST_QUATERNION**2:
        raise ValueError(f"{which} has a quaternion of no length")
    return gaussians


def _actors(arrays: Arrays, record: ReconstructionRecord) -> tuple[Actor, ...]:
    actors, first = [], 0
    poses = arrays["track_poses"]
    rotations = poses[:, :3, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(initial=0.0)
    if max(off, np.abs(poses[:, 3] - (0, 0, 0, 1)).max(initial=0.0)) > RIGID_TOLERANCE:
        raise ValueError("a pose of an actor is not a rigid motion")
    if len(poses) and float(np.linalg.det(rotations).min()) < 0:
        raise ValueError("a pose of an actor is a reflection")
    for actor in record.actors:
        own = slice(first, first + actor.moments)
        first += actor.moments
        times_s = arrays["track_times_s"][own]
        if not actor.moments or not (np.diff(times_s) > 0).all():
            raise ValueError(f"the track of actor {actor.track_id} is empty, or its times fall")
        actors.append(
            Actor(
                *(actor.track_id, actor.class_name, actor.is_deformable, actor.size_m),
                times_s,
                poses[own],
            )
        )
    return tuple(actors)


def _cameras(arrays: Arrays, record: ReconstructionRecord) -> dict[FrameKey, Camera]:
    cameras = {}
    for index, key in enumerate(record.cameras):
        width, height, exposure_s, aperture_m = arrays["camera_numbers"][index].tolist()
        if (width, height) != (int(width), int(height)):
            raise ValueError(f"the camera of frame {key} has no whole number of pixels")
        camera = Camera(
            arrays["camera_intrinsics"][index],
            arrays["camera_poses"][index],
            *(int(width), int(height), exposure_s, aperture_m),
            *arrays["camera_motions"][index],
        )
        check_scale(key, camera, 0.0)
        cameras[key] = camera
    return cameras


def _style(arrays: Arrays, name: str, count: int, moving: int, side: int) -> Style:
    style = Style(**{part: arrays[_style_array(name, part)] for part in _STYLE_KINDS})
    shapes = {"sh": (count, style.sh.shape[1], 3), "actor_sh": (moving, style.actor_sh.shape[1], 3)}
    shapes |= {"sky": (6, side, side, 3)}
    _check_shapes(arrays, {_style_array(name, part): shape for part, shape in shapes.items()})
    if not {style.sh.shape[1], style.actor_sh.shape[1]} <= set(SH_COEFFICIENTS):
        raise ValueError(f"style {name} must hold {SH_COEFFICIENTS} coefficients a Gaussian")
    return style
