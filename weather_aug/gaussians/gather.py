"""All Gaussians of a drive at one moment, in one weather, as the rasteriser takes them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from weather_aug._checks import finite
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.gaussians.actors import offset_bases, pose_at
from weather_aug.gaussians.exposure import nearest
from weather_aug.gaussians.harmonics import colours_seen
from weather_aug.gaussians.placing import placed
from weather_aug.gaussians.rasterise import Drawn, rasterise
from weather_aug.gaussians.types import Float32, Pinhole, Reconstruction, Sky, Style

Float64 = NDArray[np.float64]
Weights = Mapping[str, float]
RIGID_TOLERANCE = 1e-4


class Gathered(NamedTuple):
    """R Gaussians in one frame, activated, float32 on the CPU: background first, then actors."""

    means_m: Tensor
    """(R, 3), in world axes, from `origin_m`."""
    quaternions: Tensor
    """(R, 4), (w, x, y, z)."""
    scales_m: Tensor
    """(R, 3), standard deviations."""
    opacities: Tensor
    """(R,) in 0..1."""
    sh: Tensor
    """(R, K, 3) in world axes; of an actor as it was recorded, which `colours_seen` allows for."""
    class_scores: Tensor
    """(R, C); C = 0 if unlabelled or left out."""
    rows: Tensor
    """(R,) int64: place of each among the background's Gaussians followed by all actors'."""
    turns: Tensor | None
    """(A, 3, 3) how the last A rows, which are the actors', were turned by `poses`; None if none
    was."""
    origin_m: Float64
    """(3,) of the tensors, in the world."""

    def colours_seen(
        self, centre_m: ArrayLike, sh: Tensor | None = None, degree: int | None = None
    ) -> Tensor:
        """Colours (R, 3) in sRGB, at least 0, seen from `centre_m` (3,) in the world.

        Args:
            centre_m: Of the camera.
            sh: (R, K, 3) other coefficients than the gathered ones; gradients flow to them.
            degree: Highest degree to use; all if None.
        """
        sh = self.sh if sh is None else sh
        towards = self.means_m - _tensor(np.asarray(centre_m, np.float64) - self.origin_m)
        if self.turns is not None:
            first = len(towards) - len(self.turns)
            # A row vector times a rotation is turned back by it.
            back = torch.bmm(towards[first:, None], self.turns)[:, 0]
            towards = torch.cat([towards[:first], back])
        return colours_seen(sh, towards, torch.zeros(3), degree)


def gather(
    reconstruction: Reconstruction,
    time_s: float,
    *,
    style: str | Weights | None = None,
    amount: float = 1.0,
    without: Collection[int] = (),
    poses: Mapping[int, ArrayLike] | None = None,
    origin_m: ArrayLike = (0.0, 0.0, 0.0),
    colours: bool = True,
    labels: bool = True,
) -> Gathered:
    """The background and the actors present at `time_s`, each at its place.

    Args:
        reconstruction: The drive. Its means are float32 in world axes: to 0.1 mm within 1 km of
            the world's origin, to 1 mm within 10 km.
        time_s: Moment, in the clip's time.
        style: A name in `reconstruction.styles`, or weights by name, at least 0 and together at
            most 1; what is missing to 1 is the scene's own colours. None is the scene's own.
        amount: In 0..1, how far to go from the scene's own colours to the style's.
        without: Track ids of actors to leave out.
        poses: `world_from_actor` (4, 4) by track id: puts actors elsewhere, also while they were
            not there.
        origin_m: (3,) of the tensors returned. The camera's centre keeps the most digits.
        colours: Whether to gather `sh`; else it is (R, 0, 3).
        labels: Whether to gather the class scores.

    Raises:
        ArgumentError: If a style or a track is unknown, weights or amount leave their range, or a
            pose is not a rigid motion.
    """
    weights = style_weights(reconstruction, style, amount)
    origin = np.asarray(origin_m, np.float64)
    background, shells = reconstruction.background, reconstruction.actor_gaussians
    present = _present(reconstruction, time_s, without, poses or {})
    turns = _turns(reconstruction, time_s, present) if poses else None
    matrices = np.array([*present.values()]).reshape(-1, 4, 4)
    matrices[:, :3, 3] -= origin
    place = np.full(len(reconstruction.actors), -1)
    place[list(present)] = np.arange(len(present))
    picked = np.flatnonzero(place[reconstruction.owners] >= 0)
    owners = torch.from_numpy(place[reconstruction.owners[picked]])
    means, quaternions = placed(
        _tensor(shells.means_m[picked]),
        _tensor(shells.quaternions[picked]),
        owners,
        _tensor(reconstruction.offsets_m[picked]),
        _tensor(matrices),
        _tensor(
            offset_bases(
                [reconstruction.actors[index] for index in present],
                time_s,
                reconstruction.offsets_m.shape[1],
            )
        ),
    )

    count = len(background) + len(picked)

    def both(name: str) -> Tensor:
        return _joined([getattr(background, name), getattr(shells, name)[picked]])

    return Gathered(
        means_m=torch.cat([_tensor(background.means_m - origin), means]),
        quaternions=torch.cat([_tensor(background.quaternions), quaternions]),
        scales_m=both("log_scales").exp_(),
        opacities=both("logit_opacities").sigmoid_(),
        sh=_blended_sh(reconstruction, weights, picked) if colours else torch.zeros(count, 0, 3),
        class_scores=both("class_scores") if labels else torch.zeros(count, 0),
        rows=torch.from_numpy(
            np.concatenate([np.arange(len(background)), len(background) + picked])
        ),
        turns=None if turns is None else turns[owners],
        origin_m=origin,
    )


def rasterised(gathered: Gathered, camera: Camera, planes: Tensor, threads: int = 1) -> Drawn:
    """Blend `planes` (R, C) in a camera's picture; gradients flow to them."""
    rotation = camera.world_from_camera[:3, :3].T
    camera_from_origin = np.eye(4)
    camera_from_origin[:3, :3] = rotation
    camera_from_origin[:3, 3] = rotation @ (gathered.origin_m - camera.centre_world)
    return rasterise(
        gathered.means_m,
        gathered.quaternions,
        gathered.scales_m,
        gathered.opacities,
        planes,
        _tensor(camera_from_origin),
        Pinhole.of(camera),
        threads=threads,
    )


