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

What has names (actors, cameras, styles) and the shape of each array stand in the manifest, see
`reconstruction_record`. Arrays are read memory-mapped; every number of them is checked then,
because kernels check none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

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
from weather_aug.scene.reconstruction_record import (
    GAUSSIANS,
    SCORES,
    SETS,
    STYLE_KINDS,
    Kind,
    ReconstructionRecord,
    array_path,
    kind_of,
    kinds_of,
    style_array,
)
from weather_aug.scene.records import check_name, check_scale

LEAST_QUATERNION = 1e-6
"""Shorter ones have no direction in single precision."""


Arrays = dict[str, NDArray[Any]]
Parts = dict[str, bytes]
Entry = dict[str, Any]


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
    arrays: Arrays = dict(zip(SCORES, scores, strict=True)) if scores[0].shape[1] else {}
    if len(reconstruction.support):
        arrays["support"] = reconstruction.support
    return _encoded(arrays)


def encode_style(name: str, style: Style) -> tuple[Entry, Parts]:
    """The colours of a weather, as `encode_geometry` gives the rest."""
    check_name("style", name)
    entry, parts = _encoded({style_array(name, part): getattr(style, part) for part in STYLE_KINDS})
    return entry | {"styles": [name]}, parts


def joined(entries: Iterable[Entry]) -> Entry:
    """The manifest's entry of a reconstruction from the entries of its parts."""
    whole: Entry = {"arrays": {}, "styles": []}
    for entry in entries:
        arrays = whole["arrays"] | entry["arrays"]
        styles = whole["styles"] + entry.get("styles", [])
        whole |= entry | {"arrays": arrays, "styles": styles}
    return whole


def read_reconstruction(folder: Path, record: ReconstructionRecord) -> Reconstruction:
    """The Gaussians of a scene folder, memory-mapped.

    Raises:
        SceneError: If a file cannot be read, or holds another type, shape or range, or the arrays
            do not fit together.
    """
    kinds = kinds_of(record.styles)
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


def _arrays_of(scene: Reconstruction) -> Arrays:
    sets = {"background": scene.background, "actor": scene.actor_gaussians}
    arrays: Arrays = {
        f"{which}_{name}": getattr(gaussians, name)
        for which, gaussians in sets.items()
        for name in SETS
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
        kind = kind_of(name)
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


def _in_range(array: NDArray[Any], kind: Kind) -> bool:
    """Whether all are numbers in range; least and most of NaN are NaN, which is in none."""
    if array.size == 0:
        return True
    return bool(array.min() >= -kind.largest and array.max() <= kind.largest)


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
    fields: dict[str, Any] = {name: arrays.get(f"{which}_{name}") for name in SETS}
    scores = fields["class_scores"]
    if scores is None:
        fields["class_scores"] = np.zeros((count, 0), np.float16)
    elif scores.shape[1] not in (0, CLASSES):
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
    style = Style(**{part: arrays[style_array(name, part)] for part in STYLE_KINDS})
    coarse = style.sky.shape[1]
    if not 0 < coarse <= side or side % coarse:
        raise ValueError(f"the sky of style {name} must have a part of the {side} texels a side")
    shapes: dict[str, tuple[int, ...]] = {
        "sh": (count, style.sh.shape[1], 3),
        "actor_sh": (moving, style.actor_sh.shape[1], 3),
        "sky": (6, coarse, coarse, 3),
    }
    _check_shapes(arrays, {style_array(name, part): shape for part, shape in shapes.items()})
    if not {style.sh.shape[1], style.actor_sh.shape[1]} <= set(SH_COEFFICIENTS):
        raise ValueError(f"style {name} must hold {SH_COEFFICIENTS} coefficients a Gaussian")
    return style
