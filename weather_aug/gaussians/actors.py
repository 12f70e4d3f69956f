"""What moves by itself: where each tracked object is at any moment, and its Gaussians there.

An object is rigid (a vehicle) or deformable (a walker, or a rider with the bicycle): the Gaussians
of a deformable one also wander around their places in its frame, as smooth functions of the time.
The SMPL body model, by which OmniRe bends walkers, is left out because its licence forbids
commercial use; walkers are deformable objects here, as OmniRe treats distant ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from weather_aug._checks import finite
from weather_aug.clip.types import Box, Frame
from weather_aug.gaussians.placing import placed as placed
from weather_aug.gaussians.rotations import (
    matrices_of,
    product,
    quaternions_of,
    quaternions_of_vectors,
    slerped,
    slerped_tensor,
)
from weather_aug.gaussians.types import Actor

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MOVING_M, DEFORMABLE_MOVING_M = 1.0, 0.5
"""What goes farther from where it was first is an actor (OmniRe); the rest is background."""
TIME_TOLERANCE_S = 1e-6
OFFSET_TERMS = 4
ROTATION_LEARNING_RATE, TRANSLATION_LEARNING_RATE = 1e-5, 5e-4
"""Of the refined poses, for Adam (OmniRe)."""
SMOOTHNESS_WEIGHT, SMOOTHNESS_MOMENTS = 0.01, 5
"""Of `ActorPoses.smoothness` in the loss, and how many moments it looks at together (OmniRe)."""
OFFSETS_WEIGHT = 0.01
"""Of `offsets_penalty` in the loss: 10 cm cost as much as an L1 difference of 1e-4."""
_DEFORMABLE = frozenset(
    "adult animal animals bicycle bicycles bicyclist bike bird cat child cyclist dog human "
    "motorcycle motorcyclist motorbike pedestrian people person rider scooter skater stroller "
    "walker wheelchair".split()
)


def is_deformable(class_name: str) -> bool:
    """Whether a data set's class is a walker, a rider, a two-wheeler that has one, or an animal."""
    return any(word in _DEFORMABLE for word in re.split(r"[^a-z]+", class_name.lower()))


