"""Terms of the fit: their values and slopes against float64, and where they must not pull."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from weather_aug.errors import ArgumentError
from weather_aug.gaussians import loss as loss_module
from weather_aug.gaussians import loss_rows
from weather_aug.gaussians.loss import (
    depth_loss,
    elongation,
    mean_opacity,
    mean_scale,
    photometric,
    psnr,
    sky_opacity,
)
from weather_aug.gaussians.ssim import SsimTarget, ssim

# A multiple of nothing; more than the 65,536 of which one product is taken.
SIZE = (211, 313)
INF, NAN = math.inf, math.nan


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def slopes_of(value: Tensor, argument: Tensor) -> Tensor:
    (slopes,) = torch.autograd.grad(value, argument, retain_graph=True)
    return slopes


def close(actual: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    """Equal to float32's rounding over a sum."""
    scale = float(expected.detach().abs().max())
    torch.testing.assert_close(
        actual.detach().double(), expected.detach().double(), rtol=0, atol=tolerance * scale
    )


def pictures() -> tuple[Tensor, Tensor]:
    image = torch.rand(31, 47, 3, generator=generator(1))
    target = (image + 0.1 * torch.randn(31, 47, 3, generator=generator(2))).clamp(0, 1)
    return image.requires_grad_(), target


def test_photometric_is_l1_and_dssim() -> None:
    image, target = pictures()
    distance = (image - target).abs().mean()
    expected = 0.8 * distance + 0.2 * (1 - ssim(image, target))
    for against in (target, SsimTarget(target)):
        value = photometric(image, against)
        close(value, expected)
        close(slopes_of(value, image), slopes_of(0.8 * distance - 0.2 * ssim(image, target), image))
    close(photometric(image, SsimTarget(target), 0), distance)
    close(photometric(image, target, 1.0), 1 - ssim(image, target))
    # Planted fault: half of 1 - SSIM, as some define D-SSIM.
    assert abs(value - (0.8 * distance + 0.1 * (1 - ssim(image, target)))) > 1e-3


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_pixels_that_do_not_count_pull_nothing(weight: float) -> None:
    image, target = pictures()
    counted = torch.ones(31, 47, dtype=torch.bool)
    counted[25:] = False
    value = photometric(image, target, weight, counted=counted)
    other = torch.where(counted[..., None], image, torch.rand(31, 47, 3, generator=generator(3)))
    close(photometric(other, target, weight, counted=counted), value)
    assert (slopes_of(value, image)[~counted] == 0).all()
    # No edge: the rim of the mask is no dissimilarity of its own.
    assert (
        photometric(torch.where(counted[..., None], target, 0), target, weight, counted=counted)
        < 1e-6
    )
    # Planted fault: both set to 0 under the mask, and the image left there.
    assert photometric(torch.where(counted[..., None], target, 0), target, weight) > 1e-2


def sky_scene() -> tuple[Tensor, Tensor, Tensor]:
    opacity = torch.rand(SIZE, generator=generator(4)) * 0.98 + 0.01
    is_sky = torch.rand(SIZE, generator=generator(5)) < 0.3
    is_known = torch.rand(SIZE, generator=generator(6)) < 0.9
    return opacity.requires_grad_(), is_sky, is_known


def test_sky_opacity_is_the_cross_entropy() -> None:
    opacity, is_sky, is_known = sky_scene()
    exact = opacity.detach().double().requires_grad_()
    expected = torch.nn.functional.binary_cross_entropy(
        exact[is_known], (~is_sky[is_known]).double()
    )
    for value in (
        sky_opacity(opacity, is_sky, is_known),
        loss_module._cross_entropy_sum(opacity, is_sky, is_known) / is_known.sum(),
    ):
        close(value, expected)
        close(slopes_of(value, opacity), slopes_of(expected, exact))
    # Planted fault: sky and not sky exchanged.
    assert abs(sky_opacity(opacity, ~is_sky, is_known) - value) > 1e-3


def test_what_is_wholly_wrong_is_finite_and_pulled_back() -> None:
    opacity = torch.tensor([[0.0, 1.0, 1.0, 0.0]], requires_grad=True)
    is_sky = torch.tensor([[False, True, False, True]])
    value = sky_opacity(opacity, is_sky, torch.ones_like(is_sky))
    close(value, torch.tensor(2 * (1 - math.log(1e-3)) / 4))
    close(slopes_of(value, opacity), torch.tensor([[-250.0, 250.0, -0.25, 0.25]]))
    # No step where the tangent begins.
    near = torch.tensor([[0.999e-3, 1.001e-3]], requires_grad=True)
    ground, known = torch.zeros(1, 2, dtype=torch.bool), torch.ones(1, 2, dtype=torch.bool)
    slopes = slopes_of(sky_opacity(near, ground, known), near)
    assert float(slopes[0, 0] / slopes[0, 1]) == pytest.approx(1, abs=0.002)


