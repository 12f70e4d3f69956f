"""The rasteriser with CUDA: gsplat's, asked for the same picture."""

from __future__ import annotations

import torch

from weather_aug._extras import require
from weather_aug.errors import ArgumentError, MissingExtraError, printable
from weather_aug.gaussians.rasterise_cpu import Blended, Tensors
from weather_aug.gaussians.types import Pinhole


def drawn(
    tensors: Tensors, pinhole: Pinhole, *, antialiased: bool, near_m: float, threads: int
) -> Blended:
    """What `rasterise` asks a backend for; see `rasterise_cpu.drawn`. `threads` does nothing.

    Raises:
        MissingExtraError: If gsplat or its CUDA code is missing.
        ArgumentError: If the tensors are not CUDA's.

    Sources:
        gsplat: `rasterization`. Its pixel centres are at one half, ours at integers.
    """
    if not tensors[0].is_cuda:
        raise ArgumentError("backend='gsplat' draws CUDA tensors; move them there, or use 'cpu'")
    gsplat = require("gsplat", extra="gsplat", to="draw Gaussians with CUDA")
    means, quaternions, scales, opacities, colours, view = tensors
    fx, fy, cx, cy, width, height = pinhole
    lens = torch.tensor(
        [[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]], device=means.device
    )
    try:
        blended, opacity, meta = gsplat.rasterization(
            means,
            quaternions,
            scales,
            opacities,
            colours,
            view[None],
            lens[None],
            width,
            height,
            near_plane=near_m,
            packed=False,
            render_mode="RGB+D",
            rasterize_mode="antialiased" if antialiased else "classic",
        )
    except ImportError as error:
        raise MissingExtraError(
            f"gsplat is installed but its CUDA code cannot be loaded ({printable(error)}); it is "
            "compiled on first use and needs the CUDA toolkit"
        ) from error
    means2d = meta["means2d"]
    centres = (means2d[0] - 0.5).detach()
    if means2d.requires_grad:
        # gsplat draws from its own tensor; whoever reads the gradient of ours finds that one's.
        means2d.register_hook(lambda gradient: setattr(centres, "grad", gradient[0]))
    radii = meta["radii"][0].float()
    radii = radii.amax(dim=-1) if radii.ndim == 2 else radii
    opacity = opacity[0, ..., 0]
    return Blended(
        blended[0, ..., :-1], opacity, 1.0 - opacity, blended[0, ..., -1], centres, radii
    )
