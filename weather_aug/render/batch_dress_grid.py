"""From the editor's small grid to pixels, in torch; the look-ups of `edit.physical.spread`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor


def plain(numbers: Any) -> SimpleNamespace:
    """A kernel's named tuple of NumPy numbers as Python's, which do not change a tensor's dtype."""
    return SimpleNamespace(**{name: float(v) for name, v in numbers._asdict().items()})


@dataclass(frozen=True, eq=False)
class Pixels:
    """Some pixels of some rows of a picture, (N,) each, and what lies behind them."""

    place: Tensor
    """Index of each pixel among all of the rows."""
    row: Tensor
    """Its row among the rows."""
    column: Tensor
    depth_m: Tensor
    """`inf` for what is far."""
    ray_x: Tensor
    """Tangents of the view."""
    ray_y: Tensor
    material: Tensor
    """(N, 9) of the pixels' classes; see `edit.physical.materials`."""
    noise: Tensor
    """In [0, 1]: where snow lies first; 1/2 where none lies."""
    lie: Tensor
    """In [0, 1]: where water stands longest; 1/2 where there are no puddles."""

    def at(self, index: Tensor) -> Pixels:
        """Some of them, by their indices (M,)."""
        return Pixels(*(getattr(self, part.name).index_select(0, index) for part in fields(self)))

    def towards(self, x: float, y: float, z: float) -> Tensor:
        """Steps (N,) of a surface's place for each metre of depth, by those of (x, y, z)."""
        return x * self.ray_x + (y * self.ray_y + z)


@dataclass(frozen=True, eq=False)
class Grid:
    """The editor's maps at the height of some rows."""

    maps: Tensor
    """(K, R * w): each of R picture rows between two rows of w cells."""
    cell: Tensor
    """(W,) the cell before each pixel column."""
    share: Tensor
    """(W,) how far each is on the way to the next cell."""
    cells_across: int

    @classmethod
    def of(cls, maps: Tensor, step: float, rows: slice, width: int) -> Grid:
        """The maps (K, h, w) of a whole picture at its rows `rows`; a cell is `step` pixels."""
        height, across = maps.shape[1:]
        upper, down = between_cells(rows.start, rows.stop, step, height, maps)
        cell, share = between_cells(0, width, step, across, maps)
        above, below = maps[:, upper], maps[:, (upper + 1).clamp(max=height - 1)]
        level = above + down[:, None] * (below - above)
        return cls(level.flatten(1), cell, share, across)

    def at(self, first: int, count: int, pixels: Pixels) -> Tensor:
        """Maps `first` to `first + count` at pixels, (count, N)."""
        mine = self.maps[first : first + count]
        column = self.cell[pixels.column]
        start = pixels.row * self.cells_across
        before = mine.index_select(1, start + column)
        after = mine.index_select(1, start + (column + 1).clamp(max=self.cells_across - 1))
        return before + self.share[pixels.column] * (after - before)


def between_cells(
    first: int, stop: int, step: float, cells: int, like: Tensor
) -> tuple[Tensor, Tensor]:
    """For pixels `first` to `stop` of a side, the cell before each and its way to the next one."""
    # In float32 whatever the picture's dtype, so that each pixel has the kernel's own cells.
    pixel = torch.arange(first, stop, dtype=torch.float32, device=like.device)
    place = ((pixel + 0.5) / step - 0.5).clamp(0.0, cells - 1.0)
    cell = place.long().clamp(max=max(cells - 2, 0))
    return cell, (place - cell).to(like.dtype)
