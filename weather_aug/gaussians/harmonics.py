"""Colours of Gaussians that change with the direction they are seen from."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from weather_aug._extras import require
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import harmonics_kernels as kernels
from weather_aug.gaussians.types import SH_COEFFICIENTS


def colours_seen(
    sh: Tensor, means_m: Tensor, centre_m: Tensor, degree: int | None = None
) -> Tensor:
    """SRGB (N, 3), at least 0, of Gaussians seen from `centre_m`; all inputs carry gradients.

    Args:
        sh: (N, K, 3) float32 coefficients; those of CUDA are gsplat's work.
        means_m: (N, 3) float32.
        centre_m: (3,) of the camera, in the same axes.
        degree: Highest degree to use; all of `sh` if None.

    Raises:
        ArgumentError: If shapes or types disagree, or `sh` has no such degree.
        MissingExtraError: If CUDA tensors are given and gsplat is not installed.

    Sources:
        3DGS (Kerbl et al. 2023): real spherical harmonics, colour = max(0, 0.5 + Σ c·Y).
    """
    if sh.ndim != 3 or sh.shape[2] != 3 or sh.shape[1] not in SH_COEFFICIENTS:
        raise ArgumentError(f"sh must be (N, 1 | 4 | 9 | 16, 3), got {tuple(sh.shape)}")
    if tuple(means_m.shape) != (len(sh), 3) or tuple(centre_m.shape) != (3,):
        raise ArgumentError(
            f"means_m must be ({len(sh)}, 3) and centre_m (3,), got {tuple(means_m.shape)} and "
            f"{tuple(centre_m.shape)}"
        )
    highest = math.isqrt(sh.shape[1]) - 1
    degree = highest if degree is None else degree
    if not 0 <= degree <= highest:
        raise ArgumentError(f"degree must be in 0..{highest} for sh of this size, got {degree}")
    for name, value in (("sh", sh), ("means_m", means_m), ("centre_m", centre_m)):
        if value.dtype != torch.float32:
            raise ArgumentError(f"{name} must be float32, got {value.dtype}")
    if sh.is_cuda:
        gsplat = require("gsplat", extra="gsplat", to="draw Gaussians with CUDA")
        blended: Tensor = gsplat.spherical_harmonics(degree, means_m - centre_m, sh)
        return (blended + 0.5).clamp_min(0.0)
    colours: Tensor = _Colours.apply(sh, means_m, centre_m, SH_COEFFICIENTS[degree])
    return colours


class _Colours(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, centre: Tensor, count: int) -> Tensor:
        sh, means = sh.detach().contiguous(), means.detach().contiguous()
        out = torch.empty((len(sh), 3), dtype=torch.float32)
        place = centre.detach().double().numpy()
        kernels.colours(sh.numpy(), means.numpy(), place, count, out.numpy())
        ctx.save_for_backward(sh, means, centre.detach(), out)
        ctx.count = count
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        sh, means, centre, out = ctx.saved_tensors
        d_sh, d_means = torch.empty_like(sh), torch.empty_like(means)
        d_centre = kernels.colours_back(
            sh.numpy(),
            means.numpy(),
            centre.double().numpy(),
            ctx.count,
            out.numpy(),
            grads[0].contiguous().numpy(),
            d_sh.numpy(),
            d_means.numpy(),
        )
        return d_sh, d_means, torch.from_numpy(d_centre).to(centre.dtype), None
