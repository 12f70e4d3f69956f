"""What a fit of Gaussians to pictures minimises, term by term, and the PSNR that it reports.

Each term is a scalar that carries gradients. On a CPU the terms over pictures find value and
gradient in one compiled pass; on other devices torch does the same.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from weather_aug.errors import ArgumentError
from weather_aug.gaussians.loss_rows import cross_entropy, excess_length, relative_error
from weather_aug.gaussians.ssim import SsimTarget, compared

DSSIM_WEIGHT = 0.2
"""Of 1 - SSIM in the photometric term; 3DGS."""
SKY_WEIGHT = 0.05
"""Of `sky_opacity`; OmniRe."""
DEPTH_WEIGHT = 0.1
"""Of `depth_loss`: it pulls at 10 m as OmniRe's L1 in metres does with its weight of 0.01."""
ELONGATION_WEIGHT = 1.0
"""Of `elongation`: it pulls at the ratio 10 as OmniRe's does with weight 1 in every tenth step."""
OPACITY_WEIGHT = 0.01
"""Of `mean_opacity`; gsplat's MCMC."""
SCALE_WEIGHT = 0.01
"""Of `mean_scale`; gsplat's MCMC."""

LEAST_PROBABILITY = 1e-3
"""Below it the cross-entropy goes on straight, so that no pixel pulls more than 1000-fold."""
DEPTH_RANGE_M = (0.01, 80.0)
DEPTH_ERROR_CAP = 0.3


def photometric(
    image: Tensor,
    target: Tensor | SsimTarget,
    weight_dssim: float = DSSIM_WEIGHT,
    *,
    counted: Tensor | None = None,
) -> Tensor:
    """(1 - w) · mean |image - target| + w · (1 - SSIM); differentiable in `image`.

    Args:
        image: (H, W, 3) float32 in 0..1.
        target: The recorded picture, of the same size; an `SsimTarget` saves its blurs.
        weight_dssim: w, in 0..1.
        counted: (H, W) bool, False where the picture shows the ego car or a lens's rim: there the
            image is taken to be the target, so that SSIM sees no edge. The means are over all
            pixels, so a counted pixel weighs the same in every picture. All count if None.

    Returns:
        A scalar, at least 0.

    Raises:
        ArgumentError: If a tensor has another shape or type, or the weight is outside 0..1.

    Source:
        Kerbl et al. 2023 (3DGS), eq. 7; masking as in OmniRe's drivestudio, which sets both
        pictures to 0 instead.
    """
    if not 0 <= weight_dssim <= 1:
        raise ArgumentError(f"weight_dssim must be in 0..1, got {weight_dssim!r}")
    return weight_dssim + compared(
        image, target, weight_l1=1 - weight_dssim, weight_ssim=-weight_dssim, counted=counted
    )


def sky_opacity(opacity: Tensor, is_sky: Tensor, is_known: Tensor) -> Tensor:
    """Binary cross-entropy of the opacity against "not sky", mean over the known pixels.

    Below a probability of 1e-3 the logarithm goes on as its tangent: the value stays finite, and a
    pixel that is wholly wrong is still pulled back.

    Args:
        opacity: (H, W) float32 in 0..1; differentiable.
        is_sky: (H, W) bool.
        is_known: (H, W) bool: whether `is_sky` means anything.

    Returns:
        A scalar, at least 0; 0 if nothing is known.

    Raises:
        ArgumentError: If a tensor has another shape or type.

    Source:
        OmniRe (Chen et al. 2024), with weight 0.05.
    """
    _check("opacity", opacity, opacity.shape, torch.float32)
    _check("is_sky", is_sky, opacity.shape, torch.bool)
    _check("is_known", is_known, opacity.shape, torch.bool)
    count = int(is_known.sum())
    if opacity.device.type != "cpu":
        return _cross_entropy_sum(opacity, is_sky, is_known) / max(count, 1)
    slopes = torch.empty_like(opacity, memory_format=torch.contiguous_format)
    total = cross_entropy(
        _flat(opacity),
        _flat(is_sky),
        _flat(is_known),
        np.float32(LEAST_PROBABILITY),
        _flat(slopes),
    )
    return _found(opacity, total, slopes, count)


