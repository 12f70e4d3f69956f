"""Particles under a cover vanish; wind carries some in under its edge, as far as geometry says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.clip.types import Camera, Float64
from weather_aug.errors import ArgumentError
from weather_aug.particles import shelter as module
from weather_aug.particles.shelter import CELL_M, REACH_M, Float32, Shelter, exposed
from weather_aug.weather import Wind

FALL_M_PER_S = 5.0
UNDERSIDE_M = 5.0
EDGE_M = (10.0, 22.0)
CALM: Wind = (0.0, 0.0, 0.0)


def bridge() -> Shelter:
    """Covers 10 < x < 22, -6 < y < 6 at the height 5 in a map that is larger."""
    cover = np.full((40, 32), np.inf, np.float32)
    cover[8:32, 4:28] = UNDERSIDE_M
    return Shelter(cover, np.array([6.0, -8.0, 0.0]), np.eye(3))


def camera(yaw_rad: float = 0.0, velocity: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[s, 0, c], [-c, 0, s], [0, -1, 0]])
    pose[:3, 3] = (2.0, 0.5, 1.5)
    intrinsics = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    return Camera(intrinsics, pose, 640, 360, velocity_m_per_s=np.array(velocity))


def records(points: Float64, seen_by: Camera, wind: Wind, fall: float = FALL_M_PER_S) -> Float32:
    """Records of drops at world points (N, 3); the last column numbers them."""
    rotation = seen_by.world_from_camera[:3, :3]
    particles = np.zeros((len(points), 13), np.float32)
    particles[:, :3] = (points - seen_by.centre_world) @ rotation
    velocity = np.array(wind) - (0, 0, fall) - seen_by.velocity_m_per_s
    particles[:, 3:6] = velocity @ rotation
    particles[:, 12] = np.arange(len(points))
    return particles


def kept(points: Float64, shelter: Shelter | None, wind: Wind = CALM, **options: float) -> set[int]:
    seen_by = camera()
    found = exposed(records(points, seen_by, wind, **options), seen_by, wind, shelter)
    assert (np.diff(found[:, 12]) > 0).all()
    return {int(n) for n in found[:, 12]}


def test_drops_under_a_bridge_vanish_and_all_others_stay() -> None:
    x = np.array([9.9, 10.1, 16.0, 21.9, 22.1, 16.0, 16.0, 16.0, -90.0])
    y = np.array([0, 0, 0, 0, 0, 5.9, 6.1, 0, 0])
    z = np.array([1, 1, 4.9, 1, 1, 1, 1, 5.1, 1])
    assert kept(np.stack([x, y, z], axis=1), bridge()) == {0, 4, 6, 7, 8}


def _entered_m(shelter: Shelter, wind: float, height: float) -> float:
    """How far inside the edge the wind blows towards the last drop is that still falls."""
    x = np.linspace(EDGE_M[0] - 1, EDGE_M[1], 2601)
    points = np.stack([x, np.zeros_like(x), np.full_like(x, height)], axis=1)
    found = kept(points, shelter, (wind, 0.0, 0.0))
    inside = [x[n] for n in found if x[n] < 16]
    return float(max(inside) - EDGE_M[0])


@pytest.mark.parametrize("wind", [0.0, 1.5, 4.0])
@pytest.mark.parametrize("height", [0.2, 2.0, 4.5])
def test_wind_carries_rain_in_under_the_edge(wind: float, height: float) -> None:
    """As far as it blows while the drop falls from the edge."""
    expected = (UNDERSIDE_M - height) * wind / FALL_M_PER_S
    assert expected == pytest.approx(_entered_m(bridge(), wind, height), abs=0.006)  # the spacing


def test_a_filter_that_looks_straight_up_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: the wind is ignored."""
    inner = module.keep_exposed
    still = np.float32(0)
    monkeypatch.setattr(module, "keep_exposed", lambda *a: inner(*a[:4], still, still, *a[6:]))
    assert _entered_m(bridge(), 4.0, 0.2) == pytest.approx(0, abs=0.006)


def test_the_lee_of_a_bridge_is_dry() -> None:
    """Outside, behind it, by the same distance."""
    x = np.linspace(16, 30, 2801)
    points = np.stack([x, np.zeros_like(x), np.full_like(x, 1.0)], axis=1)
    first = min(x[n] for n in kept(points, bridge(), (3.0, 0, 0)) if x[n] > 16)
    assert EDGE_M[1] + 4.0 * 3.0 / FALL_M_PER_S == pytest.approx(first, abs=0.006)


