"""Which pictures of a clip are compared: neighbours in time, and views of one moment."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations, pairwise

from weather_aug.clip.types import FrameKey

Pair = tuple[FrameKey, FrameKey]


def over_time(keys: Iterable[FrameKey]) -> tuple[Pair, ...]:
    """Each frame and the next one of its camera, by camera in the order of appearance.

    What is next is told by the time indices that there are: a clip of every fifth frame has
    neighbours five apart.
    """
    times_by_camera: dict[str, list[FrameKey]] = {}
    for key in keys:
        times_by_camera.setdefault(key.camera, []).append(key)
    return tuple(pair for each in times_by_camera.values() for pair in pairwise(sorted(each)))


def between_views(keys: Iterable[FrameKey]) -> tuple[Pair, ...]:
    """All pairs of cameras at each time, in the order of the keys."""
    cameras_by_time: dict[int, list[FrameKey]] = {}
    for key in keys:
        cameras_by_time.setdefault(key.time_index, []).append(key)
    return tuple(pair for each in cameras_by_time.values() for pair in combinations(each, 2))
