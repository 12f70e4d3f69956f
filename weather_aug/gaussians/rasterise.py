"""Pictures of Gaussians, differentiable, on a CPU or with CUDA."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from weather_aug.errors import ArgumentError
from weather_aug.gaussians.types import Pinhole

NEAR_M = 0.1
BACKENDS = ("auto", "cpu", "gsplat")


class Drawn(NamedTuple):
    """A picture of Gaussians; all but `radii_px` carry gradients."""

    colours: Tensor
    """(H, W, C), over the background."""
    opacity: Tensor
    """(H, W) in 0..1."""
    depth_m: Tensor
    """(H, W) expected z-depth: Σ w z / Σ w; 0 where nothing is."""
    centres_px: Tensor
    """(N, 2) projected centres (x, y); its `grad` is what densification by gradient reads."""
    radii_px: Tensor
    """(N,) extent on the picture, 0 for what is not drawn; no gradient."""


def rasterise(
    means_m: Tensor,
    quaternions: Tensor,
    scales_m: Tensor,
    opacities: Tensor,
    colours: Tensor,
    camera_from_world: Tensor,
    pinhole: Pinhole,
    *,
    background: Tensor | None = None,
    antialiased: bool = True,
    near_m: float = NEAR_M,
    backend: str = "auto",
    threads: int = 1,
) -> Drawn:
    """Draw Gaussians front to back.

    Args:
        means_m: (N, 3) float32.
        quaternions: (N, 4) (w, x, y, z), of any length but zero.
        scales_m: (N, 3) standard deviations, positive (activated).
        opacities: (N,) in 0..1 (activated).
        colours: (N, C), any C ≥ 1: what is blended (RGB, class scores, …).
        camera_from_world: (4, 4); carries a gradient too.
        pinhole: Lens and size of the picture.
        background: (C,) or (H, W, C) behind everything; zero if None.
        antialiased: Compensate the opacity for the dilation by 0.3 px².
        near_m: What lies nearer along the optical axis is not drawn.
        backend: "cpu", "gsplat", or "auto": by the tensors' device.
        threads: Of the CPU's kernels. The picture and the gradients do not depend on it.

    Returns:
        The picture.

    Raises:
        ArgumentError: If shapes, types or devices disagree.
        MissingExtraError: If CUDA tensors are given and gsplat is not installed.

    Sources:
        3DGS (Kerbl et al. 2023); constants of gsplat 1.6: dilation 0.3 px², alpha from 1/255 to
        0.99, stop at 1e-4 of the light. (gsplat 1.5 caps alpha at 0.999 instead.)
    """
    _check_tensors(means_m, quaternions, scales_m, opacities, colours, camera_from_world)
    if background is not None:
        _check_background(background, colours, pinhole)
    if backend not in BACKENDS:
        raise ArgumentError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
    if not near_m > 0:
        raise ArgumentError(f"near_m must be positive metres, got {near_m!r}")
    if not threads >= 1:
        raise ArgumentError(f"threads must be at least 1, got {threads!r}")
    if not (pinhole.width >= 1 and pinhole.height >= 1):
        raise ArgumentError(f"pinhole has no pixels: {pinhole.width}x{pinhole.height}")
    if backend == "gsplat" or (backend == "auto" and means_m.is_cuda):
        from weather_aug.gaussians.rasterise_cuda import drawn
    else:
        from weather_aug.gaussians.rasterise_cpu import drawn
    blended = drawn(
        (means_m, quaternions, scales_m, opacities, colours, camera_from_world),
        pinhole,
        antialiased=antialiased,
        near_m=near_m,
        threads=threads,
    )
    seen = blended.colours
    if background is not None:
        seen = seen + blended.left[..., None] * background
    depth_m = blended.depth_sum_m / blended.opacity.clamp_min(_LEAST_OPACITY)
    return Drawn(seen, blended.opacity, depth_m, blended.centres_px, blended.radii_px)


_LEAST_OPACITY = 1e-8


def _check_tensors(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    view: Tensor,
) -> None:
    count = means.shape[0] if isinstance(means, Tensor) and means.ndim else 0
    _check("means_m", means, (count, 3), means)
    _check("quaternions", quaternions, (count, 4), means)
    _check("scales_m", scales, (count, 3), means)
    _check("opacities", opacities, (count,), means)
    channels = colours.shape[-1] if isinstance(colours, Tensor) and colours.ndim else 0
    _check("colours", colours, (count, max(channels, 1)), means)
    _check("camera_from_world", view, (4, 4), means)


def _check_background(background: Tensor, colours: Tensor, pinhole: Pinhole) -> None:
    channels = colours.shape[1]
    whole = (pinhole.height, pinhole.width, channels)
    is_flat = isinstance(background, Tensor) and background.ndim == 1
    _check("background", background, (channels,) if is_flat else whole, colours)


def _check(name: str, value: Tensor, shape: tuple[int, ...], like: Tensor) -> None:
    if not isinstance(value, Tensor):
        raise ArgumentError(f"{name} must be a tensor, got {type(value).__name__}")
    if tuple(value.shape) != shape:
        raise ArgumentError(f"{name} must have shape {shape}, got {tuple(value.shape)}")
    if value.dtype != torch.float32:
        raise ArgumentError(f"{name} must be float32, got {value.dtype}")
    if value.device != like.device:
        raise ArgumentError(f"{name} is on {value.device}, means_m on {like.device}")
