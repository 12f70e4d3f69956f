"""Pictures of Gaussians, differentiable, on a CPU or with CUDA."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from weather_aug.gaussians.types import Pinhole

NEAR_M = 0.1


class Drawn(NamedTuple):
    """A picture of Gaussians; every field carries gradients."""

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
        quaternions: (N, 4) (w, x, y, z), of any length.
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
    """
    raise NotImplementedError
