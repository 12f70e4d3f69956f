"""Shares of uneven fog at the pixels of a picture, in torch; the look-up of `froxels.share_row`."""

from __future__ import annotations

import torch
from torch import Tensor

from weather_aug.render.froxels import FAR_SLICES, NEAR_SLICES, SLICES, Z_FAR_M, FogVolume


@torch.no_grad()
def fog_shares(volume: FogVolume, z_m: Tensor) -> Tensor:
    """Share G of even fog's optical depth at each pixel of a whole picture.

    In float32, operation by operation as `froxels.share_row`: the same bits on a CPU.

    Args:
        volume: Nodes around the whole picture; uploaded to the depth's device.
        z_m: (H, W) z-depth, metres, above 0.

    Returns:
        (H, W), of the dtype of `z_m`.
    """
    height, width = z_m.shape
    z = z_m.float()
    rows, columns = volume.share.shape[1:]
    upper, down = _nodes_of(height, volume, int(volume.first_row), rows, z)
    left, aside = _nodes_of(width, volume, int(volume.first_column), columns, z)
    share = torch.from_numpy(volume.share).to(z.device)
    above, below = share[:, upper], share[:, upper + 1]
    # (H, SLICES * C), the nodes of a picture row side by side.
    nodes = (above + down[:, None] * (below - above)).transpose(0, 1).reshape(height, -1)
    slice_, deeper = _between_slices(volume, z)
    place = slice_ * columns + left
    here = _across(nodes, place, aside)
    there = _across(nodes, place + columns, aside)
    return (here + deeper * (there - here)).to(z_m.dtype)


def _nodes_of(
    count: int, volume: FogVolume, first: int, nodes: int, like: Tensor
) -> tuple[Tensor, Tensor]:
    """Node before each of `count` pixels along a side, as an index, and how far behind it lies."""
    pixels = torch.arange(count, dtype=torch.float32, device=like.device)
    position = pixels * float(volume.nodes_per_px)
    node = position.floor()
    return (node.long() - first).clamp(0, nodes - 2), position - node


def _between_slices(volume: FogVolume, z: Tensor) -> tuple[Tensor, Tensor]:
    """Slice before each depth, and the depth's place between it and the next, even in 1 / z."""
    close = torch.sqrt(16.0 + 8.0 * z) - 4.0
    beyond = NEAR_SLICES + FAR_SLICES * (1.0 - Z_FAR_M / z)
    index = torch.where(z < Z_FAR_M, close, beyond).clamp(max=SLICES - 2).long()
    inverse = torch.from_numpy(volume.inverse_depth).to(z.device)
    per_step = torch.from_numpy(volume.per_step).to(z.device)
    return index, ((inverse[index] - 1.0 / z) * per_step[index]).clamp(0.0, 1.0)


def _across(nodes: Tensor, place: Tensor, aside: Tensor) -> Tensor:
    left = nodes.gather(1, place)
    return left + aside * (nodes.gather(1, place + 1) - left)
