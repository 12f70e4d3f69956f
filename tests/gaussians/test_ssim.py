"""SSIM and its gradient are those of convolutions in float64, at any size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from weather_aug.errors import ArgumentError
from weather_aug.gaussians import ssim as ssim_module
from weather_aug.gaussians import ssim_rows
from weather_aug.gaussians.ssim import SsimTarget, compared, ssim

# One pixel, less than the window, less than two windows, one strip, just over one, over two.
SIZES = [(1, 1), (3, 7), (40, 5), (14, 21), (37, 160), (23, 161), (12, 330)]
KINDS = ["noise", "smooth", "flat"]
VALUE_TOLERANCE = 1e-6
SLOPE_TOLERANCE = 1e-4


def reference(
    image: Tensor,
    target: Tensor,
    *,
    size: int = 11,
    sigma: float = 1.5,
    c2: float = 0.03**2,
    padding: str = "constant",
    bessel: float = 1.0,
) -> Tensor:
    """Mean SSIM in the pictures' own precision, as 3DGS computes it."""
    ticks = torch.arange(size, dtype=torch.float64) - size // 2
    line = torch.exp(-ticks.square() / (2 * sigma**2))
    window = (torch.outer(line, line) / line.sum() ** 2).expand(3, 1, size, size).to(image.dtype)

    def blurred(planes: Tensor) -> Tensor:
        return conv2d(pad(planes, (size // 2,) * 4, mode=padding), window, groups=3)

    x, y = image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None]
    m, n = blurred(x), blurred(y)
    s_xx, s_yy = (blurred(x * x) - m * m) * bessel, (blurred(y * y) - n * n) * bessel
    s_xy = (blurred(x * y) - m * n) * bessel
    luminance = (2 * m * n + 0.01**2) / (m * m + n * n + 0.01**2)
    return (luminance * (2 * s_xy + c2) / (s_xx + s_yy + c2)).mean()


def pictures(height: int, width: int, kind: str = "smooth") -> tuple[Tensor, Tensor]:
    """A picture and a target like it, (H, W, 3)."""
    rng = torch.Generator().manual_seed(1000 * height + width)
    if kind == "noise":
        target = torch.rand(height, width, 3, generator=rng)
    elif kind == "smooth":
        grid = torch.rand(1, 3, 2 + height // 8, 2 + width // 8, generator=rng)
        target = interpolate(grid, (height, width), mode="bilinear")[0].permute(1, 2, 0)
    else:
        # Bright and even, to 8 bits: what blurred squares less squared blurs lose most of.
        target = 0.9 + torch.randint(0, 2, (height, width, 3), generator=rng) / 255
    image = target + 0.03 * torch.randn(height, width, 3, generator=rng)
    return image.clamp(0, 1).contiguous(), target.contiguous()


def value_and_slopes(image: Tensor, target: Tensor | SsimTarget) -> tuple[float, Tensor]:
    image = image.clone().requires_grad_()
    value = ssim(image, target)
    value.backward()
    assert image.grad is not None
    return value.item(), image.grad


def reference_slopes(image: Tensor, target: Tensor, **fault: Any) -> tuple[float, Tensor]:
    image = image.double().requires_grad_()
    value = reference(image, target.double(), **fault)
    value.backward()
    assert image.grad is not None
    return value.item(), image.grad


def relative(actual: Tensor, expected: Tensor) -> float:
    """The worse of two: errors against slopes by their norms, and by their largest."""
    off = actual.double() - expected
    largest = off.abs().max() / expected.abs().max()
    return max((off.norm() / expected.norm()).item(), largest.item())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_value_and_gradient_are_those_of_convolutions_in_float64(
    size: tuple[int, int], kind: str
) -> None:
    image, target = pictures(*size, kind)
    value, slopes = value_and_slopes(image, SsimTarget(target))
    expected, expected_slopes = reference_slopes(image, target)
    assert value == pytest.approx(expected, abs=VALUE_TOLERANCE)
    assert relative(slopes, expected_slopes) < SLOPE_TOLERANCE


@pytest.mark.parametrize(
    "fault",
    [
        {"sigma": 1.6},
        {"size": 9},
        {"c2": 0.03},
        {"padding": "reflect"},
        # scikit-image's unbiased variances.
        {"bessel": 121 / 120},
    ],
)
def test_another_ssim_is_told_apart(fault: dict[str, Any]) -> None:
    image, target = pictures(14, 21)
    value, slopes = value_and_slopes(image, target)
    other, other_slopes = reference_slopes(image, target, **fault)
    assert abs(value - other) > 10 * VALUE_TOLERANCE
    assert relative(slopes, other_slopes) > 10 * SLOPE_TOLERANCE


@pytest.mark.parametrize("left_out", [0, 1, 2])
def test_a_slope_left_out_is_seen(monkeypatch: pytest.MonkeyPatch, left_out: int) -> None:
    """Planted fault: the gradient forgets one of the three blurs."""
    similarity = ssim_rows._similarity

    def forgetful(blurred, mean, variance, values, slopes):  # type: ignore[no-untyped-def]
        similarity(blurred, mean, variance, values, slopes)
        slopes[left_out * ssim_rows._LINE :][: len(mean)] = 0

    image, target = pictures(14, 21)
    expected, expected_slopes = reference_slopes(image, target)
    monkeypatch.setattr(ssim_module, "compare", ssim_rows.compare.py_func)
    assert relative(value_and_slopes(image, target)[1], expected_slopes) < SLOPE_TOLERANCE
    monkeypatch.setattr(ssim_rows, "_similarity", forgetful)
    value, slopes = value_and_slopes(image, target)
    assert value == pytest.approx(expected, abs=VALUE_TOLERANCE)
    assert relative(slopes, expected_slopes) > 10 * SLOPE_TOLERANCE


def test_strips_without_a_reach_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: a strip ignores what lies to its left."""
    image, target = pictures(12, 330)
    expected = reference_slopes(image, target)[1]
    monkeypatch.setattr(ssim_module, "compare", ssim_rows.compare.py_func)
    assert relative(value_and_slopes(image, target)[1], expected) < SLOPE_TOLERANCE
    across = ssim_rows._across

    def cut(lines, count, ring, slot):  # type: ignore[no-untyped-def]
        lines = lines.copy()
        lines.reshape(3, -1)[:, : ssim_rows._HALO] = 0
        across(lines, count, ring, slot)

    monkeypatch.setattr(ssim_rows, "_across", cut)
    assert relative(value_and_slopes(image, target)[1], expected) > 10 * SLOPE_TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_equal_pictures_are_wholly_similar(kind: str) -> None:
    image, target = pictures(31, 47, kind)
    value, slopes = value_and_slopes(target, target)
    assert value == pytest.approx(1.0, abs=1e-6)
    # The slopes cancel to the rounding of float32 against those of pictures that differ.
    assert slopes.norm() < 1e-3 * value_and_slopes(image, target)[1].norm()


sides = st.integers(1, 40)


@settings(max_examples=30, deadline=None)
@given(sides, sides, st.sampled_from(KINDS))
def test_symmetries(height: int, width: int, kind: str) -> None:
    image, target = pictures(height, width, kind)
    value, slopes = value_and_slopes(image, target)
    assert value <= 1 + 1e-6
    assert ssim(target, image).item() == pytest.approx(value, abs=1e-6)
    for axis in (0, 1):
        flipped, flipped_slopes = value_and_slopes(image.flip(axis), target.flip(axis))
        assert flipped == pytest.approx(value, abs=1e-6)
        assert relative(flipped_slopes.flip(axis), slopes.double()) < SLOPE_TOLERANCE


def test_bits_do_not_change() -> None:
    image, target = pictures(37, 161)
    value, slopes = value_and_slopes(image, target)
    for other in (SsimTarget(target), target.permute(1, 0, 2).contiguous().permute(1, 0, 2)):
        again, slopes_again = value_and_slopes(image, other)
        assert again == value
        np.testing.assert_array_equal(slopes_again, slopes)
    with torch.no_grad():
        assert ssim(image.clone().requires_grad_(), target).item() == value


def test_upstream_slopes_scale_and_may_come_twice() -> None:
    image, target = pictures(9, 13)
    _, slopes = value_and_slopes(image, target)
    image.requires_grad_()
    loss = 1 - 0.25 * ssim(image, target)
    loss.backward(retain_graph=True)
    loss.backward()
    torch.testing.assert_close(image.grad, -0.5 * slopes)


def test_what_does_not_count_is_the_target() -> None:
    image, target = pictures(30, 40)
    counted = torch.ones(30, 40, dtype=torch.bool)
    counted[20:, 5:30] = False
    held = torch.where(counted[..., None], image, target).double().requires_grad_()
    expected = reference(held, target.double()) + 3 * (held - target).abs().mean()
    expected.backward()
    assert held.grad is not None
    before = image.clone()
    image.requires_grad_()
    value = compared(image, target, weight_l1=3, weight_ssim=1, counted=counted)
    value.backward()
    assert value.item() == pytest.approx(expected.item(), abs=VALUE_TOLERANCE)
    assert image.grad is not None
    assert relative(image.grad, held.grad * counted[..., None]) < SLOPE_TOLERANCE
    assert (image.grad[~counted] == 0).all()
    assert torch.equal(image.detach(), before)
    # Planted fault: leaving the mask out is another value.
    assert abs(compared(image, target, weight_l1=3, weight_ssim=1).item() - value.item()) > 1e-3


def test_other_devices_compute_the_same() -> None:
    """What runs where no kernel does, on the CPU's tensors."""
    image, target = pictures(37, 161)
    counted = torch.rand(37, 161, generator=torch.Generator().manual_seed(0)) > 0.2
    told = SsimTarget(target)
    ours, theirs = image.clone().requires_grad_(), image.clone().requires_grad_()
    value = compared(ours, told, weight_l1=0.8, weight_ssim=-0.2, counted=counted)
    other = ssim_module._compared_by_convolution(theirs, told, 0.8, -0.2, counted)
    value.backward()
    other.backward()
    torch.testing.assert_close(value, other, atol=1e-6, rtol=0)
    assert ours.grad is not None and theirs.grad is not None
    assert relative(ours.grad, theirs.grad.double()) < SLOPE_TOLERANCE
    torch.testing.assert_close(told.mean, ssim_module._convolved(target), atol=1e-6, rtol=0)


def test_a_target_is_a_copy_that_does_not_change() -> None:
    image, target = pictures(9, 13)
    told = SsimTarget(target)
    value = ssim(image, told).item()
    target.zero_()
    assert ssim(image, told).item() == value
    with pytest.raises(AttributeError, match="does not change"):
        told.mean = target


@pytest.mark.parametrize(
    ("image", "target", "counted", "message"),
    [
        (torch.rand(4, 5), torch.rand(4, 5, 3), None, "image must have shape"),
        (torch.rand(0, 5, 3), torch.rand(0, 5, 3), None, "image must have shape"),
        (torch.rand(4, 5, 3).double(), torch.rand(4, 5, 3), None, "image must be float32"),
        (torch.rand(4, 5, 3), torch.rand(4, 5, 4), None, "target must have shape"),
        (torch.rand(4, 5, 3), torch.rand(5, 4, 3), None, "one size"),
        (torch.rand(4, 5, 3), torch.rand(4, 5, 3), torch.ones(4, 5), "counted must be bool"),
        (torch.rand(4, 5, 3), torch.rand(4, 5, 3), torch.ones(4, 4) > 0, "counted must be bool"),
    ],
)
def test_unfit_pictures_are_refused(
    image: Tensor, target: Tensor, counted: Tensor | None, message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        compared(image, target, weight_l1=0, weight_ssim=1, counted=counted)
