"""Draw Gaussians over a picture in torch, on any device, without a loop over Gaussians.

Splats are cut into rows and rows into fragments (one splat at one pixel). Fragments are sorted by
pixel, far to near inside each, and composited by a scan over the sorted list. Sums run over
fixed-point integers, whose addition does not depend on its order: the same arguments give the same
bits in every run on a device, on CUDA too, where sums of floats do not promise that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from weather_aug.render.batch_project import Splats
from weather_aug.render.project import HIDING_ALPHA
from weather_aug.render.tile import NEAR_EDGE_M

FRAGMENTS_AT_ONCE = {"cpu": 2**16, "cuda": 2**20}
"""Fragments in memory at once, about 200 bytes each; few on a CPU, for its cache."""
ONE = 2.0**36
"""Fixed point: resolves 1e-11, holds the sums of 2^26 fragments."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Particles alone: what they add to the light behind them, and what they leave of it."""

    light: Tensor
    """(3, H, W) linear light, already weighted by opacity."""
    through: Tensor
    """(H, W) share of the light behind that passes, in [0, 1]."""
    covered: Tensor
    """(H, W) bool, where a large particle hides the surface."""

    def over(self, light: Tensor) -> Tensor:
        """The layer in front of linear light (3, H, W)."""
        return self.light.to(light.dtype) + self.through.to(light.dtype) * light

    def rows(self, rows: slice) -> Layer:
        """A view of some rows of the picture."""
        return Layer(self.light[:, rows], self.through[rows], self.covered[rows])


def empty_layer(depth_m: Tensor) -> Layer:
    """A layer of no particles for a picture (H, W), on the depth's device."""
    height, width = depth_m.shape
    return Layer(
        torch.zeros((3, height, width), device=depth_m.device),
        torch.ones((height, width), device=depth_m.device),
        torch.zeros((height, width), dtype=torch.bool, device=depth_m.device),
    )


@torch.no_grad()
def splat(
    splats: Splats,
    depth_m: Tensor,
    *,
    behind: Layer | None = None,
    fragments_at_once: int | None = None,
) -> Layer:
    """Draw splats, given far to near, in front of surfaces at `depth_m`.

    Args:
        splats: Far to near.
        depth_m: (H, W) float32 depth of the surfaces, `inf` for the sky.
        behind: A layer to draw in front of.
        fragments_at_once: Bounds the memory; the picture does not depend on it but for rounding
            between the parts. At least one row of one splat is drawn at a time. Chosen for the
            device if None.

    Returns:
        A new layer, with exact order per pixel; bits are the same in every run on a device.
    """
    at_once = fragments_at_once or FRAGMENTS_AT_ONCE[depth_m.device.type]
    layer = empty_layer(depth_m) if behind is None else behind
    canvas = Layer(layer.light.clone(), layer.through.clone(), layer.covered.clone())
    height, width = depth_m.shape
    rows_of = _row_counts(splats, height)
    for start, stop in _chunks(rows_of, at_once):
        rows = _Rows.of(splats, start, rows_of[start:stop], width)
        for first, last in _chunks(rows.length, at_once):
            _composite(rows.cut(first, last), splats, depth_m, canvas)
    return canvas


@dataclass(frozen=True, eq=False)
class _Rows:
    """Stretches of picture rows that splats cover, (R,) each, far to near."""

    splat: Tensor
    pixel: Tensor
    """Flat index of the first pixel."""
    length: Tensor
    dx: Tensor
    """From the row's brightest point to its first pixel."""
    log_alpha: Tensor
    """Logarithm of the opacity at the brightest point."""

    @classmethod
    def of(cls, splats: Splats, start: int, counts: Tensor, width: int) -> _Rows:
        """Rows of the splats from `start` on, `counts` (K,) of each."""
        whole = torch.arange(start, start + len(counts), device=counts.device)
        i = torch.repeat_interleave(whole, counts)
        half_v = splats.half[i, 1]
        v, a, b = splats.v[i], splats.conic[i, 0], splats.conic[i, 1]
        y = torch.ceil(v - half_v).clamp(min=0.0).long() + _ranks(counts)
        dy = y - v
        middle = splats.u[i] - b / a * dy
        # Written with the share of the height that is left, a long streak's terms do not cancel.
        share = (dy / half_v).square()
        half = torch.sqrt(((1.0 - share) * splats.reach2[i] / a).clamp(min=0.0))
        x = torch.ceil(middle - half).clamp(min=0.0)
        end = torch.floor(middle + half).clamp(max=width - 1)
        return cls(
            splat=i,
            pixel=y * width + x.long(),
            length=(end - x + 1.0).clamp(min=0.0).long(),
            dx=x - middle,
            log_alpha=torch.log(splats.peak[i]) - 0.5 * splats.reach2[i] * share,
        )

    def cut(self, first: int, last: int) -> _Rows:
        part = slice(first, last)
        return _Rows(
            self.splat[part],
            self.pixel[part],
            self.length[part],
            self.dx[part],
            self.log_alpha[part],
        )