def depth_loss(
    expected_depth_m: Tensor,
    opacity: Tensor,
    measured_m: Tensor,
    *,
    cap: float = DEPTH_ERROR_CAP,
) -> Tensor:
    """Relative error |z - m| / m of the expected depth, capped; mean over the measured pixels.

    Relative, not in metres as OmniRe's: a stereo measurement of disparity to a fixed part of a
    pixel is off by a share of m that grows with m, in metres with m², so that L1 in metres would
    mostly fit the noise of what is far; and what a wrong depth displaces in a view from beside
    goes as (z - m) / (z m). Capped, because stereo and completed depth hold outright errors, at
    the edges of things above all: beyond the cap a pixel has no pull.

    Args:
        expected_depth_m: (H, W) float32 z-depth, Σ w z / Σ w; the only input with a gradient.
        opacity: (H, W) float32 in 0..1. It weighs a pixel's error, because an expected depth
            means little where hardly anything is; no gradient flows to it, so that a pixel cannot
            escape by becoming transparent.
        measured_m: (H, W) float32; what is not in 0.01..80 m, or not finite, is not measured.
        cap: Largest relative error, above 0; `inf` for none.

    Returns:
        A scalar, at least 0; 0 if nothing is measured.

    Raises:
        ArgumentError: If a tensor has another shape or type, or the cap is not above 0.

    Source:
        The range and the expected depth: OmniRe (Chen et al. 2024).
    """
    if not cap > 0:
        raise ArgumentError(f"cap must be above 0, got {cap!r}")
    _check("expected_depth_m", expected_depth_m, expected_depth_m.shape, torch.float32)
    _check("opacity", opacity, expected_depth_m.shape, torch.float32)
    _check("measured_m", measured_m, expected_depth_m.shape, torch.float32)
    if expected_depth_m.device.type != "cpu":
        total, count = _relative_error_sum(expected_depth_m, opacity, measured_m, cap)
        return total / count.clamp(min=1)
    slopes = torch.empty_like(expected_depth_m, memory_format=torch.contiguous_format)
    total, count = relative_error(
        _flat(expected_depth_m),
        _flat(opacity),
        _flat(measured_m),
        *(np.float32(end) for end in DEPTH_RANGE_M),
        np.float32(cap),
        _flat(slopes),
    )
    return _found(expected_depth_m, total, slopes, count)


def elongation(log_scales: Tensor, at_most: float = 10.0) -> Tensor:
    """How far Gaussians are longer than `at_most` times their least width: mean of the excess.

    The excess is max(0, log(longest / shortest / at_most)). OmniRe's is max(longest / shortest,
    at_most) - at_most, whose slope grows with the ratio itself and overflows for a needle; the
    logarithm pulls every needle equally.

    Args:
        log_scales: (N, 3) float32; differentiable.
        at_most: Ratio up to which nothing is pulled, at least 1.

    Returns:
        A scalar, at least 0; 0 without Gaussians.

    Raises:
        ArgumentError: If the tensor has another shape or type, or the ratio is below 1.

    Source:
        Xie et al. 2023 (PhysGaussian), the anisotropy regulariser; OmniRe's of sharp shapes.
    """
    if not at_most >= 1:
        raise ArgumentError(f"at_most must be at least 1, got {at_most!r}")
    _check("log_scales", log_scales, (len(log_scales), 3), torch.float32)
    if log_scales.device.type != "cpu":
        return _excess_sum(log_scales, at_most) / max(len(log_scales), 1)
    slopes = torch.empty_like(log_scales, memory_format=torch.contiguous_format)
    total = excess_length(
        log_scales.detach().contiguous().numpy(), np.float32(math.log(at_most)), slopes.numpy()
    )
    return _found(log_scales, total, slopes, len(log_scales))


def mean_opacity(logit_opacities: Tensor) -> Tensor:
    """Mean opacity of Gaussians, so that those that nothing needs fade and can be moved.

    Args:
        logit_opacities: (N,) with N ≥ 1; differentiable.

    Source:
        Kheradmand et al. 2024 (3DGS-MCMC), the loss; weight 0.01 in gsplat.
    """
    return logit_opacities.sigmoid().mean()


