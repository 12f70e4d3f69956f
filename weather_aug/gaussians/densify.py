"""Where Gaussians are added and taken away while a scene is fitted: by relocation (3DGS-MCMC).

Gaussians that have faded are moved to where others are, and places are stirred by noise; their
number stays under a cap. The other strategy behind the same protocol is `splitting.Splitting`.

Convention:
    The training loop calls `after_backward` when the gradients of a step are there, and
    `after_step` after the optimiser's step; steps count from 0. All draws are keyed by (seed,
    step). A Gaussian that is put somewhere takes all constants of the one that was there: on an
    actor it belongs to that actor. Rows of a pool may change in `after_step`, and only there.

Sources:
    Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", and its released
    constants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from weather_aug._checks import finite
from weather_aug.errors import DataError
from weather_aug.gaussians.drawing import (
    check_schedule,
    drawn_rows,
    generator_of,
    rows_of,
    turned,
)
from weather_aug.gaussians.pool import Pool

MIN_OPACITY = 0.005
NOISE = 5e5
MAX_COPIES = 51
_STIRRED_OPACITY = 0.2
"""Noise at greater opacities is below 1e-8 of that at none, less than a place's rounding."""


class Densification(Protocol):
    """What a training loop needs of a strategy; see the module's Convention."""

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
        """Take note of one picture's gradients.

        Args:
            pool: N Gaussians.
            step: Of the fit.
            centres_grad_px: (N, 2) of the loss by the projected centres, 1/pixels.
            radii_px: (N,) extent on the picture, 0 for what is not on it.
            width: Of the picture, pixels.
            height: Of the picture, pixels.
        """

    def after_step(self, pool: Pool, step: int) -> None:
        """Change the pool's rows, if it is time."""

    def state(self) -> dict[str, Tensor]:
        """What a later process needs to go on to the bit, by name."""

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""


