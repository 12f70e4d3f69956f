"""The way driven: smooth, of few points, and nothing where nobody drove."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from weather_aug.scene import route as routes
from weather_aug.scene.route import REACH_M, STOOD_M, part_near, route_of

Float64 = NDArray[np.float64]
NOISE_M = 0.05
AHEAD_M = 40.0


def straight(length_m: float = 60.0, step_m: float = 1.0) -> Float64:
    along = np.arange(0, length_m, step_m)
    return np.array((1e6, -3e5)) + np.column_stack([along, 0.2 * along])


def bend(radius_m: float) -> Float64:
    """Straight, a quarter of a circle to the left, straight."""
    turn = np.arange(0, np.pi / 2, 0.8 / radius_m)
    curve = radius_m * np.column_stack([np.sin(turn), 1 - np.cos(turn)])
    before = np.column_stack([np.arange(-30, 0, 0.8), np.zeros(38)])
    after = np.column_stack([np.full(37, radius_m), radius_m + np.arange(0.8, 30, 0.8)])
    return np.concatenate([before, curve, after])


def distance_m(points: Float64, route: Float64) -> Float64:
    """Of each point from the polyline, (N,)."""
    starts, steps = route[:-1], np.diff(route, axis=0)
    offset = points[:, None] - starts
    share = np.clip((offset * steps).sum(-1) / (steps**2).sum(-1), 0, 1)
    return np.hypot(*np.moveaxis(offset - share[..., None] * steps, -1, 0)).min(axis=1)


def aside_ahead_m(route: Float64, heading: Float64) -> float:
    """How far the route, continued 40 m, leaves the straight line of a heading."""
    end = route[-1] - route[-2]
    end = AHEAD_M * end / np.hypot(*end)
    return abs(float(end[0] * heading[1] - end[1] * heading[0]) / float(np.hypot(*heading)))


def off_course_m(make: Callable[[Float64], Float64]) -> float:
    """How far the continued routes through noisy places are off, root mean square."""
    heading = np.array([1.0, 0.2])
    rng = np.random.default_rng(3)
    clean = straight()
    off = [
        aside_ahead_m(make(clean + rng.normal(0, NOISE_M, clean.shape)), heading) for _ in range(40)
    ]
    return float(np.sqrt(np.mean(np.square(off))))


def test_noise_does_not_bend_the_way() -> None:
    """5 cm of noise at every metre; the way goes on from the last places."""
    smooth = off_course_m(lambda places: route_of(places))  # type: ignore[arg-type, return-value]
    assert smooth < 1.0
    assert off_course_m(lambda places: places) > 2 * smooth, "a planted fault is not told"


def test_a_straight_way_has_two_corners_far_from_the_origin() -> None:
    route = route_of(straight())
    assert route is not None
    assert len(route) == 2
    assert np.abs(route - straight()[[0, -1]]).max() < 0.01


@pytest.mark.parametrize("radius_m", [10.0, 20.0, 80.0])
def test_a_bend_is_followed(radius_m: float) -> None:
    places = bend(radius_m)
    route = route_of(places)
    assert route is not None
    assert distance_m(places, route).max() < 5.0 / radius_m + 0.03
    assert len(route) < len(places) / 2


def test_a_rig_that_waits_at_a_light_drives_on() -> None:
    rng = np.random.default_rng(1)
    way = straight()
    waits = way[30] + rng.normal(0, NOISE_M, (200, 2))
    route = route_of(np.concatenate([way[:31], waits, way[31:]]))
    assert route is not None
    assert distance_m(way, route).max() < 0.15


@pytest.mark.parametrize("count", [1, 2, 50])
def test_a_rig_that_stood_has_no_way(count: int) -> None:
    rng = np.random.default_rng(2)
    assert route_of(rng.uniform(-0.5, 0.5, (count, 2)) * STOOD_M / 1.5) is None


def test_two_places_are_a_way() -> None:
    route = route_of(np.array([[0.0, 0.0], [40.0, 0.0]]))
    assert route is not None
    assert np.allclose([[0, 0], [40, 0]], route, atol=1e-3)


def test_a_way_beyond_measure_takes_bounded_time() -> None:
    route = route_of(np.array([[0.0, 0.0], [1e10, 1e9], [-1e10, 0.0]]))
    assert route is not None
    assert np.isfinite(route).all()


@given(st.integers(0, 2**32), st.integers(2, 40))
def test_a_way_is_pure_finite_and_has_two_ends(seed: int, count: int) -> None:
    places = np.cumsum(np.random.default_rng(seed).normal(0.6, 1.0, (count, 2)), axis=0)
    before = places.tobytes()
    route = route_of(places)
    assert places.tobytes() == before
    if route is None:
        assert np.hypot(*(places - places[0]).T).max() < STOOD_M + routes.STANDING_STEP_M
        return
    again = route_of(places)
    assert again is not None
    assert again.tobytes() == route.tobytes()
    assert len(route) >= 2
    assert np.isfinite(route).all()


def test_only_the_way_around_a_place_matters_to_it() -> None:
    angle = np.linspace(0, 2 * np.pi, 400)
    route = 150.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    part = part_near(route, route[200])
    assert len(part) < len(route) / 2
    away = np.hypot(*(part - route[200]).T)
    assert away.max() <= REACH_M + 3
    assert (away[[0, -1]] > 0.9 * REACH_M).all()
    for end in (route[0], route[-1]):
        assert len(part_near(route, end)) >= 2
    assert part_near(route[:2], np.array([9e9, 0.0])).tolist() == route[:2].tolist()
