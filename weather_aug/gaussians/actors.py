"""What moves by itself: where each tracked object is at any moment, and its Gaussians there.

An object is rigid (a vehicle) or deformable (a walker, or a rider with the bicycle): the Gaussians
of a deformable one also wander around their places in its frame, as smooth functions of the time.
The SMPL body model, by which OmniRe bends walkers, is left out because its licence forbids
commercial use; walkers are deformable objects here, as OmniRe treats distant ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.clip.types import Box, Frame
from weather_aug.gaussians.rotations import slerped
from weather_aug.gaussians.types import Actor

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MOVING_M, DEFORMABLE_MOVING_M = 1.0, 0.5
"""What goes farther from where it was first is an actor (OmniRe); the rest is background."""
TIME_TOLERANCE_S = 1e-6
OFFSET_TERMS = 4
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
