"""Draws of rows and numbers for a fit, turns, and rows of a pool: what strategies share."""

from __future__ import annotations

import torch
from torch import Tensor

from weather_aug._checks import finite
from weather_aug._keys import check_seed, key_of
from weather_aug.gaussians.pool import Pool


def turned(vectors: Tensor, quaternions: Tensor, *, back: bool = False) -> Tensor:
    """(N, 3) `vectors` turned by `quaternions` (N, 4), (w, x, y, z) of any length, or back."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    real, axis = unit[:, :1], unit[:, 1:]
    cross = 2 * torch.linalg.cross(-axis if back else axis, vectors)
    return vectors + real * cross + torch.linalg.cross(-axis if back else axis, cross)


def drawn_rows(weights: Tensor, count: int, draws: torch.Generator) -> Tensor:
    """(count,) int64 rows, each drawn in proportion to `weights` (N,), which are not all 0."""
    # On the CPU and in float64: the same rows on every device, and of any number.
    sums = weights.detach().cpu().double().cumsum(0)
    at = torch.rand(count, dtype=torch.float64, generator=draws) * sums[-1]
    # The last row with weight ends the sums; a draw rounded up to their end is its.
    last = int(torch.searchsorted(sums, sums[-1:]))
    return torch.searchsorted(sums, at, right=True).clamp(max=last).to(weights.device)


def generator_of(domain: str, seed: int, step: int) -> torch.Generator:
    """CPU generator whose numbers hang on (domain, seed, step) alone."""
    return torch.Generator().manual_seed(key_of(domain, seed, step) % 2**63)


def rows_of(pool: Pool, rows: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Copies of the parameters and the constants of some rows, by name."""
    values = {name: value.detach()[rows] for name, value in pool.parameters.items()}
    return values, {name: value[rows] for name, value in pool.constants.items()}


def all_rows(pool: Pool) -> Tensor:
    """(N,) int64 numbers of all rows."""
    return torch.arange(len(pool), device=pool.parameters["means_m"].device)


def check_schedule(cap: int, radius_m: float, seed: int, every: int, start: int, stop: int) -> None:
    """Refuse numbers no strategy can work with.

    Raises:
        ArgumentError: It names the number.
    """
    finite("cap", cap, 1)
    finite("radius_m", radius_m, 1e-6)
    check_seed("seed", seed)
    finite("every", every, 1)
    finite("start", start, 0)
    finite("stop", stop, 0)
