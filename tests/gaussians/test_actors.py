"""Actors: who is one, where each is at any moment, and its Gaussians there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from weather_aug.clip.types import Box, Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import actors as module
from weather_aug.gaussians import placing, placing_kernels
from weather_aug.gaussians.actors import (
    ActorPoses,
    actors_of,
    is_deformable,
    offset_bases,
    offset_basis,
    offsets_penalty,
    placed,
    pose_at,
)
from weather_aug.gaussians.types import Actor

SEEDS = st.integers(0, 2**32 - 1)


def track(seed: int, moments: int = 7, *, turn_rad: float = 0.4, deformable: bool = False) -> Actor:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (moments, 1, 1))
    turns = Rotation.from_rotvec(rng.normal(0, turn_rad, (moments, 3)))
    poses[:, :3, :3] = (Rotation.random(rng=rng) * turns).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(0, 1, (moments, 3)), axis=0)
    times_s = np.cumsum(rng.uniform(0.05, 0.2, moments))
    return Actor(seed, "car", deformable, (4.0, 1.8, 1.5), times_s, poses)


def moments_between(actor: Actor, count: int = 9) -> NDArray[np.float64]:
    return np.linspace(actor.times_s[0], actor.times_s[-1], count)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_at_a_tracked_moment_the_pose_is_the_tracked_one(seed: int) -> None:
    actor = track(seed)
    for time_s, pose in zip(actor.times_s, actor.world_from_actor, strict=True):
        np.testing.assert_array_equal(pose, pose_at(actor, float(time_s)))


def check_between(actor: Actor) -> None:
    """Rigid, straight, and turning as scipy's slerp does."""
    slerp = Slerp(actor.times_s, Rotation.from_matrix(actor.world_from_actor[:, :3, :3]))
    for time_s in moments_between(actor):
        pose = pose_at(actor, float(time_s))
        assert pose is not None
        np.testing.assert_allclose(np.eye(3), pose[:3, :3] @ pose[:3, :3].T, atol=1e-12)
        np.testing.assert_allclose(slerp(time_s).as_matrix(), pose[:3, :3], atol=1e-12)
        for axis in range(3):
            straight = np.interp(time_s, actor.times_s, actor.world_from_actor[:, axis, 3])
            assert pose[axis, 3] == pytest.approx(straight, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-5, 0.4, 3.0]))
def test_between_tracked_moments_a_pose_is_rigid_and_turns_evenly(seed: int, turn: float) -> None:
    check_between(track(seed, turn_rad=turn))


def test_a_blend_of_matrices_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "slerped", lambda a, b, share: (1 - share) * a + share * b)
    with pytest.raises(AssertionError):
        check_between(track(1))


def test_outside_its_track_an_actor_is_nowhere() -> None:
    actor = track(2)
    first_s, last_s = float(actor.times_s[0]), float(actor.times_s[-1])
    assert pose_at(actor, first_s - 2e-6) is None
    assert pose_at(actor, last_s + 2e-6) is None
    np.testing.assert_array_equal(actor.world_from_actor[0], pose_at(actor, first_s - 5e-7))
    np.testing.assert_array_equal(actor.world_from_actor[-1], pose_at(actor, last_s + 5e-7))
    with pytest.raises(ArgumentError, match="time_s"):
        pose_at(actor, float("nan"))


def test_the_basis_is_bounded_orthogonal_and_has_no_constant() -> None:
    times_s = np.array([3.0, 3.5, 5.0])
    rows = np.array([offset_basis(times_s, float(t), 5) for t in np.linspace(3.0, 5.0, 2001)])
    assert rows.shape == (2001, 5)
    assert np.abs(rows).max() <= 1.0
    np.testing.assert_allclose(np.trapezoid(rows, dx=1 / 2000, axis=0), 0.0, atol=1e-6)
    squares = np.trapezoid(rows[:, :, None] * rows[:, None, :], dx=1 / 2000, axis=0)
    np.testing.assert_allclose(0.5 * np.eye(5), squares, atol=1e-6)
    assert np.abs(np.diff(rows, axis=0)).max() < 5 * np.pi / 2000 * 1.01
    np.testing.assert_array_equal(offset_basis(times_s, 3.0), offset_basis(times_s, 1.0))
    assert not offset_basis(times_s[:1], 3.0).any()


def test_rigid_actors_have_no_basis() -> None:
    bases = offset_bases([track(1), track(2, deformable=True)], 0.3)
    assert bases.shape == (2, 4)
    assert not bases[0].any()
    assert bases[1].any()
    assert offset_bases([], 0.3).shape == (0, 4)


