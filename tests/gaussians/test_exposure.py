"""Affine exposure of pictures: the map, its gradients, and who is held at the identity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import exposure_kernels
from weather_aug.gaussians.exposure import LEARNING_RATE, Exposures, exposed, nearest

KEYS = tuple(FrameKey(i, camera) for i in range(3) for camera in ("left", "right"))


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=shape)).to(dtype)


def test_at_first_a_picture_stays_what_it_is() -> None:
    exposures, image = Exposures(KEYS), random(5, 7, 3)
    for key in KEYS:
        assert torch.equal(image, exposures(key, image))
    assert float(exposures.penalty().detach()) == 0.0


def check_gradients() -> None:
    grads: dict[torch.dtype, tuple[Tensor, ...]] = {}
    for dtype in (torch.float32, torch.float64):
        image = random(40, 61, 3, seed=1, dtype=dtype).requires_grad_()
        matrix = random(3, 4, seed=2, dtype=dtype).requires_grad_()
        loss = (exposed(image, matrix) * (random(40, 61, 3, seed=3, dtype=dtype) - 0.3)).sum()
        grads[dtype] = (loss.detach(), *torch.autograd.grad(loss, (image, matrix)))
    for exact, fast in zip(grads[torch.float64], grads[torch.float32], strict=True):
        assert float((exact - fast).abs().max()) <= 1e-4 * float(exact.abs().max())


def test_gradients_of_the_map() -> None:
    check_gradients()


@pytest.mark.parametrize("place", [3, 4])
def test_a_wrong_gradient_is_found_out(place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    right = exposure_kernels.expose_back

    def wrong(*arrays: Any) -> None:
        right(*arrays)
        arrays[place][..., -1] *= 0.99

    monkeypatch.setattr(exposure_kernels, "expose_back", wrong)
    with pytest.raises(AssertionError):
        check_gradients()


def test_the_map_is_the_matrix_times_colour_and_1() -> None:
    image, matrix = random(4, 5, 3), random(3, 4, seed=1)
    expected = torch.cat([image, torch.ones(4, 5, 1)], dim=2) @ matrix.T
    torch.testing.assert_close(expected, exposed(image, matrix))
    with pytest.raises(ArgumentError, match="matrix"):
        exposed(image, matrix[:, :3])


def test_the_mean_of_the_matrices_is_the_identity_whatever_is_learnt() -> None:
    exposures = Exposures(KEYS)
    with torch.no_grad():
        exposures.deltas.copy_(random(6, 3, 4) + 0.2)
    mean = np.mean(list(exposures.by_key().values()), axis=0)
    np.testing.assert_allclose(np.eye(3, 4), mean, atol=1e-6)
    off = np.array(list(exposures.by_key().values())) - np.eye(3, 4)
    assert float(exposures.penalty().detach()) == pytest.approx(float((off**2).mean()), rel=1e-5)


def test_planted_exposures_are_found() -> None:
    """Up to the mean of all, which the scene's own colours would take."""
    scene = random(12, 16, 3, seed=4)
    gains = torch.tensor([0.95, 1.0, 1.05, 0.98, 1.02, 1.0])
    exposures = Exposures(KEYS)
    optimiser = torch.optim.Adam(exposures.parameters(), lr=LEARNING_RATE)
    # Signs of an L1 loss shake what is learnt by the length of the steps, which shrink to the end.
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.1 ** (1 / 600))
    for step in range(600):
        row = step % 6
        optimiser.zero_grad()
        loss = (exposures(KEYS[row], scene) - gains[row] * scene).abs().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    for key, gain in zip(KEYS, gains.tolist(), strict=True):
        torch.testing.assert_close(gain * scene, exposures(key, scene).detach(), atol=2e-3, rtol=0)


def test_the_nearest_moment_of_the_same_camera_is_taken() -> None:
    matrices = {key: np.full((3, 4), row, np.float32) for row, key in enumerate(KEYS)}
    assert nearest(matrices, FrameKey(7, "left")) is matrices[FrameKey(2, "left")]
    assert nearest(matrices, FrameKey(1, "right")) is matrices[FrameKey(1, "right")]
    del matrices[FrameKey(1, "left")]
    assert nearest(matrices, FrameKey(1, "left")) is matrices[FrameKey(0, "left")]
    np.testing.assert_array_equal(np.eye(3, 4), nearest(matrices, FrameKey(1, "rear")))


def test_pictures_that_were_not_learnt_and_keys_given_twice_are_refused() -> None:
    with pytest.raises(ArgumentError, match="nearest"):
        Exposures(KEYS)(FrameKey(9, "left"), random(2, 2, 3))
    with pytest.raises(ArgumentError, match="keys"):
        Exposures((*KEYS, KEYS[0]))
