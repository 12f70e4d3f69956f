"""Refinement of cameras: nothing changes nothing, gradients, and a planted error is undone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import refine as module
from weather_aug.gaussians.refine import CameraRefinement, camera_from_world

Float64 = NDArray[np.float64]
KEYS = (FrameKey(0, "front"), FrameKey(1, "front"))
FAR = np.array([4.5e5, 5.3e6, 120.0])


def camera(seed: int, centre: Float64 | tuple[float, ...] = (3.0, -2.0, 1.5)) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    pose[:3, 3] = centre
    lens = np.array([[200.0, 0, 160], [0, 200, 96], [0, 0, 1]])
    return Camera(lens, pose, 320, 192, velocity_m_per_s=np.array([9.0, 1.0, 0.0]))


def cameras(origin_m: Float64 | float = 0.0) -> dict[FrameKey, Camera]:
    return {k: camera(i, np.array([3.0, -2.0, i]) + origin_m) for i, k in enumerate(KEYS)}


def moved(learnt: CameraRefinement, seed: int = 0) -> CameraRefinement:
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        for deltas in (learnt.turns_rad, learnt.shifts_m):
            deltas.copy_(torch.from_numpy(rng.normal(0, 0.1, tuple(deltas.shape))))
    return learnt


def test_nothing_learnt_is_the_recorded_pose() -> None:
    given = cameras()
    learnt = CameraRefinement(given)
    for key, recorded in given.items():
        refined = learnt.refined(key)
        np.testing.assert_array_equal(recorded.world_from_camera, refined.world_from_camera)
        np.testing.assert_array_equal(recorded.velocity_m_per_s, refined.velocity_m_per_s)
        np.testing.assert_array_equal(
            camera_from_world(recorded).astype(np.float32), learnt.camera_from_world(key).detach()
        )


def check_inverse() -> None:
    learnt = moved(CameraRefinement(cameras()))
    for key in KEYS:
        expected = np.linalg.inv(learnt.refined(key).world_from_camera)
        np.testing.assert_allclose(expected, learnt.camera_from_world(key).detach(), atol=1e-6)


def test_the_matrix_is_the_inverse_of_the_refined_pose() -> None:
    check_inverse()


def test_a_turn_the_wrong_way_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    right = CameraRefinement._motion

    def wrong(self: CameraRefinement, row: int) -> Any:
        turn, shift = right(self, row)
        return (turn.T if torch.is_grad_enabled() else turn), shift

    monkeypatch.setattr(CameraRefinement, "_motion", wrong)
    with pytest.raises(AssertionError):
        check_inverse()


def test_the_motion_is_in_the_cameras_own_axes() -> None:
    learnt = CameraRefinement(cameras())
    with torch.no_grad():
        learnt.turns_rad[1] = torch.tensor([0.0, 0.2, 0.0])
        learnt.shifts_m[1] = torch.tensor([0.0, 0.0, 0.5])
    recorded = learnt.cameras[KEYS[1]].world_from_camera
    refined = learnt.refined(KEYS[1]).world_from_camera
    np.testing.assert_allclose(recorded[:3, 3] + 0.5 * recorded[:3, 2], refined[:3, 3], atol=1e-7)
    turn = Rotation.from_matrix(recorded[:3, :3].T @ refined[:3, :3]).as_rotvec()
    np.testing.assert_allclose([0.0, 0.2, 0.0], turn, atol=1e-7)
    np.testing.assert_array_equal(
        learnt.cameras[KEYS[0]].world_from_camera, learnt.refined(KEYS[0]).world_from_camera
    )


@pytest.mark.parametrize("seed", [None, 0])
def test_gradients(seed: int | None) -> None:
    """Against central differences of the inverse of the refined pose, in float64."""

    def of(dtype: torch.dtype) -> CameraRefinement:
        learnt = CameraRefinement(cameras())
        return (learnt if seed is None else moved(learnt, seed)).to(dtype)

    weights = np.random.default_rng(1).normal(size=(4, 4))

    def loss(name: str, place: int, step: float) -> float:
        learnt = of(torch.float64)
        with torch.no_grad():
            getattr(learnt, name)[1, place] += step
        return float((np.linalg.inv(learnt.refined(KEYS[1]).world_from_camera) * weights).sum())

    learnt = of(torch.float32)
    (learnt.camera_from_world(KEYS[1]) * torch.from_numpy(weights)).sum().backward()  # type: ignore[no-untyped-call]
    for name in ("turns_rad", "shifts_m"):
        grad = getattr(learnt, name).grad
        assert not grad[0].any()
        for place in range(3):
            slope = (loss(name, place, 1e-5) - loss(name, place, -1e-5)) / 2e-5
            assert float(grad[1, place]) == pytest.approx(slope, rel=1e-4, abs=1e-5)


def seen_m(matrix: NDArray[Any], points: Float64) -> Float64:
    """Points as a float32 renderer sees them."""
    matrix, low = matrix.astype(np.float32), points.astype(np.float32)
    return np.asarray(low @ matrix[:3, :3].T + matrix[:3, 3], np.float64)


def test_far_from_the_worlds_origin_millimetres_are_kept() -> None:
    points = np.random.default_rng(2).uniform(-40, 40, (200, 3))
    near, far = cameras(), cameras(FAR)
    expected = points @ camera_from_world(near[KEYS[0]])[:3, :3].T
    expected += camera_from_world(near[KEYS[0]])[:3, 3]
    shifted = CameraRefinement(far, FAR).camera_from_world(KEYS[0]).detach().numpy()
    np.testing.assert_allclose(expected, seen_m(shifted, points), atol=1e-4)
    plain = CameraRefinement(far).camera_from_world(KEYS[0]).detach().numpy()
    assert np.abs(expected - seen_m(plain, points + FAR)).max() > 0.1


def test_a_planted_error_of_the_pose_is_undone() -> None:
    true = cameras()
    rng = np.random.default_rng(3)
    points = torch.from_numpy(rng.uniform(-4, 4, (60, 3)) + np.array([3, -2, 0])).float()
    wrong = {}
    for key, given in true.items():
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        motion[:3, 3] = rng.normal(0, 0.03, 3)
        pose = given.world_from_camera @ motion
        wrong[key] = Camera(given.intrinsics, pose, 320, 192)
    learnt = CameraRefinement(wrong)
    optimiser = torch.optim.LBFGS(
        learnt.parameters(), max_iter=40, line_search_fn="strong_wolfe", tolerance_change=1e-12
    )

    def loss() -> Tensor:
        """Mean square distance between where points are and where they should be, camera axes."""
        optimiser.zero_grad()
        total = torch.zeros(())
        for key in KEYS:
            target = torch.from_numpy(camera_from_world(true[key])).float()
            off = learnt.camera_from_world(key) - target
            total = total + (points @ off[:3, :3].T + off[:3, 3]).square().mean()
        total.backward()  # type: ignore[no-untyped-call]
        return total

    optimiser.step(loss)
    for key in KEYS:
        np.testing.assert_allclose(
            true[key].world_from_camera, learnt.refined(key).world_from_camera, atol=2e-3
        )


def test_a_resized_camera_gets_the_same_motion() -> None:
    learnt = moved(CameraRefinement(cameras()))
    small = learnt.cameras[KEYS[0]].resized(80, 48)
    refined = learnt.refined(KEYS[0], small)
    assert (refined.width, refined.height) == (80, 48)
    np.testing.assert_array_equal(
        learnt.refined(KEYS[0]).world_from_camera, refined.world_from_camera
    )


def test_other_cameras_are_refused() -> None:
    learnt = CameraRefinement(cameras())
    for use in (learnt.camera_from_world, learnt.refined):
        with pytest.raises(ArgumentError, match="recorded pose"):
            use(FrameKey(5, "front"))
    assert module.LEARNING_RATE == 1e-5