@pytest.mark.parametrize(
    ("class_name", "expected"),
    [
        ("person", True),
        ("rider", True),
        ("Pedestrian with Object", True),
        ("human.pedestrian.adult", True),
        ("vehicle.bicycle", True),
        ("Bicyclist", True),
        ("TYPE_CYCLIST", True),
        ("Person_sitting", True),
        ("Car", False),
        ("vehicle.bus.rigid", False),
        ("Caravan/RV", False),
        ("Tram", False),
    ],
)
def test_walkers_and_riders_deform(class_name: str, expected: bool) -> None:
    assert is_deformable(class_name) is expected


def frame_of(index: int, time_s: float, boxes: tuple[Box, ...], camera: str = "front") -> Frame:
    view = Camera(np.diag([50.0, 50.0, 1.0]), np.eye(4), 8, 6)
    image = np.zeros((6, 8, 3), np.uint8)
    return Frame(FrameKey(index, camera), time_s, view, image, boxes=boxes)


def box_at(track_id: int, class_name: str, x_m: float, length_m: float = 4.0) -> Box:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return Box(track_id, class_name, pose, (length_m, 1.8, 1.5))


def test_what_moves_is_an_actor_and_what_stands_is_not() -> None:
    reach_m = {("car", 1): 1.2, ("car", 2): 0.8, ("person", 3): 0.8, ("person", 4): 0.4}
    frames = [
        frame_of(
            i, 0.1 * i, tuple(box_at(n, name, far * i / 4) for (name, n), far in reach_m.items())
        )
        for i in range(5)
    ]
    found = actors_of(frames[::-1])
    assert [(1, False), (3, True)] == [(a.track_id, a.is_deformable) for a in found]
    np.testing.assert_allclose([0.0, 0.1, 0.2, 0.3, 0.4], found[0].times_s)
    np.testing.assert_allclose([0.0, 0.3, 0.6, 0.9, 1.2], found[0].world_from_actor[:, 0, 3])
    assert [1, 2, 3, 4] == [a.track_id for a in actors_of(frames, moving_m=0.5)]
    assert actors_of(frames[:1]) == ()


def test_a_track_takes_its_commonest_class_and_median_size() -> None:
    names, lengths = ("Truck", "Car", "Car"), (9.0, 4.0, 4.4)
    boxes = [box_at(1, n, 3.0 * i, lengths[i]) for i, n in enumerate(names)]
    (actor,) = actors_of([frame_of(i, 0.1 * i, (box,)) for i, box in enumerate(boxes)])
    assert (actor.class_name, actor.size_m) == ("Car", (4.4, 1.8, 1.5))


def test_boxes_of_one_sweep_in_several_cameras_are_one_moment() -> None:
    """A car at 10 m/s: without that it would stand still between the cameras, then leap."""
    early_s = {"left": -0.02, "front": 0.0, "right": 0.02}
    frames = [
        frame_of(i, 0.1 * i + off_s, (box_at(1, "car", float(i)),), camera)
        for i in range(4)
        for camera, off_s in early_s.items()
    ]
    (actor,) = actors_of(frames)
    for frame in frames:
        pose = pose_at(actor, frame.time_s)
        assert pose is not None
        assert pose[0, 3] == pytest.approx(10 * frame.time_s, abs=1e-9)


def test_nothing_learnt_gives_the_recorded_poses() -> None:
    actors = [track(1), track(2, 9), track(3, 1)]
    learnt = ActorPoses(actors)
    for actor, refined in zip(actors, learnt.refined(), strict=True):
        np.testing.assert_array_equal(actor.world_from_actor, refined.world_from_actor)
    for time_s in actors[0].times_s:
        poses, present = learnt.poses(float(time_s))
        for actor, pose, is_there in zip(actors, poses.detach().numpy(), present, strict=True):
            expected = pose_at(actor, float(time_s))
            assert (expected is not None) == bool(is_there)
            if expected is not None:
                np.testing.assert_array_equal(expected.astype(np.float32)[:, 3], pose[:, 3])
                np.testing.assert_allclose(expected, pose, atol=1e-6)


def moved(learnt: ActorPoses, seed: int, turn_rad: float = 0.1) -> ActorPoses:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for deltas, size in ((learnt.rotations_rad, turn_rad), (learnt.translations_m, 0.2)):
            deltas.copy_(size * torch.randn(deltas.shape, generator=generator))
    return learnt


