"""Structural similarity of two pictures and its gradient.

On a CPU in one pass over the rows (`ssim_rows`), on other devices by torch's convolutions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from weather_aug.errors import ArgumentError
from weather_aug.gaussians.ssim_rows import C1, C2, WINDOW_PX, compare, describe, hold, weights


class SsimTarget:
    """A picture to compare with, and what its side of the SSIM needs, found once.

    It holds three times the numbers of the picture. Do not change its tensors.

    Args:
        image: (H, W, 3) float32 in 0..1; it is copied.

    Raises:
        ArgumentError: If the picture has another shape or type.
    """

    __slots__ = ("image", "mean", "variance")

    image: Tensor
    """(H, W, 3)."""
    mean: Tensor
    """(H, W, 3) blurred by the window."""
    variance: Tensor
    """(H, W, 3) under the window: blurred squares less the squared mean."""

    def __init__(self, image: Tensor) -> None:
        image = _checked("target", image).detach().clone(memory_format=torch.contiguous_format)
        if image.device.type == "cpu":
            mean, variance = torch.empty_like(image), torch.empty_like(image)
            describe(_rows(image), _rows(mean), _rows(variance))
        else:
            mean = _convolved(image)
            variance = _convolved(image * image) - mean * mean
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "variance", variance)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a SsimTarget does not change; make another one to set {name}")


def ssim(image: Tensor, target: Tensor | SsimTarget) -> Tensor:
    """Mean structural similarity of two pictures, at most 1; differentiable in `image`.

    As 3DGS trains and measures with it: a Gaussian window of 11 pixels and sigma 1.5, zero outside
    the picture, variances as blurred squares less squared blurs, constants 0.01² and 0.03², the
    mean over pixels and channels. On a CPU the gradient is found together with the value.

    Args:
        image: (H, W, 3) float32 in 0..1.
        target: The picture to compare with, of the same size; no gradient flows to it. Hand in a
            `SsimTarget` where it is compared with more than once.

    Returns:
        A scalar.

    Raises:
        ArgumentError: If a picture has another shape or type, or sizes or devices differ.

    Sources:
        Wang et al. 2004, "Image Quality Assessment", eq. 13; Kerbl et al. 2023 (3DGS), eq. 7.
    """
    return compared(image, target, weight_l1=0.0, weight_ssim=1.0)


def compared(
    image: Tensor,
    target: Tensor | SsimTarget,
    *,
    weight_l1: float,
    weight_ssim: float,
    counted: Tensor | None = None,
) -> Tensor:
    """`weight_l1` · mean |image - target| + `weight_ssim` · SSIM, in the pass that SSIM takes.

    Args:
        image: (H, W, 3) float32 in 0..1; differentiable.
        target: As for `ssim`.
        weight_l1: Of the mean absolute difference over all pixels and channels.
        weight_ssim: Of the mean SSIM.
        counted: (H, W) bool; where False, the image is taken to be the target. All if None.

    Returns:
        A scalar.

    Raises:
        ArgumentError: If a tensor has another shape or type, or sizes or devices differ.
    """
    image = _checked("image", image)
    target = target if isinstance(target, SsimTarget) else SsimTarget(target)
    if image.shape != target.image.shape or image.device != target.image.device:
        raise ArgumentError(
            "image and target must have one size and device, got "
            f"{tuple(image.shape)} on {image.device} and "
            f"{tuple(target.image.shape)} on {target.image.device}"
        )
    if counted is not None and (
        counted.shape != image.shape[:2]
        or counted.dtype != torch.bool
        or counted.device != image.device
    ):
        raise ArgumentError(
            f"counted must be bool of shape {tuple(image.shape[:2])} on {image.device}, got "
            f"{counted.dtype} {tuple(counted.shape)} on {counted.device}"
        )
    if image.device.type != "cpu":
        return _compared_by_convolution(image, target, weight_l1, weight_ssim, counted)
    # Inside a Function gradients are always off, so whether one is wanted is asked here.
    wants_gradient = image.requires_grad and torch.is_grad_enabled()
    arguments = image, target, weight_l1, weight_ssim, counted, wants_gradient
    value: Tensor = _Compared.apply(*arguments)
    return value


class _Compared(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: SsimTarget,
        weight_l1: float,
        weight_ssim: float,
        counted: Tensor | None,
        wants_gradient: bool,
    ) -> Tensor:
        rows, target_rows = _rows(image.detach()), _rows(target.image)
        gradient = torch.empty(image.shape if wants_gradient else (1, 0, 3))
        if counted is not None:
            rows = rows.copy()
            hold(counted.numpy(), target_rows, rows)
        ssim_sum, distance_sum = compare(
            rows,
            target_rows,
            _rows(target.mean),
            _rows(target.variance),
            np.float32(weight_ssim / image.numel()),
            np.float32(weight_l1 / image.numel()),
            _rows(gradient),
        )
        if counted is not None and wants_gradient:
            hold(counted.numpy(), np.zeros((1, 1), np.float32), _rows(gradient))
        ctx.save_for_backward(gradient)
        value = (weight_ssim * ssim_sum + weight_l1 * distance_sum) / image.numel()
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None, None, None, None


def _checked(name: str, image: Tensor) -> Tensor:
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ArgumentError(f"{name} must have shape (H, W, 3), got {tuple(image.shape)}")
    if image.dtype != torch.float32:
        raise ArgumentError(f"{name} must be float32 in 0..1, got {image.dtype}")
    return image


def _rows(picture: Tensor) -> NDArray[np.float32]:
    """(H, 3 W), a view where the picture is contiguous."""
    rows: NDArray[np.float32] = picture.contiguous().numpy().reshape(picture.shape[0], -1)
    return rows


def _convolved(picture: Tensor) -> Tensor:
    """(H, W, 3) blurred by the window."""
    window = torch.as_tensor(weights(), dtype=picture.dtype, device=picture.device)
    planes = picture.permute(2, 0, 1)[:, None]
    across = conv2d(planes, window[None, None, None], padding=(0, WINDOW_PX // 2))
    down = conv2d(across, window[None, None, :, None], padding=(WINDOW_PX // 2, 0))
    return down[:, 0].permute(1, 2, 0)


def _compared_by_convolution(
    image: Tensor,
    target: SsimTarget,
    weight_l1: float,
    weight_ssim: float,
    counted: Tensor | None,
) -> Tensor:
    if counted is not None:
        image = torch.where(counted[..., None], image, target.image)
    mean, other = _convolved(image), target.mean
    variance = _convolved(image * image) - mean * mean
    covariance = _convolved(image * target.image) - mean * other
    luminance = (2 * mean * other + C1) / (mean * mean + other * other + C1)
    structure = (2 * covariance + C2) / (variance + target.variance + C2)
    distance = (image - target.image).abs().mean()
    return weight_ssim * (luminance * structure).mean() + weight_l1 * distance