def _row_counts(splats: Splats, height: int) -> Tensor:
    top = torch.ceil(splats.v - splats.half[:, 1]).clamp(min=0.0)
    bottom = torch.floor(splats.v + splats.half[:, 1]).clamp(max=height - 1)
    return (bottom - top + 1.0).clamp(min=0.0).long()


def _ranks(counts: Tensor) -> Tensor:
    """0 .. n-1 for each n of `counts`, one after the other."""
    ends = torch.cumsum(counts, 0)
    starts = torch.repeat_interleave(ends - counts, counts)
    return torch.arange(len(starts), device=counts.device) - starts


def _chunks(counts: Tensor, limit: int) -> Iterator[tuple[int, int]]:
    """Ranges of consecutive items whose counts add to `limit` and at most one item more."""
    ends = torch.cumsum(counts, 0)
    total = int(ends[-1]) if len(ends) else 0
    marks = torch.arange(0, total, limit, device=counts.device)
    cuts = [*torch.searchsorted(ends - counts, marks).tolist(), len(counts)]
    for start, stop in pairwise(cuts):
        if stop > start:
            yield start, stop


def _composite(rows: _Rows, splats: Splats, depth_m: Tensor, canvas: Layer) -> None:
    """Draw rows, far to near, onto the canvas."""
    ranks = _ranks(rows.length)
    row = torch.repeat_interleave(rows.length)
    index = rows.splat[row]
    pixel = rows.pixel[row] + ranks
    dx = rows.dx[row] + ranks
    alpha = torch.exp(rows.log_alpha[row] - 0.5 * splats.conic[index, 0] * dx * dx)
    ahead_m = depth_m.reshape(-1)[pixel] - splats.z_m[index]
    alpha = alpha * (0.5 + ahead_m * (0.5 / NEAR_EDGE_M)).clamp(0.0, 1.0)
    hiding = splats.large[index] & (alpha > HIDING_ALPHA)
    canvas.covered.reshape(-1)[pixel[hiding]] = True
    drawn = alpha > 0.0
    index, pixel, alpha = index[drawn], pixel[drawn], alpha[drawn]
    if len(pixel) == 0:
        return
    pixel, order = torch.sort(pixel.int(), stable=True)
    index, alpha = index[order], alpha[order]

    is_last = torch.ones_like(pixel, dtype=torch.bool)
    is_last[:-1] = pixel[1:] != pixel[:-1]
    ends = torch.nonzero(is_last)[:, 0]
    lengths = torch.diff(ends, prepend=ends.new_full((1,), -1))
    passed = torch.cumsum(_fixed(torch.log1p(-alpha)), 0)
    nearer = torch.repeat_interleave(passed[ends], lengths) - passed
    weight = alpha * torch.exp(_float(nearer))
    added = _fixed(splats.light.T[:, index] * weight)
    light = _float(_differences(torch.cumsum(added, 1)[:, ends]))
    through = torch.exp(_float(_differences(passed[ends])))

    touched = pixel[ends].long()
    flat = canvas.light.reshape(3, -1)
    flat[:, touched] = light + through * flat[:, touched]
    canvas.through.reshape(-1)[touched] *= through


def _fixed(value: Tensor) -> Tensor:
    return (value.double() * ONE).round().long()


def _float(fixed: Tensor) -> Tensor:
    return (fixed.double() / ONE).float()


def _differences(sums: Tensor) -> Tensor:
    """Sums of the segments, from running sums at their ends, along the last axis."""
    return torch.diff(sums, prepend=torch.zeros_like(sums[..., :1]), dim=-1)
