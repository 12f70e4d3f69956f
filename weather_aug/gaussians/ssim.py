"""Structural similarity of two pictures and its gradient, in one pass over the rows.

A picture is read as rows of 3 W numbers, so that the blur across is a stencil of stride 3. It is
worked through in strips of columns: what the blur down still needs of a strip is eleven rows in a
ring, which the processor's cache holds. A ring holds every row twice, eleven slots apart, so that
any eleven rows that follow each other lie at fixed distances.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from weather_aug._compiled import compiled, inlined
from weather_aug.errors import ArgumentError

WINDOW_PX = 11
SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2


def _taps() -> tuple[np.float32, ...]:
    """The first six weights of the window; it is symmetric."""
    weights = np.exp(-((np.arange(WINDOW_PX) - WINDOW_PX // 2) ** 2) / (2 * SIGMA_PX**2))
    return tuple(np.float32(w) for w in (weights / weights.sum())[: WINDOW_PX // 2 + 1])


_W0, _W1, _W2, _W3, _W4, _W5 = _taps()
_C1, _C2 = np.float32(C1), np.float32(C2)
_HALO = 3 * (WINDOW_PX // 2)
_STRIP = 480
"""Numbers of a row that are worked through at a time."""
_LINE = _STRIP + 4 * _HALO + 16
"""Room for a strip and twice the reach of the blur on both sides."""
_SLOT = 3 * _LINE


class SsimTarget:
    """A picture to compare with, and what its side of the SSIM needs, found once.

    It holds three times the numbers of the picture. Do not change its tensors.

    Args:
        image: (H, W, 3) float32 in 0..1, on the CPU; it is copied.

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
        mean, variance = torch.empty_like(image), torch.empty_like(image)
        _describe(_rows(image), _rows(mean), _rows(variance))
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "variance", variance)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a SsimTarget does not change; make another one to set {name}")