def test_no_product_of_probabilities_underflows(monkeypatch: pytest.MonkeyPatch) -> None:
    n = loss_rows._LANES * 130
    arguments = (
        np.zeros(n, np.float32),
        np.zeros(n, np.bool_),
        np.ones(n, np.bool_),
        np.float32(1e-3),
        np.empty(n, np.float32),
    )
    assert loss_rows.cross_entropy(*arguments) / n == pytest.approx(1 - math.log(1e-3), rel=1e-6)
    # Planted fault: one product over all. Few lanes, because this runs uncompiled.
    monkeypatch.setattr(loss_rows, "_LANES", 2)
    monkeypatch.setattr(loss_rows, "_ROUNDS", 10**9)
    few = [a[:260] if isinstance(a, np.ndarray) else a for a in arguments]
    with np.errstate(all="ignore"):
        assert not math.isfinite(loss_rows.cross_entropy.py_func(*few))


def test_nothing_known_is_no_loss() -> None:
    opacity, is_sky, _ = sky_scene()
    value = sky_opacity(opacity, is_sky, torch.zeros_like(is_sky))
    assert value == 0 and (slopes_of(value, opacity) == 0).all()
    depth = torch.rand(SIZE).requires_grad_()
    value = depth_loss(depth, opacity.detach(), torch.full(SIZE, NAN))
    assert value == 0 and (slopes_of(value, depth) == 0).all()


def test_nan_is_not_passed_over() -> None:
    opacity, is_sky, is_known = sky_scene()
    known = torch.ones_like(is_known)
    broken = opacity.detach().clone()
    broken[5, 5] = NAN
    assert sky_opacity(broken, is_sky, known).isnan()
    assert not sky_opacity(broken, is_sky, known & ~broken.isnan()).isnan()
    depth = torch.ones(SIZE)
    depth[5, 5] = NAN
    assert depth_loss(depth, opacity.detach(), torch.ones(SIZE)).isnan()
    assert elongation(torch.tensor([[0.0, NAN, 0.0]])).isnan()


def depth_scene() -> tuple[Tensor, Tensor, Tensor]:
    measured = 70 * torch.rand(SIZE, generator=generator(7)) + 2
    depth = measured * (1 + 0.2 * torch.randn(SIZE, generator=generator(8)))
    hole = torch.rand(SIZE, generator=generator(9))
    for value, share in ((INF, 0.4), (NAN, 0.3), (0.0, 0.2), (81.0, 0.1)):
        measured[hole < share] = value
    opacity = torch.rand(SIZE, generator=generator(10))
    return depth.requires_grad_(), opacity.requires_grad_(), measured


def test_depth_loss_is_the_capped_relative_error() -> None:
    depth, opacity, measured = depth_scene()
    ok = torch.isfinite(measured) & (measured >= 0.01) & (measured <= 80)
    exact, m = depth.detach().double().requires_grad_(), measured.double()[ok]
    error = ((exact[ok] - m).abs() / m).clamp(max=0.3)
    expected = (opacity.detach().double()[ok] * error).mean()
    wanted = slopes_of(expected, exact)
    total, count = loss_module._relative_error_sum(depth, opacity, measured, 0.3)
    for value in (depth_loss(depth, opacity, measured), total / count):
        close(value, expected)
        close(slopes_of(value, depth), wanted)
    assert (wanted[~ok] == 0).all() and 0.05 < (wanted[ok] == 0).float().mean() < 0.5
    # Planted faults: without the cap, without the opacity, in metres.
    faults = (
        depth_loss(depth, opacity, measured, cap=INF),
        depth_loss(depth, torch.ones(SIZE), measured),
        (opacity[ok] * (depth[ok] - measured[ok]).abs()).mean(),
    )
    assert all(abs(fault.item() / expected.item() - 1) > 0.05 for fault in faults)


