"""Gaussians of actors at one moment: from the frames of their owners into the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from weather_aug.errors import ArgumentError
from weather_aug.gaussians import placing_kernels
from weather_aug.gaussians.rotations import product, quaternions_of_tensor


def placed(
    means_m: Tensor,
    quaternions: Tensor,
    owners: Tensor,
    offsets_m: Tensor,
    poses: Tensor,
    basis_by_actor: Tensor,
) -> tuple[Tensor, Tensor]:
    """Means (M, 3) and quaternions (M, 4) of actors' Gaussians in world axes.

    All but the owners and the basis get gradients. Select rows whose actor is there
    (`present[owners]`) before. float32 on a CPU goes through compiled loops, all else through
    torch.

    Args:
        means_m: (M, 3) in the actor's frame.
        quaternions: (M, 4), of any length, which they keep.
        owners: (M,) integers, index into the actors.
        offsets_m: (M, B, 3) coefficients in the actor's frame.
        poses: (A, 4, 4) world_from_actor.
        basis_by_actor: (A, B), see `actors.offset_bases`.

    Raises:
        ArgumentError: If shapes disagree or an owner is none of the actors.
    """
    _check(means_m, quaternions, owners, offsets_m, poses, basis_by_actor)
    turns = quaternions_of_tensor(poses[:, :3, :3])
    given = (means_m, quaternions, offsets_m, poses, turns)
    if all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in given):
        bases = basis_by_actor.detach().float()
        world: tuple[Tensor, Tensor] = _Placed.apply(*given, owners, bases)
        return world
    basis = basis_by_actor.index_select(0, owners).to(offsets_m)
    here_m = means_m + torch.bmm(basis[:, None, :], offsets_m)[:, 0]
    own = poses.index_select(0, owners)
    means_world = torch.bmm(own[:, :3, :3], here_m[:, :, None])[:, :, 0] + own[:, :3, 3]
    return means_world, product(turns.index_select(0, owners), quaternions)


def _check(
    means: Tensor,
    quaternions: Tensor,
    owners: Tensor,
    offsets: Tensor,
    poses: Tensor,
    bases: Tensor,
) -> None:
    count, actors, terms = len(means), len(poses), bases.shape[-1]
    shapes = {
        "means_m": (means, (count, 3)),
        "quaternions": (quaternions, (count, 4)),
        "owners": (owners, (count,)),
        "offsets_m": (offsets, (count, terms, 3)),
        "poses": (poses, (actors, 4, 4)),
        "basis_by_actor": (bases, (actors, terms)),
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ArgumentError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    if count and not (0 <= int(owners.min()) and int(owners.max()) < actors):
        raise ArgumentError(
            f"owners must be in 0..{actors - 1}, got {int(owners.min())}..{int(owners.max())}"
        )


class _Placed(torch.autograd.Function):
    """The compiled way, differentiable in all but owners and bases."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        offsets: Tensor,
        poses: Tensor,
        turns: Tensor,
        owners: Tensor,
        bases: Tensor,
    ) -> tuple[Tensor, Tensor]:
        rows = (means, quaternions, owners.long(), offsets, poses, turns, bases)
        ctx.rows = tuple(tensor.detach().contiguous().numpy() for tensor in rows)
        means_world, quaternions_world = np.empty_like(ctx.rows[0]), np.empty_like(ctx.rows[1])
        placing_kernels.place(*ctx.rows, means_world, quaternions_world)
        return torch.from_numpy(means_world), torch.from_numpy(quaternions_world)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, d_means_world: Tensor, d_quaternions_world: Tensor
    ) -> tuple[Tensor | None, ...]:
        means, quaternions, _, offsets, poses, turns, _ = ctx.rows
        per_row = tuple(np.empty_like(array) for array in (means, quaternions, offsets))
        # Thousands of rows add up in one owner, which float32 would round.
        per_owner = np.zeros(poses.shape), np.zeros(turns.shape)
        slopes = (d.contiguous().numpy() for d in (d_means_world, d_quaternions_world))
        placing_kernels.place_back(*ctx.rows, *slopes, *per_row, *per_owner)
        grads = (*per_row, *(array.astype(np.float32) for array in per_owner))
        return (*(torch.from_numpy(array) for array in grads), None, None)
