"""Draw Gaussians over a picture with gsplat's CUDA rasteriser.

gsplat knows no scene depth. Splats in front of every surface under their footprint (nearly all) go
to gsplat; those that a surface may cut, and the few large ones that labels ask about, are drawn by
`batch_splat`, fragment by fragment; those behind every surface are left out. What gsplat and
`batch_splat` draw in turns is ordered by slabs of depth: inside a slab, gsplat's splats lie on top.

What is exact: the transmittance, which does not depend on order, but for gsplat's stop at 1e-4.
What is not: the light of a pixel where, within one slab, a cut splat i is nearer than a whole one
j; it is off by alpha_i alpha_j (light_i - light_j).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from weather_aug._extras import require
from weather_aug.errors import MissingExtraError, printable
from weather_aug.render.batch_project import Splats
from weather_aug.render.batch_splat import Layer, empty_layer, splat
from weather_aug.render.tile import NEAR_EDGE_M

SLABS = 4
TILE_PX = 16

Rasteriser = Callable[[Splats, int, int], tuple[Tensor, Tensor]]
"""(splats, height, width) to light (3, H, W), weighted by opacity, and transmittance (H, W)."""


@torch.no_grad()
def splat_in_slabs(splats: Splats, depth_m: Tensor, rasterise: Rasteriser, slabs: int) -> Layer:
    """Draw splats, given far to near, with a rasteriser that knows no scene depth.

    Args:
        splats: Far to near.
        depth_m: (H, W) float32 depth of the surfaces, `inf` for the sky.
        rasterise: Draws splats in front of everything.
        slabs: Into how many parts of equal count the splats are cut by depth.

    Returns:
        As `batch_splat.splat`, with the approximation of the module's text.
    """
    height, width = depth_m.shape
    nearest_m, farthest_m = surfaces_under(splats, depth_m)
    reached = splats.z_m - NEAR_EDGE_M < farthest_m
    whole = (splats.z_m + NEAR_EDGE_M <= nearest_m) & ~splats.large
    layer = empty_layer(depth_m)
    for slab in torch.tensor_split(torch.nonzero(reached)[:, 0], slabs):
        cut = slab[~whole[slab]]
        if len(cut):
            layer = splat(splats.take(cut), depth_m, behind=layer)
        clear = slab[whole[slab]]
        if len(clear):
            light, through = rasterise(splats.take(clear), height, width)
            light = light + through * layer.light
            layer = Layer(light, through * layer.through, layer.covered)
    return layer


def splat_gsplat(splats: Splats, depth_m: Tensor) -> Layer:
    """`splat_in_slabs` with gsplat.

    Raises:
        MissingExtraError: If gsplat or its CUDA code is missing.
    """
    return splat_in_slabs(splats, depth_m, rasterise, SLABS)


@torch.no_grad()
def rasterise(splats: Splats, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Draw CUDA splats with gsplat; see `Rasteriser`.

    Raises:
        MissingExtraError: If gsplat or its CUDA code is missing.

    Source:
        gsplat 1.5: `isect_tiles`, `isect_offset_encode`, `rasterize_to_pixels`.
    """
    gsplat = require("gsplat", extra="gsplat", to="draw particles with splatting='gsplat'")
    means, radii, conics, colours, opacities, depths = gsplat_arguments(splats)
    tiles_x, tiles_y = -(-width // TILE_PX), -(-height // TILE_PX)
    try:
        _, crossings, flat = gsplat.isect_tiles(means, radii, depths, TILE_PX, tiles_x, tiles_y)
    except (ImportError, AttributeError) as error:
        # What gsplat raises where its CUDA code was neither shipped nor could be compiled.
        raise MissingExtraError(
            f"gsplat is installed but its CUDA code cannot be loaded ({printable(error)}); it is "
            "compiled on first use and needs a CUDA compiler: or pass splatting='torch'"
        ) from error
    offsets = gsplat.isect_offset_encode(crossings, 1, tiles_x, tiles_y)
    light, opacity = gsplat.rasterize_to_pixels(
        means, conics, colours, opacities, width, height, TILE_PX, offsets, flat
    )
    return light[0].permute(2, 0, 1), 1.0 - opacity[0, :, :, 0]


def gsplat_arguments(splats: Splats) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """means2d, radii, conics, colors, opacities and depths as gsplat's low-level functions want.

    Each has a leading axis of one image. The splats are dilated and compensated already, and their
    peaks hold 1/255 for the cut, so gsplat adds nothing. gsplat's pixel centres are at one half.
    """
    return (
        torch.stack([splats.u, splats.v], dim=1)[None] + 0.5,
        torch.ceil(splats.half + 0.5).int()[None],
        splats.conic[None].contiguous(),
        splats.light[None].contiguous(),
        splats.peak[None].contiguous(),
        splats.z_m[None].contiguous(),
    )


def surfaces_under(splats: Splats, depth_m: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds (N,) of the depths of the surfaces under each footprint, metres.

    Read off a pyramid of minima and maxima, where two cells a side hold the footprint's box: the
    bounds may be wider than the depths, never narrower.
    """
    height, width = depth_m.shape
    low = torch.stack([splats.u, splats.v], dim=1) - splats.half
    high = torch.stack([splats.u, splats.v], dim=1) + splats.half
    last = depth_m.new_tensor([width - 1, height - 1])
    low = torch.minimum(torch.ceil(low).clamp(min=0.0), last).long()
    high = torch.maximum(torch.minimum(torch.floor(high), last).long(), low)
    sides = (high - low + 1).amax(dim=1)
    nearest, farthest = torch.empty_like(splats.z_m), torch.empty_like(splats.z_m)
    bounds = torch.stack([-depth_m, depth_m])
    level = 0
    while True:
        # At this level a cell is as long as the box: it touches at most two a side.
        here = (sides <= 2**level) & (sides > 2**level // 2)
        x0, y0 = (low[here] >> level).unbind(1)
        x1, y1 = (high[here] >> level).unbind(1)
        corners = [bounds[:, y, x] for y in (y0, y1) for x in (x0, x1)]
        found = torch.stack(corners).amax(dim=0)
        nearest[here], farthest[here] = -found[0], found[1]
        if 2**level >= max(height, width):
            return nearest, farthest
        bounds = functional.max_pool2d(bounds, 2, ceil_mode=True)
        level += 1
