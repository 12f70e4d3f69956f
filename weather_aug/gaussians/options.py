"""How a drive is fitted as Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError

STRATEGIES = ("relocation", "gradient", "none")


@dataclass(frozen=True)
class FitOptions:
    """How a drive is fitted.

    Raises:
        ArgumentError: If a number is out of its range.
    """

    steps: int = 6000
    """Pictures looked at, one a step."""
    count: int = 100_000
    """Gaussians of what stands still, at the most."""
    scale: float = 1.0
    """Of the frames' sides, in (0, 1]."""
    sh_degree: int = 1
    """Of the colours, 0..3."""
    densify: str = "relocation"
    """"relocation" (MCMC), "gradient" (3DGS) or "none"."""
    held_out: int = 0
    """Every n-th time step is held out and measured; none if 0."""
    refine: bool = True
    """Whether poses and exposures are learnt, too."""
    sky_size: int = 256
    """Texels along a side of the sky's faces, a power of 2."""
    seed: int = 0
    threads: int = 1
    """Of the CPU's kernels; the result does not depend on it."""

    def __post_init__(self) -> None:
        finite("steps", self.steps, 1, 1e7)
        finite("count", self.count, 1, 1e8)
        finite("scale", self.scale, 1e-3, 1)
        finite("threads", self.threads, 1, 1024)
        if self.sh_degree not in (0, 1, 2, 3):
            raise ArgumentError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree!r}")
        if self.densify not in STRATEGIES:
            raise ArgumentError(f"densify {self.densify!r} is not one of {', '.join(STRATEGIES)}")
        check_seed("seed", self.seed)
