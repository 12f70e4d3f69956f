"""Which view each camera looks at: the tables, the rule on rigs, and links within a window."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weather_aug.clip.dgp import DgpClip
from weather_aug.clip.kitti import KittiOdometryClip
from weather_aug.clip.types import Camera
from weather_aug.edit.diffusion import references as module
from weather_aug.edit.diffusion.references import (
    SAME_RAD,
    VIEW_TABLES,
    Links,
    view_references,
    window_links,
)
from weather_aug.errors import ArgumentError

SHARED = Path(__file__).resolve().parents[3] / ".." / "shared" / "data"
DDAD, KITTI = SHARED / "dgp-ddad", SHARED / "kitti-odom02-stereo20"

AHEAD = np.array([1.0, 0.0, 0.0])
LEVEL_LOOKING_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes in a world with x ahead, y left, z up."""
Placed = tuple[float, tuple[float, float]]
RIGS: dict[str, tuple[Placed, ...]] = {
    "alone": ((0, (1.5, 0.0)),),
    "stereo (KITTI)": ((0, (1.0, 0.27)), (0, (1.0, -0.27))),
    "three (PandaSet)": ((0, (1.0, 0.0)), (55, (0.9, 0.5)), (-55, (0.9, -0.5))),
    "five (Waymo)": (
        (0, (1.54, -0.02)),
        (45, (1.50, 0.10)),
        (-45, (1.49, -0.10)),
        (90, (1.43, 0.12)),
        (-90, (1.43, -0.12)),
    ),
    "ring of six (nuScenes)": (
        (0, (1.7, 0.0)),
        (55, (1.5, 0.5)),
        (-55, (1.5, -0.5)),
        (110, (1.0, 0.5)),
        (-110, (1.0, -0.5)),
        (180, (0.0, 0.0)),
    ),
}
"""Yaw to the left in degrees and the centre (ahead, left) in metres, in the order of the tables."""
SEEDS = st.integers(0, 2**32 - 1)
ANY_RIG = pytest.mark.parametrize("name", RIGS)


def camera(
    rotation: NDArray[np.float64], centre: Sequence[float], velocity: Sequence[float] = (0, 0, 0)
) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    intrinsics = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    return Camera(intrinsics, pose, 640, 480, velocity_m_per_s=np.asarray(velocity, float))


def rig(
    name: str, *, off_deg: float = 0.0, seed: int = 0, velocity: Sequence[float] = (0, 0, 0)
) -> list[Camera]:
    """Cameras mounted to within `off_deg` about every axis, on a car that stands anywhere."""
    rng = np.random.default_rng(seed)
    cameras = []
    for yaw_deg, centre in RIGS[name]:
        off = Rotation.from_euler("xyz", rng.uniform(-off_deg, off_deg, 3), degrees=True)
        turn = Rotation.from_euler("z", yaw_deg, degrees=True) * off
        axes = turn.as_matrix() @ LEVEL_LOOKING_AHEAD
        cameras.append(camera(axes, (*centre, 1.6), velocity))
    return cameras


def moved(cameras: Sequence[Camera], motion: Rotation, by: NDArray[np.float64]) -> list[Camera]:
    turn = motion.as_matrix()
    return [
        camera(turn @ one.world_from_camera[:3, :3], turn @ one.centre_world + by)
        for one in cameras
    ]


def check_tables(off_deg: float = 0.5) -> None:
    for name in RIGS:
        for seed in range(20):
            cameras = rig(name, off_deg=off_deg, seed=seed)
            assert VIEW_TABLES[len(cameras)] == view_references(cameras, AHEAD), name


def test_the_tables_are_the_releases_and_go_on_to_six() -> None:
    assert {1: (0,), 2: (1, 0), 3: (0, 0, 0), 5: (0, 0, 0, 1, 2), 6: (0, 0, 0, 1, 2, 3)} == dict(
        VIEW_TABLES
    )


def test_the_rule_gives_the_tables_on_rigs_mounted_to_half_a_degree() -> None:
    check_tables()


@ANY_RIG
def test_without_a_way_ahead_the_fan_tells_the_front(name: str) -> None:
    cameras = rig(name)
    assert VIEW_TABLES[len(cameras)] == view_references(cameras)


def test_a_ring_that_moves_knows_its_front_by_its_motion() -> None:
    """Backwards as well: the front of the drive is then the camera at the back."""
    name = "ring of six (nuScenes)"
    assert VIEW_TABLES[6] == view_references(rig(name, velocity=(8, 0, 0)))
    assert (2, 3, 4, 5, 5, 5) == view_references(rig(name, velocity=(-8, 0, 0)))


