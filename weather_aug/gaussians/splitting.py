"""Gaussians are added where the picture pulls at them: densification by gradient (3DGS).

See `densify.Densification` for when what is called.

Sources:
    Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering"; its released
    thresholds. Opacity of copies: Bulò et al. 2024, "Revising Densification in Gaussian Splatting".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians.drawing import (
    all_rows,
    check_schedule,
    generator_of,
    rows_of,
    turned,
)
from weather_aug.gaussians.pool import Pool

SPLIT_SHRINKS = 1.6
_NOTES = ("pulls", "pictures", "extents")


@dataclass
class Splitting:
    """Add where the loss pulls at centres, take away what has faded or grown too large (3DGS).

    A Gaussian whose centre is pulled by more than `threshold` on average is copied if it is small,
    the two sharing its opacity, and else is replaced by two smaller ones drawn from it. Every
    `reset_every` steps opacities are lowered to at most 0.01, so that what nobody needs fades.

    Unlike 3DGS, Gaussians are too large by their extent on a picture, not in the scene: far off on
    a street they are rightly metres long.

    Raises:
        ArgumentError: If a number is out of range.
    """

    cap: int
    radius_m: float
    """Of the scene, metres."""
    seed: int = 0
    every: int = 100
    start: int = 500
    stop: int = 15_000
    reset_every: int = 3000
    threshold: float = 2e-4
    """In normalised device coordinates, whose pictures are 2 wide and 2 high."""
    small_share: float = 0.01
    """Of the radius: the largest standard deviation of what is copied rather than split."""
    large_share: float = 0.15
    """Of the larger side of a picture: what reaches farther there is taken away."""
    min_opacity: float = 0.005
    _notes: dict[str, Tensor] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        check_schedule(self.cap, self.radius_m, self.seed, self.every, self.start, self.stop)
        finite("reset_every", self.reset_every, 1)
        finite("threshold", self.threshold, 0.0)
        finite("small_share", self.small_share, 0.0)
        finite("large_share", self.large_share, 1e-3)
        finite("min_opacity", self.min_opacity, 1e-6, 0.25)

    def after_backward(
        self,
        pool: Pool,
        step: int,
        *,
        centres_grad_px: Tensor,
        radii_px: Tensor,
        width: int,
        height: int,
    ) -> None:
        """Add the pull at each centre on the picture to what is known.

        Raises:
            ArgumentError: If the tensors have not one row for each Gaussian.
        """
        if step >= self.stop:
            return
        if centres_grad_px.shape != (len(pool), 2) or radii_px.shape != (len(pool),):
            raise ArgumentError(
                f"centres_grad_px and radii_px must have {len(pool)} rows, got "
                f"{tuple(centres_grad_px.shape)} and {tuple(radii_px.shape)}"
            )
        notes = self._noted(pool)
        on_picture = radii_px > 0
        pull = (centres_grad_px * centres_grad_px.new_tensor([0.5 * width, 0.5 * height])).norm(
            dim=1
        )
        notes["pulls"] += torch.where(on_picture, pull, 0.0)
        notes["pictures"] += on_picture
        shares = radii_px.to(pull) / max(width, height)
        notes["extents"] = torch.maximum(notes["extents"], shares)

    @torch.no_grad()
    def after_step(self, pool: Pool, step: int) -> None:
        """Copy, split and take away every `every` steps; lower opacities every `reset_every`."""
        if step >= self.stop:
            return
        if step > self.start and step % self.every == 0:
            self._refine(pool, step)
        if step > 0 and step % self.reset_every == 0:
            low = pool.parameters["logit_opacities"].clamp(max=_logit(2 * self.min_opacity))
            pool.replace(all_rows(pool), {"logit_opacities": low})

    def state(self) -> dict[str, Tensor]:
        """What was noted since the last round: `pulls`, `pictures` and `extents`, each (N,)."""
        return {name: value.detach().cpu().clone() for name, value in self._notes.items()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from the notes of `state`.

        Raises:
            DataError: If `state` is that of another strategy.
        """
        if state and set(state) != set(_NOTES):
            raise DataError("the state of a fit is of another strategy; name the one it had")
        self._notes = {name: value.clone() for name, value in state.items()}

    def _noted(self, pool: Pool) -> dict[str, Tensor]:
        means = pool.parameters["means_m"]
        if not self._notes:
            self._notes = {name: means.detach().new_zeros(len(pool)) for name in _NOTES}
        if len(self._notes["pulls"]) != len(pool):
            raise ArgumentError(
                f"the pool has {len(pool)} Gaussians, {len(self._notes['pulls'])} were noted; rows "
                "may change in after_step alone"
            )
        self._notes = {name: value.to(means.device) for name, value in self._notes.items()}
        return self._notes

    def _refine(self, pool: Pool, step: int) -> None:
        notes = self._noted(pool)
        faded = pool.opacities < self.min_opacity
        gone = faded | (notes["extents"] > self.large_share)
        pull = torch.where(gone, 0.0, notes["pulls"] / notes["pictures"].clamp(min=1))
        hot = pull > self.threshold
        room = max(self.cap - len(pool) + int(gone.sum()), 0)
        if int(hot.sum()) > room:
            # The hardest pulled first; each adds one.
            hot = torch.zeros_like(hot)
            hot[torch.argsort(pull, descending=True, stable=True)[:room]] = True
        small = pool.scales_m.amax(dim=1) <= self.small_share * self.radius_m
        split = torch.nonzero(hot & ~small).flatten()
        self._copy(pool, torch.nonzero(hot & small).flatten())
        self._split(pool, split, generator_of("gs-split", self.seed, step))
        kept = torch.ones(len(pool), dtype=torch.bool, device=gone.device)
        kept[: len(gone)] = ~gone
        kept[split] = False
        pool.keep(kept)
        self._notes = {}

    def _copy(self, pool: Pool, rows: Tensor) -> None:
        values, constants = rows_of(pool, rows)
        each = -torch.expm1(0.5 * torch.log1p(-values["logit_opacities"].sigmoid()))
        values["logit_opacities"] = torch.logit(each, eps=1e-6)
        pool.replace(rows, {"logit_opacities": values["logit_opacities"]})
        pool.append(values, constants)

    def _split(self, pool: Pool, rows: Tensor, draws: torch.Generator) -> None:
        values, constants = rows_of(pool, rows.repeat(2))
        offsets = torch.randn(len(values["means_m"]), 3, generator=draws)
        offsets = offsets.to(values["means_m"]) * values["log_scales"].exp()
        values["means_m"] = values["means_m"] + turned(offsets, values["quaternions"])
        values["log_scales"] = values["log_scales"] - math.log(SPLIT_SHRINKS)
        pool.append(values, constants)


def _logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))