def ssim(image: Tensor, target: Tensor | SsimTarget) -> Tensor:
    """Mean structural similarity of two pictures, at most 1; differentiable in `image`.

    As 3DGS trains and measures with it: a Gaussian window of 11 pixels and sigma 1.5, zero outside
    the picture, variances as blurred squares less squared blurs, constants 0.01² and 0.03², the
    mean over pixels and channels. The gradient is found together with the value.

    Args:
        image: (H, W, 3) float32 in 0..1, on the CPU.
        target: The picture to compare with, of the same size; no gradient flows to it. Hand in a
            `SsimTarget` where it is compared with more than once.

    Returns:
        A scalar.

    Raises:
        ArgumentError: If a picture has another shape or type, or the sizes differ.

    Sources:
        Wang et al. 2004, "Image Quality Assessment", eq. 13; Kerbl et al. 2023 (3DGS), eq. 7.
    """
    image = _checked("image", image)
    target = target if isinstance(target, SsimTarget) else SsimTarget(target)
    if image.shape != target.image.shape:
        raise ArgumentError(
            f"image and target must have one size, got {tuple(image.shape)} and "
            f"{tuple(target.image.shape)}"
        )
    # Inside a Function gradients are always off, so whether one is wanted is asked here.
    value: Tensor = _Ssim.apply(image, target, image.requires_grad and torch.is_grad_enabled())
    return value


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: SsimTarget, wants_gradient: bool) -> Tensor:
        gradient = torch.empty(image.shape if wants_gradient else (1, 0, 3))
        total = _compare(
            _rows(image.detach().contiguous()),
            _rows(target.image),
            _rows(target.mean),
            _rows(target.variance),
            np.float32(1 / image.numel()),
            _rows(gradient),
        )
        ctx.save_for_backward(gradient)
        return torch.tensor(total / image.numel(), dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None


def _checked(name: str, image: Tensor) -> Tensor:
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ArgumentError(f"{name} must have shape (H, W, 3), got {tuple(image.shape)}")
    if image.dtype != torch.float32 or image.device.type != "cpu":
        raise ArgumentError(
            f"{name} must be float32 on the CPU, got {image.dtype} on {image.device}"
        )
    return image


def _rows(picture: Tensor) -> NDArray[np.float32]:
    rows: NDArray[np.float32] = picture.numpy().reshape(picture.shape[0], -1)
    return rows


@inlined
def _blurred(values, i, step):
    """The window's mean around `values[i + 5 * step]`."""
    near = _W5 * values[i + 5 * step] + _W4 * (values[i + 4 * step] + values[i + 6 * step])
    middle = _W3 * (values[i + 3 * step] + values[i + 7 * step]) + _W2 * (
        values[i + 2 * step] + values[i + 8 * step]
    )
    far = _W1 * (values[i + step] + values[i + 9 * step]) + _W0 * (
        values[i] + values[i + 10 * step]
    )
    return near + middle + far


@compiled
def _across(lines, count, ring, slot):
    """Blur three lines across into slot `slot` of a ring and its double."""
    for k in range(3):
        line = lines[k * _LINE : (k + 1) * _LINE]
        once = ring[slot * _SLOT + k * _LINE : slot * _SLOT + (k + 1) * _LINE]
        for i in range(np.uint64(count)):
            once[i] = _blurred(line, i, np.uint64(3))
        first = (slot + WINDOW_PX) * _SLOT + k * _LINE
        ring[first : first + count] = once[:count]


@compiled
def _down(ring, slot, count, lines):
    """Blur the eleven rows that end in slot `slot` down into three lines."""
    for k in range(3):
        first = (slot + 1) * _SLOT + k * _LINE
        rows = ring[first : first + (WINDOW_PX - 1) * _SLOT + _LINE]
        line = lines[k * _LINE : (k + 1) * _LINE]
        for i in range(np.uint64(count)):
            line[i] = _blurred(rows, i, np.uint64(_SLOT))


@compiled
def _load(image, target, y, first, lines):
    """Row `y` from column `first`: the image, its square, and its product with the target.

    What lies outside the picture is 0.
    """
    lines[:] = np.float32(0)
    height, width = image.shape
    if y >= height:
        return
    begin, end = max(first, 0), min(first + _LINE, width)
    x_row, y_row = image[y, begin:end], target[y, begin:end]
    to = begin - first
    plain = lines[to:_LINE]
    squares, products = lines[_LINE + to : 2 * _LINE], lines[2 * _LINE + to : 3 * _LINE]
    for i in range(np.uint64(end - begin)):
        x = x_row[i]
        plain[i] = x
        squares[i] = x * x
        products[i] = x * y_row[i]


@compiled
def _similarity(blurred, mean, variance, values, slopes):
    """SSIM of a line of pixels, and its slopes in the blurs of the image, its square, the product.

    The slope in the square is doubled, as the gradient needs it.
    """
    one, two = np.float32(1), np.float32(2)
    means, squares = blurred[:_LINE], blurred[_LINE : 2 * _LINE]
    products = blurred[2 * _LINE : 3 * _LINE]
    of_mean, of_square = slopes[:_LINE], slopes[_LINE : 2 * _LINE]
    of_product = slopes[2 * _LINE : 3 * _LINE]
    for i in range(np.uint64(mean.shape[0])):
        m, n = means[i], mean[i]
        luminance = two * m * n + _C1
        structure = two * (products[i] - m * n) + _C2
        below_l = m * m + n * n + _C1
        below_s = (squares[i] - m * m) + variance[i] + _C2
        inverse = one / (below_l * below_s)
        value = luminance * structure * inverse
        by_product = two * luminance * inverse
        by_square = -two * value * below_l * inverse
        by_mean = two * (n * structure - m * value * below_s) * inverse
        values[i] = value
        of_mean[i] = by_mean - m * by_square - n * by_product
        of_square[i] = by_square
        of_product[i] = by_product


@compiled
def _add(values, totals):
    """Add a line to sums of columns."""
    for i in range(np.uint64(values.shape[0])):
        totals[i] += np.float64(values[i])


@compiled
def _slope_row(blurred, x_row, y_row, scale, out):
    """Gradient of a row from the blurred slopes."""
    of_mean, of_square = blurred[:_LINE], blurred[_LINE : 2 * _LINE]
    of_product = blurred[2 * _LINE : 3 * _LINE]
    for i in range(np.uint64(out.shape[0])):
        slope = of_mean[i] + x_row[i] * of_square[i] + y_row[i] * of_product[i]
        out[i] = scale * slope


@compiled
def _describe(image, mean, variance):
    """Blur, and variance under the window, of rows (H, 3 W)."""
    height, width = image.shape
    half = WINDOW_PX // 2
    lines, blurred = np.empty(_SLOT, np.float32), np.empty(_SLOT, np.float32)
    ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    for first in range(0, width, _STRIP):
        count = min(_STRIP, width - first)
        ring[:] = np.float32(0)
        for y in range(height + half):
            _load(image, image, y, first - _HALO, lines)
            _across(lines, count, ring, y % WINDOW_PX)
            if y < half:
                continue
            _down(ring, y % WINDOW_PX, count, blurred)
            for i in range(count):
                m = blurred[i]
                mean[y - half, first + i] = m
                variance[y - half, first + i] = blurred[_LINE + i] - m * m


@compiled
def _compare(image, target, mean, variance, scale, gradient):
    """Sum of the SSIM over rows (H, 3 W), and `scale` times its gradient unless that is empty."""
    height, width = image.shape
    wants_gradient = gradient.shape[1] > 0
    half = WINDOW_PX // 2
    lines, blurred = np.empty(_SLOT, np.float32), np.empty(_SLOT, np.float32)
    slopes, values = np.empty(_SLOT, np.float32), np.empty(_LINE, np.float32)
    ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    slope_ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    total = 0.0
    for first in range(0, width, _STRIP):
        count = min(_STRIP, width - first)
        # The gradient of a strip needs the slopes as far to both sides as the window reaches.
        begin, end = max(first - _HALO, 0), min(first + count + _HALO, width)
        to = begin - (first - _HALO)
        wide = end - begin
        ring[:] = np.float32(0)
        slope_ring[:] = np.float32(0)
        slopes[:] = np.float32(0)
        totals = np.zeros(count)
        for y in range(height + 2 * half):
            at = y - half
            if y < height + half:
                _load(image, target, y, begin - _HALO, lines)
                _across(lines, wide, ring, y % WINDOW_PX)
            if at < 0:
                continue
            if at < height:
                _down(ring, y % WINDOW_PX, wide, blurred)
                _similarity(
                    blurred,
                    mean[at, begin:end],
                    variance[at, begin:end],
                    values,
                    slopes[to:],
                )
                _add(values[first - begin : first - begin + count], totals)
            else:
                slopes[:] = np.float32(0)
            if not wants_gradient:
                continue
            _across(slopes, count, slope_ring, at % WINDOW_PX)
            at -= half
            if at < 0:
                continue
            _down(slope_ring, (at + half) % WINDOW_PX, count, blurred)
            _slope_row(
                blurred,
                image[at, first : first + count],
                target[at, first : first + count],
                scale,
                gradient[at, first : first + count],
            )
        total += totals.sum()
    return total