@pytest.mark.parametrize("turn_rad", [0.0, 1e-6, 0.4])
def test_the_poses_are_those_of_the_refined_tracks(turn_rad: float) -> None:
    learnt = moved(ActorPoses([track(s, turn_rad=turn_rad) for s in (4, 5)]), 0)
    refined = learnt.refined()
    for time_s in np.linspace(0.0, 1.5, 23):
        poses, present = learnt.poses(float(time_s))
        for actor, pose, is_there in zip(refined, poses.detach().numpy(), present, strict=True):
            expected = pose_at(actor, float(time_s))
            assert (expected is not None) == bool(is_there)
            if expected is not None:
                np.testing.assert_allclose(expected, pose, atol=2e-6)


def check_pose_gradients(actor: Actor, time_s: float) -> None:
    """Against central differences of the float64 poses that `pose_at` gives of refined tracks."""
    learnt = moved(ActorPoses([actor]), 1)
    weights = np.random.default_rng(0).normal(size=(4, 4))
    poses, _ = learnt.poses(time_s)
    (poses[0] * torch.from_numpy(weights).float()).sum().backward()

    def loss(name: str, place: tuple[int, ...], step: float) -> float:
        other = moved(ActorPoses([actor]), 1).double()
        with torch.no_grad():
            getattr(other, name)[place] += step
        pose = pose_at(other.refined()[0], time_s)
        assert pose is not None
        return float((pose * weights).sum())

    for name in ("rotations_rad", "translations_m"):
        grad = getattr(learnt, name).grad
        for place in np.ndindex(*grad.shape):
            slope = (loss(name, place, 1e-6) - loss(name, place, -1e-6)) / 2e-6
            assert float(grad[place]) == pytest.approx(slope, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("moment", ["tracked", "between", "last"])
def test_gradients_of_the_poses(moment: str) -> None:
    actor = track(6, 4)
    times_s = {"tracked": actor.times_s[1], "last": actor.times_s[-1]}
    check_pose_gradients(actor, float(times_s.get(moment, 0.3 * actor.times_s[1:3].sum() + 0.05)))


def test_gradients_of_a_track_that_does_not_turn_are_finite() -> None:
    actor = track(7, 4, turn_rad=0.0)
    learnt = ActorPoses([actor])
    poses, _ = learnt.poses(float(actor.times_s[:2].mean()))
    poses.sum().backward()
    assert learnt.rotations_rad.grad is not None
    assert bool(torch.isfinite(learnt.rotations_rad.grad).all())
    assert bool((learnt.rotations_rad.grad[:2] != 0).any())


def test_poses_far_from_the_worlds_origin_keep_millimetres() -> None:
    actor = track(8)
    far = np.array([4.5e5, 5.3e6, 100.0])
    poses = actor.world_from_actor.copy()
    poses[:, :3, 3] += far
    away = ActorPoses([replace(actor, world_from_actor=poses)], far)
    time_s = float(actor.times_s[2])
    expected = pose_at(actor, time_s)
    assert expected is not None
    np.testing.assert_allclose(expected, away.poses(time_s)[0][0].detach().numpy(), atol=1e-5)


def test_who_moves_evenly_pays_nothing_and_jitter_is_smoothed() -> None:
    actor = track(9, 12)
    poses = actor.world_from_actor.copy()
    poses[:, :3, 3] = np.outer(actor.times_s - 5.0, [8.0, 1.0, 0.0])
    even = ActorPoses([replace(actor, world_from_actor=poses), track(10, 4)])
    assert float(even.smoothness().detach()) == pytest.approx(0.0, abs=1e-12)
    rng = np.random.default_rng(0)
    jittered = poses.copy()
    jittered[:, :3, 3] += rng.normal(0, 0.1, (12, 3))
    learnt = ActorPoses([replace(actor, world_from_actor=jittered)])
    before = float(learnt.smoothness().detach())
    assert before > 0.1
    optimiser = torch.optim.Adam([learnt.translations_m], lr=0.01)
    for _ in range(60):
        optimiser.zero_grad()
        learnt.smoothness().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    assert float(learnt.smoothness().detach()) < 0.3 * before
    few = ActorPoses([track(10, 4)]).smoothness()
    assert float(few.detach()) == 0.0


def test_without_actors_there_is_nothing() -> None:
    learnt = ActorPoses([])
    poses, present = learnt.poses(0.0)
    assert (tuple(poses.shape), tuple(present.shape)) == ((0, 4, 4), (0,))
    assert learnt.refined() == ()
    assert float(learnt.smoothness().detach()) == 0.0


def cloud(dtype: torch.dtype = torch.float32) -> tuple[list[Tensor], Tensor, Tensor]:
    """Means, quaternions, offsets, poses with gradients; owners; bases."""
    rng = np.random.default_rng(3)
    actors = [track(s, deformable=s > 11) for s in (11, 12, 13)]
    poses = np.array([pose_at(a, 0.31) for a in actors])
    owners = torch.from_numpy(rng.integers(0, 3, 200).astype(np.int32))
    arrays = [rng.normal(size=shape) for shape in ((200, 3), (200, 4), (200, 4, 3))]
    given = [torch.from_numpy(a).to(dtype).requires_grad_() for a in (*arrays, poses)]
    return given, owners, torch.from_numpy(offset_bases(actors, 0.31))


def world_of(given: list[Tensor], owners: Tensor, bases: Tensor) -> tuple[Tensor, Tensor]:
    means, quaternions, offsets, poses = given
    return placed(means, quaternions, owners, offsets, poses, bases)


def test_placed_gaussians_are_where_matrices_put_them() -> None:
    given, owners, bases = cloud()
    means, quaternions = (t.detach().numpy() for t in world_of(given, owners, bases))
    own_means, own_quaternions, offsets, poses = (t.detach().numpy() for t in given)
    for row, owner in enumerate(owners.tolist()):
        pose = poses[owner].astype(np.float64)
        here = own_means[row] + bases[owner].numpy() @ offsets[row]
        np.testing.assert_allclose(pose[:3, :3] @ here + pose[:3, 3], means[row], atol=1e-5)
        turn = Rotation.from_quat(own_quaternions[row], scalar_first=True).as_matrix()
        world = Rotation.from_quat(quaternions[row], scalar_first=True).as_matrix()
        np.testing.assert_allclose(pose[:3, :3] @ turn, world, atol=1e-5)
    lengths = np.linalg.norm(own_quaternions, axis=1), np.linalg.norm(quaternions, axis=1)
    np.testing.assert_allclose(*lengths, rtol=1e-5)


def check_placed_gradients() -> None:
    grads: dict[torch.dtype, Any] = {}
    for dtype in (torch.float32, torch.float64):
        given, owners, bases = cloud(dtype)
        rng = np.random.default_rng(4)
        loss = sum(
            (out * torch.from_numpy(rng.normal(size=out.shape)).to(dtype)).sum()
            for out in world_of(given, owners, bases)
        )
        grads[dtype] = torch.autograd.grad(loss, given)  # type: ignore[arg-type]
    for exact, fast in zip(grads[torch.float64], grads[torch.float32], strict=True):
        assert float((exact - fast).abs().max()) <= 1e-4 * float(exact.abs().max())


def test_gradients_of_placed_gaussians() -> None:
    check_placed_gradients()


def _without(place: int) -> Callable[..., None]:
    right = placing_kernels.place_back

    def wrong(*arrays: Any) -> None:
        right(*arrays)
        arrays[place][:] = 0.0

    return wrong


@pytest.mark.parametrize("place", [-5, -4, -3, -2, -1])
def test_a_lost_gradient_is_found(place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placing_kernels, "place_back", _without(place))
    with pytest.raises(AssertionError):
        check_placed_gradients()


def test_the_other_order_of_turns_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    right = placing_kernels.place

    def wrong(means: Any, quaternions: Any, owners: Any, *rest: Any) -> None:
        right(means, quaternions, owners, *rest)
        rest[-1][:] = quaternions

    monkeypatch.setattr(placing_kernels, "place", wrong)
    with pytest.raises(AssertionError):
        test_placed_gaussians_are_where_matrices_put_them()


def test_placing_refuses_what_does_not_fit() -> None:
    given, owners, bases = cloud()
    with pytest.raises(ArgumentError, match="owners"):
        world_of(given, owners + 1, bases)
    with pytest.raises(ArgumentError, match="offsets_m"):
        world_of(given, owners, bases[:, :2])
    empty = [t[:0] for t in given[:3]]
    means, _ = placing.placed(empty[0], empty[1], owners[:0], empty[2], given[3], bases)
    assert tuple(means.shape) == (0, 3)


def test_the_penalty_is_the_mean_square_of_the_offsets() -> None:
    generator = torch.Generator().manual_seed(0)
    offsets_m = torch.randn(7, 4, 3, generator=generator)
    times_s = np.array([0.0, 2.0])
    moments = (np.arange(4000) + 0.5) / 2000
    rows = np.array([offset_basis(times_s, float(t)) for t in moments])
    seen_m = np.einsum("tb,mbd->tmd", rows, offsets_m.numpy())
    assert float(offsets_penalty(offsets_m)) == pytest.approx(
        float((seen_m**2).sum(axis=2).mean()), rel=1e-4
    )