def pose_at(actor: Actor, time_s: float) -> Float64 | None:
    """(4, 4) world_from_actor at a moment; None before the first and after the last tracked one.

    Between two tracked moments the place runs straight and the heading turns on the shortest way,
    however long the object was out of sight. At a tracked moment it is the tracked pose, bit for
    bit. A microsecond outside the track still counts as its end.
    """
    place = _place_in(actor.times_s, time_s)
    if place is None:
        return None
    before, share = place
    start = actor.world_from_actor[before]
    if share == 0.0:
        return start.copy()
    end = actor.world_from_actor[before + 1]
    pose = np.eye(4)
    pose[:3, :3] = slerped(start[:3, :3], end[:3, :3], share)
    pose[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return pose


def _place_in(times_s: Float64, time_s: float) -> tuple[int, float] | None:
    """Index of the moment at or before a time, and the share of the way to the next one."""
    time_s = finite("time_s", time_s)
    first_s, last_s = float(times_s[0]), float(times_s[-1])
    if not first_s - TIME_TOLERANCE_S <= time_s <= last_s + TIME_TOLERANCE_S:
        return None
    time_s = min(max(time_s, first_s), last_s)
    before = int(np.searchsorted(times_s, time_s, side="right")) - 1
    if times_s[before] == time_s:
        return before, 0.0
    start_s, end_s = times_s[before : before + 2].tolist()
    return before, (time_s - start_s) / (end_s - start_s)


def offset_basis(actor_times_s: Float64, time_s: float, count: int = OFFSET_TERMS) -> Float32:
    """(B,) in -1..1: cosines of half turns over the track, cos(π k share) with k = 1..B.

    They are orthogonal over the track, so that small coefficients are small offsets; the constant
    is left out because the Gaussian's own place holds it. Before and after the track they stay as
    at its ends. The fastest has B / 2 periods over the whole track, which is slower than a step of
    a walker on a track of some seconds: what it follows is posture and turning, not each stride.

    Args:
        actor_times_s: (T,), rising.
        time_s: Any moment.
        count: B, at least 0.
    """
    start_s, end_s = float(actor_times_s[0]), float(actor_times_s[-1])
    if end_s <= start_s:
        return np.zeros(count, np.float32)
    share = min(max((finite("time_s", time_s) - start_s) / (end_s - start_s), 0.0), 1.0)
    return np.cos(np.pi * share * np.arange(1, count + 1)).astype(np.float32)


def offset_bases(actors: Sequence[Actor], time_s: float, count: int = OFFSET_TERMS) -> Float32:
    """(A, B) `offset_basis` of each actor; zero for a rigid one, which has no offsets."""
    rows = [
        offset_basis(actor.times_s, time_s, count) if actor.is_deformable else np.zeros(count)
        for actor in actors
    ]
    return np.array(rows, np.float32).reshape(len(rows), count)


def actors_of(frames: Sequence[Frame], moving_m: float = MOVING_M) -> tuple[Actor, ...]:
    """Tracked objects that moved, by their track's number; those that stood are background.

    Cameras of one time step often carry the boxes of one LiDAR sweep while each has a moment of its
    own: equal boxes of a time step are one moment, the middle of theirs. Where a camera's moment
    lies outside the track for that reason, the track goes on at its speed up to it.

    Args:
        frames: With their boxes, in any order; frames without boxes tell nothing.
        moving_m: How far from its first place an object must have been, metres, at least 0;
            deformable ones half as far.

    Raises:
        ArgumentError: If `moving_m` is not a finite number from 0 on.

    Sources:
        OmniRe (Chen et al. 2025): vehicles from 1 m, people and cyclists from 0.5 m.
    """
    moving_m = finite("moving_m", moving_m, 0.0)
    actors = (_actor(track_id, seen) for track_id, seen in sorted(_tracks(frames).items()))
    return tuple(actor for actor in actors if _travel_m(actor) > _threshold_m(actor, moving_m))


_Seen = dict[tuple[int, bytes], list[tuple[float, Box]]]
"""By time step and pose."""


def _tracks(frames: Sequence[Frame]) -> dict[int, _Seen]:
    tracks: dict[int, _Seen] = {}
    for frame in frames:
        for box in frame.boxes:
            moment = (frame.key.time_index, box.world_from_box.tobytes())
            tracks.setdefault(box.track_id, {}).setdefault(moment, []).append((frame.time_s, box))
    return tracks


def _actor(track_id: int, seen: _Seen) -> Actor:
    groups = list(seen.values())
    spans_s = [(min(t for t, _ in group), max(t for t, _ in group)) for group in groups]
    moments = sorted(
        (
            (0.5 * (early + late), group[0][1])
            for (early, late), group in zip(spans_s, groups, strict=True)
        ),
        key=lambda moment: moment[0],
    )
    kept = moments[:1] + [
        after for before, after in pairwise(moments) if after[0] > before[0] + TIME_TOLERANCE_S
    ]
    boxes = [box for _, box in kept]
    names = [box.class_name for box in boxes]
    name = max(sorted(set(names)), key=names.count)
    size = np.median([box.size_m for box in boxes], axis=0).tolist()
    reach_s = min(early for early, _ in spans_s), max(late for _, late in spans_s)
    times_s, poses = _reaching(
        np.array([time_s for time_s, _ in kept]),
        np.array([box.world_from_box for box in boxes]),
        reach_s,
    )
    return Actor(track_id, name, is_deformable(name), (size[0], size[1], size[2]), times_s, poses)


def _reaching(
    times_s: Float64, poses: Float64, reach_s: tuple[float, float]
) -> tuple[Float64, Float64]:
    """A track that goes on at its first and last speed up to two moments outside it."""
    if len(times_s) < 2:
        return times_s, poses
    for reach, end, beside in ((reach_s[0], 0, 1), (reach_s[1], -1, -2)):
        over_s = reach - times_s[end]
        if abs(over_s) <= TIME_TOLERANCE_S:
            continue
        step = (poses[end, :3, 3] - poses[beside, :3, 3]) / (times_s[end] - times_s[beside])
        pose = poses[end].copy()
        pose[:3, 3] += over_s * step
        at = 0 if end == 0 else len(times_s)
        times_s, poses = np.insert(times_s, at, reach), np.insert(poses, at, pose, axis=0)
    return times_s, poses


def _travel_m(actor: Actor) -> float:
    """Greatest distance from the first place."""
    centres = actor.world_from_actor[:, :3, 3]
    return float(np.linalg.norm(centres - centres[0], axis=1).max())


def _threshold_m(actor: Actor, moving_m: float) -> float:
    return moving_m * (DEFORMABLE_MOVING_M / MOVING_M if actor.is_deformable else 1.0)


class ActorPoses(nn.Module):
    """Poses of actors, refined at each tracked moment.

    The heading of a moment turns by a rotation vector in the actor's own axes, its place moves by a
    translation in world axes; both start at zero, which gives the recorded poses bit for bit in
    `refined`. Between moments as `pose_at`.

    Args:
        actors: As recorded.
        origin_m: (3,) place in the world that `poses` takes for 0, so that float32 keeps
            millimetres far from the world's origin.
    """

    def __init__(
        self, actors: Sequence[Actor], origin_m: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        super().__init__()
        self.actors = tuple(actors)
        counts = [len(actor.times_s) for actor in self.actors]
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        recorded = np.concatenate([np.zeros((0, 4, 4)), *(a.world_from_actor for a in self.actors)])
        steps = [_turns(actor.world_from_actor[:, :3, :3]) for actor in self.actors]
        windows = [
            _windows(actor.times_s, start)
            for actor, start in zip(self.actors, self._starts, strict=False)
        ]
        # No buffers, because `module.float()` would make them float32.
        self._rotations = torch.from_numpy(recorded[:, :3, :3].copy())
        self._places_m = torch.from_numpy(recorded[:, :3, 3] - np.asarray(origin_m, np.float64))
        self._steps = torch.from_numpy(np.concatenate([np.zeros((0, 4)), *steps]))
        none = np.zeros((0, SMOOTHNESS_MOMENTS))
        self._moments = torch.from_numpy(
            np.concatenate([none.astype(np.int64), *(moments for moments, _ in windows)])
        )
        self._residual = torch.from_numpy(np.concatenate([none, *(part for _, part in windows)]))
        self.rotations_rad = nn.Parameter(torch.zeros(len(recorded), 3))
        """Of all moments of all actors, one after the other."""
        self.translations_m = nn.Parameter(torch.zeros(len(recorded), 3))

    def poses(self, time_s: float) -> tuple[Tensor, Tensor]:
        """(A, 4, 4) float32 world_from_actor and (A,) bool whether it is there at that moment.

        The pose of who is not there is that of its first moment and gets a gradient; leave its
        Gaussians away.
        """
        places = [_place_in(actor.times_s, time_s) for actor in self.actors]
        present = torch.tensor([place is not None for place in places], dtype=torch.bool)
        firsts = torch.tensor([place[0] if place else 0 for place in places], dtype=torch.int64)
        share = torch.tensor([place[1] if place else 0.0 for place in places], dtype=torch.float64)
        before = firsts + torch.from_numpy(self._starts[:-1])
        after = before + (share > 0)
        device = self.rotations_rad.device
        present, share = present.to(device), share.to(device)
        deltas = quaternions_of_vectors(self.rotations_rad.double())
        end = product(self._steps[before].to(device), deltas[after])
        turn = slerped_tensor(deltas[before], end, share)
        rotations = self._rotations[before].to(device) @ matrices_of(turn)
        refined_m = self._refined_m()
        middle_m = torch.lerp(refined_m[before], refined_m[after], share[:, None])
        return _rigid(rotations, middle_m).float(), present

    def smoothness(self) -> Tensor:
        """Mean distance, metres, of places from the straight line through those around them.

        Each place is held against a line fitted to the two before and the two after; who moves
        evenly pays nothing, however uneven the moments. Tracks of fewer than 5 moments pay nothing.
        """
        if len(self._moments) == 0:
            return self.translations_m.sum() * 0.0
        residual = self._residual.to(self.translations_m.device)
        residual_m = (residual[..., None] * self._refined_m()[self._moments]).sum(dim=1)
        return residual_m.abs().sum(dim=-1).mean().float()

    def _refined_m(self) -> Tensor:
        """Places of all moments, from the origin."""
        return self._places_m.to(self.translations_m.device) + self.translations_m.double()

    def refined(self) -> tuple[Actor, ...]:
        """The actors with their refined poses."""
        with torch.no_grad():
            turns = matrices_of(quaternions_of_vectors(self.rotations_rad.double())).cpu().numpy()
            moves_m = self.translations_m.double().cpu().numpy()
        actors = []
        for actor, start, end in zip(self.actors, self._starts, self._starts[1:], strict=False):
            poses = actor.world_from_actor.copy()
            poses[:, :3, :3] = poses[:, :3, :3] @ turns[start:end]
            poses[:, :3, 3] += moves_m[start:end]
            actors.append(replace(actor, world_from_actor=poses))
        return tuple(actors)


def _turns(rotations: Float64) -> Float64:
    """(T, 4) quaternion from each moment to the next; the last has none and keeps 1."""
    steps = np.tile([1.0, 0.0, 0.0, 0.0], (len(rotations), 1))
    steps[:-1] = quaternions_of(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])
    return steps


def _windows(times_s: Float64, start: int) -> tuple[NDArray[np.int64], Float64]:
    """(W, 5) rows of the table, and the weights by which they give a place's distance from a line.

    The line is the least-squares fit through the moments around the middle one, at its time.
    """
    count, half = len(times_s), SMOOTHNESS_MOMENTS // 2
    moments = np.arange(half, count - half)[:, None] + np.arange(-half, half + 1)
    off_s = times_s[moments] - times_s[moments[:, half : half + 1]]
    others = np.delete(off_s, half, axis=1)
    mean = others.mean(axis=1, keepdims=True)
    spread = ((others - mean) ** 2).sum(axis=1, keepdims=True)
    line = 1 / others.shape[1] - mean * (others - mean) / spread
    return moments + start, np.insert(-line, half, 1.0, axis=1)


def _rigid(rotations: Tensor, places_m: Tensor) -> Tensor:
    """(A, 4, 4) of rotations (A, 3, 3) and places (A, 3)."""
    last = rotations.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(rotations), 1, 4)
    return torch.cat([torch.cat([rotations, places_m[:, :, None]], dim=2), last], dim=1)


def offsets_penalty(offsets_m: Tensor) -> Tensor:
    """Mean square of the offsets (M, B, 3) over the Gaussians and over their tracks, m².

    Half the sum of the squared coefficients, because the basis is orthogonal over the track. That
    neighbours should move alike is left out: it needs the neighbours of each Gaussian anew after
    each change of their number, and costs more than the offsets themselves.
    """
    return 0.5 * offsets_m.square().sum(dim=(1, 2)).mean()