@contextmanager
def one_thread_of_torch() -> Iterator[None]:
    """Sums of torch depend on its threads, and its small operations lose time by them."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def camera_of(reconstruction: Reconstruction, frame: Frame) -> Camera:
    """The refined camera of a recorded frame, at the size of its picture."""
    camera = reconstruction.cameras.get(frame.key, frame.camera)
    size = (frame.camera.width, frame.camera.height)
    return camera if (camera.width, camera.height) == size else camera.resized(*size)


def exposure_of(reconstruction: Reconstruction, key: FrameKey) -> Float32:
    """(3, 4) of a frame, or of the recorded one of its camera that is nearest in time.

    Raises:
        ArgumentError: If nothing is known of its camera.
    """
    cameras = {other.camera for other in reconstruction.exposures}
    if key.camera not in cameras:
        raise ArgumentError(
            f"no exposure of camera {printable(key.camera)!r} is known; take a key of "
            f"{', '.join(sorted(cameras)) or 'none'}, or key=None for the scene's own colours"
        )
    return nearest(reconstruction.exposures, key)


def sky_of(reconstruction: Reconstruction, style: str | Weights | None, amount: float) -> Sky:
    """The sky in a style; arguments as of `gather`."""
    weights = style_weights(reconstruction, style, amount)
    sky = reconstruction.sky
    if not weights:
        return sky
    side = sky.faces.shape[1]
    styled = {name: _enlarged(reconstruction.styles[name].sky, side) for name in weights}
    return Sky(_blend(sky.faces, styled, weights), sky.seen)


def _enlarged(faces: NDArray[Any], side: int) -> NDArray[Any]:
    """Faces (6, S, S, 3) of fewer texels, each repeated."""
    times = side // faces.shape[1]
    return faces if times == 1 else faces.repeat(times, axis=1).repeat(times, axis=2)


def style_weights(
    reconstruction: Reconstruction, style: str | Weights | None, amount: float
) -> dict[str, float]:
    """Weights above 0 by name of the style; arguments and errors as of `gather`."""
    amount = finite("amount", amount, 0.0, 1.0)
    if style is None:
        return {}
    weights = {style: 1.0} if isinstance(style, str) else dict(style)
    for name, weight in weights.items():
        if name not in reconstruction.styles:
            known = ", ".join(reconstruction.styles) or "none: fit one with styles.fit_style"
            raise ArgumentError(f"style {printable(name)!r} is unknown; there is {known}")
        finite(f"the weight of style {name!r}", weight, 0.0)
    total = sum(weights.values())
    # Shares that are written in decimals may add up to a little more than 1.
    if not total <= 1 + 1e-6:
        raise ArgumentError(f"the weights of styles must add up to at most 1, got {total:g}")
    return {name: amount * weight for name, weight in weights.items() if amount * weight > 0}


def _present(
    reconstruction: Reconstruction,
    time_s: float,
    without: Collection[int],
    poses: Mapping[int, ArrayLike],
) -> dict[int, Float64]:
    """Poses (4, 4) by index of the actors that are to be drawn."""
    known = {actor.track_id for actor in reconstruction.actors}
    for name, tracks in (("without", without), ("poses", poses)):
        unknown = set(tracks) - known
        if unknown:
            raise ArgumentError(
                f"{name} names track {sorted(unknown)[0]}, which the reconstruction does not have; "
                f"its tracks are {sorted(known)}"
            )
    present = {}
    for index, actor in enumerate(reconstruction.actors):
        if actor.track_id in without:
            continue
        if actor.track_id in poses:
            present[index] = _rigid(actor.track_id, poses[actor.track_id])
        elif (pose := pose_at(actor, time_s)) is not None:
            present[index] = pose
    return present


def _turns(reconstruction: Reconstruction, time_s: float, present: Mapping[int, Float64]) -> Tensor:
    """(A, 3, 3) from how each actor stood when it was recorded to how it stands now."""
    turns = []
    for index, pose in present.items():
        actor = reconstruction.actors[index]
        nearest_s = float(np.clip(time_s, actor.times_s[0], actor.times_s[-1]))
        recorded = pose_at(actor, nearest_s)
        assert recorded is not None
        turns.append(pose[:3, :3] @ recorded[:3, :3].T)
    return _tensor(np.array(turns).reshape(-1, 3, 3))


def _rigid(track_id: int, pose: ArrayLike) -> Float64:
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ArgumentError(f"poses[{track_id}] must be a finite (4, 4) matrix, got {matrix.shape}")
    rotation = matrix[:3, :3]
    off = max(
        np.abs(rotation.T @ rotation - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max()
    )
    if off > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ArgumentError(
            f"poses[{track_id}] is not a rigid motion (off by {off:.2g}); it must rotate and shift"
        )
    return matrix


def _blended_sh(
    reconstruction: Reconstruction, weights: Weights, picked: NDArray[np.intp]
) -> Tensor:
    def parts(styles: Mapping[str, Style]) -> dict[str, tuple[Any, Any]]:
        return {name: (style.sh, style.actor_sh[picked]) for name, style in styles.items()}

    own = reconstruction.background.sh, reconstruction.actor_gaussians.sh[picked]
    styled = parts({name: reconstruction.styles[name] for name in weights})
    coefficients = max(
        part.shape[1] for pair in (own, *styled.values()) for part in pair if len(part)
    )
    blended = [
        _blend(
            _padded(own[side], coefficients),
            {name: _padded(pair[side], coefficients) for name, pair in styled.items()},
            weights,
        )
        for side in (0, 1)
    ]
    return _joined(blended)


def _blend(own: NDArray[Any], styled: Mapping[str, NDArray[Any]], weights: Weights) -> Float32:
    if not weights:
        return own.astype(np.float32, copy=False)
    blended = np.float32(1 - sum(weights.values())) * own.astype(np.float32)
    for name, weight in weights.items():
        blended += np.float32(weight) * styled[name].astype(np.float32)
    return blended


def _padded(sh: NDArray[Any], coefficients: int) -> NDArray[Any]:
    """`sh` with zeros for the degrees that it does not have."""
    missing = coefficients - sh.shape[1]
    return np.pad(sh, ((0, 0), (0, missing), (0, 0))) if missing > 0 else sh


def _joined(parts: Sequence[NDArray[Any]]) -> Tensor:
    # A copy always: stored arrays are read-only, and the caller owns the tensors.
    return torch.from_numpy(np.concatenate(parts, dtype=np.float32, casting="same_kind"))


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.array(array, np.float32))