def test_a_fan_is_not_misled_by_its_motion() -> None:
    name = "five (Waymo)"
    assert VIEW_TABLES[5] == view_references(rig(name, velocity=(-2, 0, 0)))


@given(SEEDS, st.floats(0, 0.5))
@settings(max_examples=40, deadline=None)
def test_where_the_world_is_turned_does_not_matter(seed: int, off_deg: float) -> None:
    motion = Rotation.random(rng=seed)
    by = np.random.default_rng(seed).uniform(-1e3, 1e3, 3)
    for name in RIGS:
        cameras = moved(rig(name, off_deg=off_deg, seed=seed), motion, by)
        assert VIEW_TABLES[len(cameras)] == view_references(cameras, motion.apply(AHEAD)), name


def check_permuted(cameras: Sequence[Camera], ahead: NDArray[np.float64] | None, seed: int) -> None:
    order = np.random.default_rng(seed).permutation(len(cameras))
    before = view_references(cameras, ahead)
    after = view_references([cameras[i] for i in order], ahead)
    for place, this in enumerate(order):
        assert before[this] == order[after[place]]


@given(SEEDS, st.integers(1, 9), st.sampled_from((0.0, 5.0, 180.0)), st.booleans())
@settings(max_examples=100, deadline=None)
def test_another_order_gives_the_same_references(
    seed: int, count: int, spread_deg: float, told: bool
) -> None:
    """Of cameras that point anywhere, nearly alike, or exactly alike."""
    rng = np.random.default_rng(seed)
    cameras = [
        camera(
            Rotation.from_euler(
                "xyz", rng.uniform(-spread_deg, spread_deg, 3), degrees=True
            ).as_matrix(),
            rng.uniform(-2, 2, 3),
        )
        for _ in range(count)
    ]
    check_permuted(cameras, rng.normal(size=3) if told else None, seed)


@ANY_RIG
@pytest.mark.parametrize("seed", range(5))
def test_another_order_of_a_real_rig_gives_the_same_references(name: str, seed: int) -> None:
    check_permuted(rig(name), AHEAD, seed)


@given(SEEDS, st.integers(1, 9))
@settings(max_examples=100, deadline=None)
def test_every_camera_comes_to_the_front_step_by_step(seed: int, count: int) -> None:
    cameras = [
        camera(turn.as_matrix(), centre)
        for turn, centre in zip(
            Rotation.random(count, rng=seed),
            np.random.default_rng(seed).uniform(-2, 2, (count, 3)),
            strict=True,
        )
    ]
    ahead = np.random.default_rng(seed + 1).normal(size=3)
    references = view_references(cameras, ahead)
    axes = np.stack([one.world_from_camera[:3, 2] for one in cameras])
    cosines = axes @ ahead / np.linalg.norm(ahead)
    front = int(cosines.argmax())
    off_rad = np.sort(np.arccos(cosines))
    assume(count == 1 or off_rad[1] - off_rad[0] > 1.01 * SAME_RAD)
    for this in range(count):
        for _ in range(count):
            this = references[this]
        assert this == front or references[this] == front


def test_sides_of_a_rig_with_a_stereo_pair_look_at_one_of_it() -> None:
    pair = rig("stereo (KITTI)", off_deg=0.5)
    sides = rig("five (Waymo)")[1:3]
    assert (1, 0, 0, 0) == view_references([*pair, *sides], AHEAD)


@pytest.mark.skipif(not DDAD.is_dir(), reason="no shared DDAD data")
def test_the_rule_gives_the_table_on_ddad() -> None:
    clip = DgpClip(DDAD / "test_scene", scene="scene_02", scale=0.1, frames=slice(0, 1))
    cameras = [clip.frame(key).camera for key in clip.keys]
    assert VIEW_TABLES[6] == view_references(cameras, cameras[0].velocity_m_per_s)
    assert VIEW_TABLES[6] == view_references(cameras)
    for seed in range(5):
        check_permuted(cameras, None, seed)


@pytest.mark.skipif(not KITTI.is_dir(), reason="no shared KITTI odometry data")
def test_the_rule_gives_the_table_on_kitti() -> None:
    clip = KittiOdometryClip(KITTI, cameras=("left", "right"), scale=0.2, frames=slice(0, 2))
    time = clip.keys[0].time_index
    cameras = [clip.frame(key).camera for key in clip.keys if key.time_index == time]
    assert VIEW_TABLES[2] == view_references(cameras)


def _forwards(cameras: Sequence[Camera], of: Camera) -> list[float]:
    return [float(one.centre_world @ AHEAD) for one in cameras]


