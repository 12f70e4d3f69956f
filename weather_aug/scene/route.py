"""The way that was driven: its axes, and a camera's own, smooth and of few points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ClipError

Float64 = NDArray[np.float64]

STOOD_M = 2.0
"""A camera that never was farther from its first place stood."""
STANDING_STEP_M = 0.5
"""Shorter steps are noise of a rig that waits."""
SAMPLE_M = 0.5
MOST_SAMPLES = 200_000
KNOT_SAMPLES, SPREAD_SAMPLES, REACH_SAMPLES = 4, 6.0, 24
"""A knot every 2 m, from the line that fits what lies about 3 m around it."""
TOLERANCE_M = 0.02
"""A knot that is no farther from the line between its neighbours is left out."""
REACH_M = 80.0
"""Tracks of wheels are narrower than a pixel farther away."""


def street_axes(entries: Sequence[dict[str, Any]], up_world: Float64) -> Float64:
    """Axes of the street (3, 3): rows along the first heading, to the left, up.

    The heading is the way the rig went; of a rig that stood, the first camera's view.
    """
    up = np.asarray(up_world, np.float64)
    up = up / np.linalg.norm(up)
    first = np.array(entries[0]["world_from_camera"])
    same = [e for e in entries if e["camera"] == entries[0]["camera"]]
    way = np.array(same[-1]["world_from_camera"])[:3, 3] - first[:3, 3]
    way -= (way @ up) * up
    if np.linalg.norm(way) < 1.0:
        way = first[:3, 2] - (first[:3, 2] @ up) * up
    if np.linalg.norm(way) < 1e-6:
        raise ClipError("the first camera looks straight up or down; the street has no heading")
    along = way / np.linalg.norm(way)
    return np.stack([along, np.cross(up, along), up])


def route_of(places: Float64) -> Float64 | None:
    """The way through a camera's places.

    Noise of single places does not bend it: each of its points is on the straight line that fits
    the places around it, weighted by a Gaussian of 3 m (local linear regression), which at a
    corner of 10 m radius cuts less than half a metre.

    Args:
        places: (N, 2) in the order driven, street axes (along, left), metres.

    Returns:
        (P, 2) corners of a polyline, its ends to be continued; None for a camera that stood.
    """
    first = places[0]
    kept = _without_waiting(places - first)
    if float(np.hypot(*kept.T).max()) < STOOD_M:
        return None
    knots = _smooth(_sampled(kept))
    corners = cv2.approxPolyDP(knots.astype(np.float32), TOLERANCE_M, closed=False)
    return corners[:, 0].astype(np.float64) + first


def part_near(route: Float64, place: Float64) -> Float64:
    """The corners (P, 2) of a route that matter at a place (2,): those 80 m around, and the next.

    Along the route: a street that is driven twice is seen with the tracks of one time.
    """
    starts, steps = route[:-1], np.diff(route, axis=0)
    lengths = np.hypot(*steps.T)
    offset = place - starts
    share = np.clip((offset * steps).sum(axis=1) / np.maximum(lengths, 1e-9) ** 2, 0.0, 1.0)
    away = np.hypot(*(offset - share[:, None] * steps).T)
    nearest = int(away.argmin())
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    here = at[nearest] + share[nearest] * lengths[nearest]
    near = np.flatnonzero((at[1:] >= here - REACH_M) & (at[:-1] <= here + REACH_M))
    return route[near[0] : near[-1] + 2]


def _without_waiting(places: Float64) -> Float64:
    """The places but those that are hardly away from the one kept before."""
    kept = [0]
    for index in range(1, len(places)):
        if np.hypot(*(places[index] - places[kept[-1]])) >= STANDING_STEP_M:
            kept.append(index)
    return places[kept]


def _sampled(places: Float64) -> Float64:
    """(M, 2) points at equal distances along the polyline through the places, both ends kept."""
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    count = min(max(round(at[-1] / SAMPLE_M), KNOT_SAMPLES) + 1, MOST_SAMPLES)
    here = np.linspace(0.0, at[-1], count)
    return np.column_stack([np.interp(here, at, side) for side in places.T])


def _smooth(samples: Float64) -> Float64:
    """(K, 2) knots: at each the value of the local line through the samples around it.

    Source:
        Cleveland (1979), with a Gaussian kernel; its ends have no bias, unlike a moving mean's.
    """
    last = len(samples) - 1
    knots = []
    for centre in [*range(0, last, KNOT_SAMPLES), last]:
        first = max(centre - REACH_SAMPLES, 0)
        near = samples[first : centre + REACH_SAMPLES + 1]
        step = np.arange(first, first + len(near)) - float(centre)
        weight = np.exp(-0.5 * (step / SPREAD_SAMPLES) ** 2)
        s0, s1, s2 = weight.sum(), weight @ step, weight @ step**2
        knots.append((s2 * (weight @ near) - s1 * ((weight * step) @ near)) / (s0 * s2 - s1**2))
    return np.array(knots)
