"""The rasteriser on a CPU: compiled kernels behind torch's autograd."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.errors import ArgumentError
from weather_aug.gaussians import blend as kernels
from weather_aug.gaussians import projection
from weather_aug.gaussians.tiles import tiles_of
from weather_aug.gaussians.types import Pinhole

Tensors = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]

_SHARES_PER_THREAD = 8
"""Tiles differ in their work; small shares even it out."""


class Blended(NamedTuple):
    """What a backend hands to `rasterise`."""

    colours: Tensor
    """(H, W, C), Σ w · colour."""
    opacity: Tensor
    """(H, W), Σ w."""
    left: Tensor
    """(H, W), the share of light that passes all splats."""
    depth_sum_m: Tensor
    """(H, W), Σ w · z."""
    centres_px: Tensor
    """(N, 2)."""
    radii_px: Tensor
    """(N,)."""


def drawn(
    tensors: Tensors, pinhole: Pinhole, *, antialiased: bool, near_m: float, threads: int
) -> Blended:
    """What `rasterise` asks a backend for.

    Args:
        tensors: Means, quaternions, scales, opacities, colours, view.
        pinhole: Lens and size.
        antialiased: See `rasterise`.
        near_m: See `rasterise`.
        threads: See `rasterise`.

    """
    if tensors[0].device.type != "cpu":
        raise ArgumentError("backend='cpu' draws tensors of the CPU; move them there")
    means, quaternions, scales, opacities, colours, view = tensors
    shapes, depths, radii = _Projection.apply(
        means, quaternions, scales, opacities, view, pinhole, antialiased, near_m
    )
    # Centres are a tensor of their own, for whoever wants their gradient.
    centres = shapes[:, :2]
    if centres.requires_grad:
        centres.retain_grad()
    shapes = torch.cat([centres, shapes[:, 2:]], dim=1)
    # Opacity is summed up like a colour: one less the light that is left forgets faint splats.
    planes = torch.cat([colours, depths[:, None], torch.ones_like(depths[:, None])], dim=1)
    blended, left = _Blend.apply(shapes, planes, depths, radii, pinhole, threads)
    return Blended(blended[..., :-2], blended[..., -1], left, blended[..., -2], centres, radii)


def lens_of(pinhole: Pinhole) -> NDArray[np.float64]:
    """The numbers that `projection.project` reads.

    Sources:
        gsplat: x/z is followed to 0.3 tan(fov/2) beyond the picture's own edges.
    """
    fx, fy, cx, cy, width, height = pinhole
    margin_x = projection.CLAMP_MARGIN * 0.5 * width / fx
    margin_y = projection.CLAMP_MARGIN * 0.5 * height / fy
    # Edges of the picture lie half a pixel beyond the outermost centres.
    limits = (
        (cx + 0.5) / fx + margin_x,
        (width - 0.5 - cx) / fx + margin_x,
        (cy + 0.5) / fy + margin_y,
        (height - 0.5 - cy) / fy + margin_y,
    )
    return np.array([fx, fy, cx, cy, *limits, width, height], np.float64)


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        view: Tensor,
        pinhole: Pinhole,
        antialiased: bool,
        near_m: float,
    ) -> Any:
        inputs = [t.detach().contiguous() for t in (means, quaternions, scales, opacities)]
        count = len(means)
        parts = torch.empty((count, projection.PARTS), dtype=torch.float32)
        depths = torch.empty(count, dtype=torch.float32)
        radii = torch.empty(count, dtype=torch.float32)
        place, lens = view.detach().double().numpy(), lens_of(pinhole)
        projection.project(
            *(t.numpy() for t in inputs),
            place,
            lens,
            float(near_m),
            antialiased,
            parts.numpy(),
            depths.numpy(),
            radii.numpy(),
        )
        ctx.save_for_backward(*inputs, view.detach(), radii)
        ctx.constants = (place, lens, antialiased)
        ctx.mark_non_differentiable(radii)
        return parts, depths, radii

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        means, quaternions, scales, opacities, view, radii = ctx.saved_tensors
        place, lens, antialiased = ctx.constants
        rows = torch.empty((len(means), 11), dtype=torch.float32)
        d_view = projection.project_back(
            means.numpy(),
            quaternions.numpy(),
            scales.numpy(),
            opacities.numpy(),
            place,
            lens,
            antialiased,
            radii.numpy(),
            grads[0].contiguous().numpy(),
            grads[1].contiguous().numpy(),
            rows.numpy(),
        )
        whole = torch.zeros((4, 4), dtype=view.dtype)
        whole[:3] = torch.from_numpy(d_view)
        parts = (rows[:, :3], rows[:, 3:7], rows[:, 7:10], rows[:, 10])
        return (*(part.contiguous() for part in parts), whole, None, None, None)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        shapes: Tensor,
        planes: Tensor,
        depths: Tensor,
        radii: Tensor,
        pinhole: Pinhole,
        threads: int,
    ) -> Any:
        height, width = pinhole.height, pinhole.width
        tiles = tiles_of(
            shapes.detach().numpy(), depths.detach().numpy(), radii.numpy(), width, height
        )
        channels = planes.shape[1]
        parts = np.empty((len(tiles.order), projection.PARTS), np.float32)
        values = np.empty((len(tiles.order), channels), np.float32)
        kernels.gather(tiles.order, shapes.detach().numpy(), planes.detach().numpy(), parts, values)
        left = np.empty((height, width), np.float32)
        blended = np.empty((height, width, channels), np.float32)
        ends = np.empty(len(tiles.starts) - 1, np.int64)

        def share(first: int, last: int) -> None:
            kernels.blend(
                parts,
                values,
                tiles.starts,
                tiles.ranks,
                (first, last),
                left,
                blended,
                ends,
            )

        _shared(share, len(ends), threads)
        ctx.lists = (tiles, parts, values, ends)
        ctx.count, ctx.threads = len(shapes), threads
        pictures = (torch.from_numpy(blended), torch.from_numpy(left))
        ctx.save_for_backward(*pictures)
        return pictures

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        # Threads of the pool have a grad mode of their own; they see arrays only.
        blended, left = (picture.detach().numpy() for picture in ctx.saved_tensors)
        tiles, parts, values, ends = ctx.lists
        has_shape = bool(ctx.needs_input_grad[0])
        d_blended, d_left = (grad.contiguous().numpy() for grad in grads)
        width = projection.PARTS + values.shape[1]
        rows = np.zeros((len(parts), width), np.float32)
        by_entry = ctx.threads > 1
        target = np.zeros((len(tiles.ranks), width), np.float32) if by_entry else rows

        def share(first: int, last: int) -> None:
            kernels.blend_back(
                parts,
                values,
                tiles.starts,
                tiles.ranks,
                (first, last),
                ends,
                left,
                blended,
                d_left,
                d_blended,
                has_shape,
                by_entry,
                target,
            )

        _shared(share, len(ends), ctx.threads)
        if by_entry:
            kernels.add_entries(tiles.ranks, target, tiles.starts, ends, rows)
        d_shapes = torch.zeros((ctx.count, projection.PARTS), dtype=torch.float32)
        d_planes = torch.zeros((ctx.count, values.shape[1]), dtype=torch.float32)
        kernels.scatter(tiles.order, rows, d_shapes.numpy(), d_planes.numpy())
        return (d_shapes if has_shape else None), d_planes, None, None, None, None


def _shared(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """Do tiles 0 to `count` in this thread, or in shares by several."""
    if threads <= 1 or count <= 1:
        work(0, count)
        return
    ends = np.linspace(0, count, threads * _SHARES_PER_THREAD + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, a, b) for a, b in pairwise(ends)]:
            done.result()