def mean_scale(log_scales: Tensor, unit_m: float | Tensor = 1.0) -> Tensor:
    """Mean standard deviation of Gaussians over all axes, in `unit_m`, so that they stay small.

    Args:
        log_scales: (N, 3) with N ≥ 1, logarithms of metres; differentiable.
        unit_m: What counts as length 1: a number for scenes that are not normalised to about 1 as
            gsplat's are (the radius of the scene), or (N,), such as each Gaussian's distance from
            the nearest camera, so that far ones may be as large on a picture as near ones.

    Source:
        Kheradmand et al. 2024 (3DGS-MCMC), the loss; weight 0.01 in gsplat.
    """
    if isinstance(unit_m, Tensor):
        return (log_scales - unit_m.log()[:, None]).exp().mean()
    return log_scales.exp().mean() / unit_m


def psnr(image: Tensor, target: Tensor | SsimTarget, counted: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of pictures (H, W, 3) in 0..1; `inf` if they are equal.

    Args:
        image: What was drawn.
        target: What was recorded.
        counted: (H, W) bool: the pixels that the mean is over; all if None.

    Raises:
        ArgumentError: If the pictures differ in size or no pixel counts.
    """
    picture = target.image if isinstance(target, SsimTarget) else target
    if image.shape != picture.shape:
        raise ArgumentError(
            f"image and target must have one size, got {tuple(image.shape)} and "
            f"{tuple(picture.shape)}"
        )
    error = (image.detach() - picture.detach()).double().square()
    if counted is not None:
        _check("counted", counted, image.shape[:2], torch.bool)
        error = error[counted]
    if not error.numel():
        raise ArgumentError("counted must be True for at least one pixel of the picture")
    mean = float(error.mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


class _Found(torch.autograd.Function):
    """A value whose gradient was found with it."""

    @staticmethod
    def forward(ctx: Any, _: Tensor, value: float, slopes: Tensor, scale: float) -> Tensor:
        ctx.save_for_backward(slopes)
        ctx.scale = scale
        return torch.tensor(value * scale, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:
        (slopes,) = ctx.saved_tensors
        return slopes * (upstream * ctx.scale), None, None, None


def _found(argument: Tensor, total: float, slopes: Tensor, count: int) -> Tensor:
    """`total` / `count` as a function of `argument`, in which `total` has these slopes."""
    scale = 1 / max(count, 1)
    value: Tensor = _Found.apply(argument, total, slopes, scale)
    return value


def _cross_entropy_sum(opacity: Tensor, is_sky: Tensor, is_known: Tensor) -> Tensor:
    p = torch.where(is_sky, 1 - opacity, opacity)[is_known]
    held = p.detach().clamp(min=LEAST_PROBABILITY)
    # Where p is held this is the tangent, elsewhere the logarithm's own value and slope.
    return ((held - p) / held - held.log()).sum()


def _relative_error_sum(
    depth_m: Tensor, opacity: Tensor, measured_m: Tensor, cap: float
) -> tuple[Tensor, Tensor]:
    least_m, most_m = DEPTH_RANGE_M
    is_measured = (measured_m >= least_m) & (measured_m <= most_m)
    measured_m = measured_m[is_measured]
    error = (depth_m[is_measured] - measured_m).abs() / measured_m
    return (opacity.detach()[is_measured] * error.clamp(max=cap)).sum(), is_measured.sum()


def _excess_sum(log_scales: Tensor, at_most: float) -> Tensor:
    return (log_scales.amax(1) - log_scales.amin(1) - math.log(at_most)).relu().sum()


def _check(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    if value.shape != shape or value.dtype != dtype:
        raise ArgumentError(
            f"{name} must be {dtype} of shape {tuple(shape)}, got {value.dtype} "
            f"{tuple(value.shape)}"
        )


def _flat(plane: Tensor) -> Any:
    return plane.detach().contiguous().numpy().reshape(-1)