@dataclass(frozen=True)
class Relocation:
    """Keep to at most `cap` Gaussians by moving those that have faded (3DGS-MCMC).

    Every round the dead are moved to the places of living ones, drawn in proportion to their
    opacity; then the number grows by the same rule. The copies in one place share the opacity, so
    that what is seen does not jump. After every step places are stirred by `perturb`.

    Raises:
        ArgumentError: If a number is out of range.
    """

    cap: int
    radius_m: float
    """Of the scene, metres; see `perturb`."""
    seed: int = 0
    every: int = 100
    start: int = 500
    stop: int = 25_000
    """Nothing is moved from this step on; places are still stirred, at their falling rate."""
    min_opacity: float = MIN_OPACITY
    grow: float = 1.05
    noise: float = NOISE

    def __post_init__(self) -> None:
        check_schedule(self.cap, self.radius_m, self.seed, self.every, self.start, self.stop)
        finite("min_opacity", self.min_opacity, 1e-6, 0.5)
        finite("grow", self.grow, 1.0, 10.0)
        finite("noise", self.noise, 0.0)

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
        """Do nothing: opacities alone decide."""

    def after_step(self, pool: Pool, step: int) -> None:
        """Move the dead and add, every `every` steps; stir the places."""
        if self.start < step < self.stop and step % self.every == 0:
            draws = generator_of("gs-relocation", self.seed, step)
            self._move_dead(pool, draws)
            self._add(pool, draws)
        perturb(pool, step, seed=self.seed, radius_m=self.radius_m, noise=self.noise)

    def state(self) -> dict[str, Tensor]:
        """Nothing: rounds are keyed by their step."""
        return {}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Nothing to do.

        Raises:
            DataError: If `state` is that of another strategy.
        """
        if state:
            raise DataError("the state of a fit is of another strategy; name the one it had")

    @torch.no_grad()
    def _move_dead(self, pool: Pool, draws: torch.Generator) -> None:
        alive = pool.opacities > self.min_opacity
        dead = torch.nonzero(~alive).flatten()
        if len(dead) == 0 or not bool(alive.any()):
            return
        sources = drawn_rows(pool.opacities * alive, len(dead), draws)
        self._share(pool, sources)
        values, constants = rows_of(pool, sources)
        pool.replace(dead, values, constants)

    @torch.no_grad()
    def _add(self, pool: Pool, draws: torch.Generator) -> None:
        added = min(self.cap, int(self.grow * len(pool))) - len(pool)
        alive = pool.opacities > self.min_opacity
        if added <= 0 or not bool(alive.any()):
            return
        sources = drawn_rows(pool.opacities * alive, added, draws)
        self._share(pool, sources)
        pool.append(*rows_of(pool, sources))

    def _share(self, pool: Pool, sources: Tensor) -> None:
        """Make the drawn rows what each of their copies will be."""
        rows, counts = torch.unique(sources, return_counts=True)
        opacity, factor = shared(pool.opacities[rows], (counts + 1).clamp(max=MAX_COPIES))
        values, _ = rows_of(pool, rows)
        # A trace above the limit: a copy is not dead on arrival.
        opacity = opacity.clamp(1.01 * self.min_opacity, 1 - 1e-6)
        values["logit_opacities"] = torch.logit(opacity)
        values["log_scales"] = values["log_scales"] + factor.log()[:, None]
        pool.replace(rows, values)


def shared(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of several equal Gaussians in the place of one, and the factor on its size.

    The stack lets as much light through its centre as the one did, 1 - o = (1 - o')^n, and takes as
    much light in all along a line through it.

    Args:
        opacities: (R,) in 0..1 of the ones.
        copies: (R,) int64, 1..51: n, the original included.

    Returns:
        Opacities (R,) and factors (R,) on the scales, of the type of `opacities`.

    Sources:
        3DGS-MCMC, equation 9. The inner sum over i of its binomials (i - 1 over k) is the binomial
        (n over k + 1): factor = o / Σ_k (n over k) (-1)^(k-1) o'^k / √k, k = 1..n.
    """
    wide = opacities.double()
    n = copies.double()
    # As expm1 and log1p: faint ones would lose their digits.
    each = -torch.expm1(torch.log1p(-wide.clamp(max=1 - 1e-9)) / n)
    total = torch.zeros_like(wide)
    binomial = torch.ones_like(wide)
    for k in range(1, int(copies.max()) + 1 if len(copies) else 1):
        binomial = binomial * (n - k + 1).clamp(min=0) / k
        total += (-1) ** (k - 1) * binomial * each**k / math.sqrt(k)
    return each.to(opacities), (wide / total).to(opacities)


@torch.no_grad()
def perturb(pool: Pool, step: int, *, seed: int, radius_m: float, noise: float = NOISE) -> None:
    """Stir the places of faint Gaussians, along their own extent (SGLD).

    A place moves by noise · rate · Σ η · sigmoid(100 (0.005 - o)), with the pool's rate of places,
    the covariance Σ and η drawn from a standard normal for (seed, step). That is not free of units:
    the paper's scenes are scaled to a radius of about 1. So lengths count in units of the radius
    here, and a drive in metres is stirred as the same drive in any other unit.

    Args:
        pool: Its `means_m` change in place.
        step: Of the fit.
        seed: Of the draws.
        radius_m: Of the scene, metres; see `initialise.scene_radius_m`.
        noise: The paper's 5e5.

    Sources:
        3DGS-MCMC, equation 8 and its released constants.
    """
    opacities = pool.opacities
    rows = torch.nonzero(opacities < _STIRRED_OPACITY).flatten()
    if len(rows) == 0 or noise == 0:
        return
    # Drawn on the CPU: the same numbers on every device.
    draws = torch.randn(len(rows), 3, generator=generator_of("gs-noise", seed, step))
    quaternions = pool.parameters["quaternions"][rows]
    variances = pool.scales_m[rows] ** 2
    local = turned(draws.to(quaternions), quaternions, back=True) * variances
    gate = torch.sigmoid(100 * (0.005 - opacities[rows]))
    size = noise * pool.rates["means_m"] / radius_m**2
    pool.parameters["means_m"][rows] += size * gate[:, None] * turned(local, quaternions)