def test_a_pixel_cannot_escape_its_depth_by_becoming_transparent() -> None:
    depth, opacity, measured = depth_scene()
    depth_loss(depth, opacity, measured).backward()
    assert depth.grad is not None and opacity.grad is None


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-8, 3, width=32)] * 3), min_size=1, max_size=9))
def test_elongation_is_the_excess_of_the_logarithm(
    scales: list[tuple[float, float, float]],
) -> None:
    log_scales = torch.tensor(scales, requires_grad=True)
    value = elongation(log_scales)
    exact = log_scales.detach().double()
    over = (exact.amax(1) - exact.amin(1) - math.log(10)).clamp(min=0)
    assert value.item() == pytest.approx(over.mean().item(), abs=1e-5)
    other = loss_module._excess_sum(log_scales, 10) / len(scales)
    assert other.item() == pytest.approx(value.item(), abs=1e-5)
    slopes = slopes_of(value, log_scales)
    # Shrinks the longest and widens the shortest by the same, or does nothing.
    torch.testing.assert_close(slopes.sum(1), torch.zeros(len(scales)))
    pulled = slopes.abs().sum(1) > 0
    clearly = (exact.amax(1) - exact.amin(1) - math.log(10)).abs() > 1e-5
    assert (pulled[clearly] == (over[clearly] > 0)).all()
    step = log_scales - 0.01 * len(scales) * slopes
    shorter = (step.amax(1) - step.amin(1)) - (log_scales.amax(1) - log_scales.amin(1))
    distinct = (exact.sort(1).values.diff(dim=1) > 0.05).all(1)
    assert (shorter[pulled & distinct] < -0.015).all()


def test_a_needle_pulls_no_more_than_what_is_just_too_long() -> None:
    log_scales = torch.tensor([[0.0, -3.0, -3.0], [60.0, -60.0, 0.0], [0.0, -1.0, -2.0]])
    log_scales.requires_grad_()
    slopes = slopes_of(elongation(log_scales), log_scales)
    assert torch.equal(slopes[1] * 3, torch.tensor([1.0, -1.0, 0.0]))
    assert torch.equal(slopes[0] * 3, torch.tensor([1.0, -1.0, 0.0]))
    assert (slopes[2] == 0).all()
    # Planted fault: the ratio itself, as OmniRe has it, is not finite here.
    ratios = log_scales.exp().amax(1) / log_scales.exp().amin(1)
    assert not torch.isfinite(slopes_of((ratios.clamp(min=10) - 10).mean(), log_scales)).all()
    assert elongation(torch.empty(0, 3)) == 0


def test_means_of_opacity_and_scale() -> None:
    logits = torch.tensor([0.0, math.log(3)], requires_grad=True)
    assert mean_opacity(logits).item() == pytest.approx(0.625)
    close(slopes_of(mean_opacity(logits), logits), torch.tensor([0.125, 0.09375]))
    log_scales = torch.log(torch.tensor([[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]])).requires_grad_()
    assert mean_scale(log_scales).item() == pytest.approx(11.0)
    assert mean_scale(log_scales, 4.0).item() == pytest.approx(2.75)
    by_distance = mean_scale(log_scales, torch.tensor([1.0, 10.0]))
    assert by_distance.item() == pytest.approx(2.0)
    close(slopes_of(by_distance, log_scales), torch.tensor([[1.0, 2, 3], [1, 2, 3]]) / 6)


def test_psnr() -> None:
    target = torch.rand(6, 7, 3, generator=generator(11)) * 0.5
    image = target + 0.1
    image[3:] = target[3:] + 0.01
    top = torch.zeros(6, 7, dtype=torch.bool)
    top[:3] = True
    assert psnr(image, target, top) == pytest.approx(20.0, abs=1e-4)
    assert psnr(image, SsimTarget(target), ~top) == pytest.approx(40.0, abs=1e-3)
    assert psnr(image, target) == pytest.approx(-10 * math.log10(0.00505), abs=1e-4)
    assert psnr(target, target) == INF


def test_unfit_arguments_are_refused() -> None:
    image, plane, mask = torch.rand(4, 5, 3), torch.rand(4, 5), torch.ones(4, 5, dtype=torch.bool)
    with pytest.raises(ArgumentError, match="weight_dssim"):
        photometric(image, image, 1.5)
    with pytest.raises(ArgumentError, match="is_sky must be"):
        sky_opacity(plane, plane, mask)
    with pytest.raises(ArgumentError, match="is_known must be"):
        sky_opacity(plane, mask, mask[:2])
    with pytest.raises(ArgumentError, match="opacity must be"):
        sky_opacity(plane.double(), mask, mask)
    with pytest.raises(ArgumentError, match="measured_m must be"):
        depth_loss(plane, plane, plane.double())
    with pytest.raises(ArgumentError, match="cap"):
        depth_loss(plane, plane, plane, cap=0)
    with pytest.raises(ArgumentError, match="log_scales must be"):
        elongation(torch.zeros(4, 2))
    with pytest.raises(ArgumentError, match="at_most"):
        elongation(torch.zeros(4, 3), 0.5)
    with pytest.raises(ArgumentError, match="one size"):
        psnr(image, image[:2])
    with pytest.raises(ArgumentError, match="at least one pixel"):
        psnr(image, image, ~mask)
    with pytest.raises(ArgumentError, match="one size"):
        photometric(image, image[:2], 0.0)