FAULTS: dict[str, tuple[str, object]] = {
    "nothing is parallel": ("SAME_RAD", 0.0),
    "all at the front": ("SAME_RAD", math.pi),
    "no partner": ("_partner", lambda cameras, front, from_front_rad: front),
    "right for left": (
        "_leftness_m",
        lambda cameras, of: [-left for left in _LEFTNESS(cameras, of)],
    ),
    "no tie is broken by side": ("_leftness_m", _forwards),
}
_LEFTNESS = module._leftness_m


@pytest.mark.parametrize("fault", FAULTS)
def test_the_tables_catch(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, *FAULTS[fault])
    with pytest.raises(AssertionError):
        check_tables()
        assert VIEW_TABLES[6] == view_references(rig("ring of six (nuScenes)")[::-1], AHEAD)


def test_what_has_no_front_is_refused() -> None:
    with pytest.raises(ArgumentError, match="at least one camera"):
        view_references([])
    both_ways = [camera(LEVEL_LOOKING_AHEAD, (0, 0, 0))]
    both_ways.append(camera(np.diag([-1.0, -1.0, 1.0]) @ LEVEL_LOOKING_AHEAD, (0, 0, 0)))
    with pytest.raises(ArgumentError, match="give ahead_world"):
        view_references(both_ways)
    assert (0, 0) == view_references(both_ways, AHEAD)
    for wrong in ((0, 0, 0), (1, 0), (math.nan, 0, 1)):
        with pytest.raises(ArgumentError, match="ahead_world"):
            view_references(both_ways, wrong)


CAMERAS = ("a", "b", "c", "d")


@st.composite
def windows(draw: st.DrawFn) -> tuple[list[list[str]], dict[str, str]]:
    """Any times with any cameras, none included, in any order."""
    times = draw(st.lists(st.lists(st.sampled_from(CAMERAS), unique=True), min_size=1, max_size=4))
    return times, {name: draw(st.sampled_from(CAMERAS)) for name in CAMERAS}


def check_links(
    links: Callable[..., Links], times: list[list[str]], reference: dict[str, str]
) -> None:
    """Each link leads to the picture of the right time and camera, else to the picture itself."""
    pictures = [(time, name) for time, names in enumerate(times) for name in names]
    found = links(times, reference)
    assert len(pictures) == len(found)
    for this, (time, name) in enumerate(pictures):
        for wanted, index in (
            ((time, reference[name]), found.view[this]),
            ((time - 1, name), found.before[this]),
            ((time + 1, name), found.after[this]),
        ):
            assert (wanted if wanted in pictures else (time, name)) == pictures[index]


@given(windows())
@settings(max_examples=200, deadline=None)
def test_links_lead_where_they_should_and_home_where_cameras_are_missing(
    window: tuple[list[list[str]], dict[str, str]],
) -> None:
    check_links(window_links, *window)


def _swapped(times: list[list[str]], reference: dict[str, str]) -> Links:
    links = window_links(times, reference)
    return Links(links.view, links.after, links.before)


def _by_slot(times: list[list[str]], reference: dict[str, str]) -> Links:
    """As code does that takes every time to have all cameras."""
    links = window_links(times, reference)
    views = len(times[0])
    return Links(links.view, tuple(max(i - views, 0) for i in range(len(links))), links.after)


@pytest.mark.parametrize("wrong", (_swapped, _by_slot))
def test_links_catch(wrong: Callable[..., Links]) -> None:
    times, reference = [["a", "b"], ["b"], ["b", "a"]], dict.fromkeys(CAMERAS, "a")
    check_links(window_links, times, reference)
    with pytest.raises(AssertionError):
        check_links(wrong, times, reference)


def test_clips_of_one_and_two_frames_have_links() -> None:
    reference = {"a": "a", "b": "a"}
    assert Links((0, 0), (0, 1), (0, 1)) == window_links([["a", "b"]], reference)
    assert Links((0, 0), (0, 1), (0, 1)) == window_links([[], ["a", "b"], []], reference)
    assert Links((0, 0, 2, 2), (0, 1, 0, 1), (2, 3, 2, 3)) == window_links(
        [["a", "b"], ["a", "b"]], reference
    )


def test_links_that_lead_nowhere_are_refused() -> None:
    with pytest.raises(ArgumentError, match="2 of view but 1 of before"):
        Links((0, 0), (0,), (0, 1))
    with pytest.raises(ArgumentError, match="names picture 2 of a batch of 2"):
        Links((0, 0), (0, 1), (0, 2))
    with pytest.raises(ArgumentError, match="camera a twice"):
        window_links([["a", "a"]], {"a": "a"})
    with pytest.raises(ArgumentError, match="camera b has no view reference"):
        window_links([["a", "b"]], {"a": "a"})