def _slowly(points: Float64, shelter: Shelter, wind: Wind, fall: float) -> set[int]:
    """The way back in steps of a centimetre, in float64."""
    alive = set()
    for n, point in enumerate(points):
        speed = np.hypot(wind[0], wind[1])
        end = min((shelter.top_m + 0.01 - point[2]) / fall, REACH_M / max(speed, 1e-9))
        t = np.arange(0, max(end, 0) + 1e-9, 0.01 / np.hypot(speed, fall))
        way = point + t[:, None] * np.array([-wind[0], -wind[1], fall])
        index = np.floor((way[:, :2] - shelter.origin_m[:2]) / CELL_M).astype(int)
        size = shelter.cover_m.shape
        inside = ((index >= 0) & (index < size)).all(axis=1)
        index = np.clip(index, 0, np.array(size) - 1)
        cover = np.where(inside, shelter.cover_m[index[:, 0], index[:, 1]], np.inf)
        under = (way[:, 2] < cover) & np.isfinite(cover)
        over = way[:, 2] >= cover
        if not ((under[:-1] & over[1:]).any() or (len(under) and under[-1])):
            alive.add(n)
    return alive


@settings(max_examples=12)
@given(
    wind_x=st.floats(-8, 8),
    wind_y=st.floats(-8, 8),
    fall=st.floats(0.8, 9),
    seed=st.integers(0, 1000),
)
def test_the_walk_over_cells_equals_small_steps(
    wind_x: float, wind_y: float, fall: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    cover = np.where(rng.random((20, 20)) < 0.5, rng.uniform(3, 6, (20, 20)), np.inf)
    shelter = Shelter(cover, np.array([4.0, -5.0, 0.5]), np.eye(3))
    shelter = replace(shelter, origin_m=np.array([4.0, -5.0, 0.0]))
    points = rng.uniform((2, -7, 0), (16, 7, 7), (200, 3))
    wind = (wind_x, wind_y, 0.0)
    differ = kept(points, shelter, wind, fall=fall) ^ _slowly(points, shelter, wind, fall)
    assert len(differ) <= 4  # small steps jump over corners of cells


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7])
def test_the_camera_does_not_matter(yaw_rad: float) -> None:
    """Neither its direction nor its own motion, up and down a hill included."""
    points = np.random.default_rng(1).uniform((5, -9, 0), (28, 9, 8), (400, 3))
    wind = (3.0, -2.0, 0.0)
    moving = camera(yaw_rad, (14.0, 1.0, 2.0))
    found = exposed(records(points, moving, wind), moving, wind, bridge())
    assert {int(n) for n in found[:, 12]} == kept(points, bridge(), wind)


def test_axes_and_heights_of_the_map_are_the_streets() -> None:
    """A street along -y of the world, at an altitude far from 0."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([4e5, 5e6, 300.0])
    points = np.random.default_rng(2).uniform((5, -9, 0), (28, 9, 8), (400, 3))
    wind = (2.0, 1.0, 0.0)
    straight = camera()
    pose = np.eye(4)
    pose[:3, :3] = turn.T @ straight.world_from_camera[:3, :3]
    pose[:3, 3] = turn.T @ straight.centre_world + shift
    turned = replace(straight, world_from_camera=pose)
    moved = replace(bridge(), origin_m=bridge().origin_m + turn @ shift, axes_world=turn)
    found = exposed(records(points, straight, wind), turned, wind, moved)
    assert {int(n) for n in found[:, 12]} == kept(points, bridge(), wind)


def test_what_rises_or_hovers_under_a_bridge_is_sheltered() -> None:
    points = np.array([[16.0, 0, 1], [2.0, 0, 1]])
    assert kept(points, bridge(), fall=0.0) == {1}
    assert kept(points, bridge(), fall=-1.0) == {1}


def test_records_pass_unchanged() -> None:
    seen_by = camera()
    points = np.random.default_rng(3).uniform((5, -9, 0), (28, 9, 8), (100, 3))
    given_records = records(points, seen_by, CALM)
    before = given_records.copy()
    found = exposed(given_records, seen_by, CALM, bridge())
    assert 0 < len(found) < 100
    assert (before == given_records).all()
    assert (found == before[found[:, 12].astype(int)]).all()
    again = exposed(given_records, seen_by, CALM, bridge())
    assert found.tobytes() == again.tobytes()


def test_an_open_sky_costs_nothing() -> None:
    seen_by = camera()
    particles = records(np.zeros((3, 3)), seen_by, CALM)
    nothing = replace(bridge(), cover_m=np.full((2, 2), np.inf, np.float32))
    far = replace(bridge(), origin_m=np.array([900.0, 0, 0]))
    assert nothing.is_open
    assert not bridge().is_open
    for shelter in (None, nothing, far):
        assert exposed(particles, seen_by, CALM, shelter) is particles
    assert len(exposed(particles[:0], seen_by, CALM, bridge())) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"cover_m": np.full((2, 2), np.nan)},
        {"cover_m": np.zeros(4)},
        {"origin_m": np.zeros(2)},
        {"axes_world": np.full((3, 3), np.nan)},
        {"cell_m": 0.0},
    ],
)
def test_a_map_of_nonsense_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ArgumentError):
        replace(bridge(), **change)  # type: ignore[arg-type]
