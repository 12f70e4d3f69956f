"""The rasteriser of Gaussians: beside plain torch, a large frame, and how the cost grows.

`python -m benchmarks.gaussians` measures this alone and draws the growth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks import gaussians_peer
from benchmarks.gaussians_scene import Street, lens, street_of
from benchmarks.growth import fitted_power
from benchmarks.report import Row, show
from benchmarks.timing import interleaved
from weather_aug.gaussians.harmonics import colours_seen
from weather_aug.gaussians.rasterise import Drawn, rasterise
from weather_aug.gaussians.types import SH_COEFFICIENTS, Pinhole

SMALL, SMALL_COUNT = (320, 192), 20_000
LARGE, LARGE_COUNT = (1242, 375), 300_000
COUNTS = (5_000, 10_000, 20_000, 50_000, 100_000, 200_000, 300_000)
COUNTS_SIZE = (640, 384)
SIZES = ((155, 47), (220, 66), (310, 94), (439, 133), (621, 188), (878, 265), (1242, 375))
"""One view at more and more pixels."""
SIZES_COUNT = 50_000
OURS, THEIRS, PADDED = "ours", "torch, lists of a length together", "torch, padded to the longest"
FORWARD, BOTH = "forward", "forward + backward"
ROUNDS, SLOW_ROUNDS = 7, 3


class Growth(NamedTuple):
    """y = fixed + factor * x ** exponent."""

    fixed: float
    factor: float
    exponent: float

    def at(self, x: Any) -> Any:
        """The fit's values."""
        return self.fixed + self.factor * np.asarray(x, float) ** self.exponent


def fitted_growth(x: Sequence[float], y: Sequence[float]) -> Growth:
    """Least squares of log y; what does not grow is tried in steps of a hundredth of the least y.

    Few large Gaussians cover as many pixels as many small ones, so a picture has a cost that no
    power of their number tells.
    """
    fits = []
    for fixed in np.linspace(0, 0.99, 100) * min(y):
        fit = Growth(fixed, *fitted_power(x, np.asarray(y) - fixed))
        fits.append((float(((np.log(fit.at(x)) - np.log(y)) ** 2).sum()), fit))
    return min(fits)[1]


def measure() -> dict[str, Any]:
    """Print the ratios, the large frame's time and both growths."""
    return {
        "ratios": beside_torch(),
        "frame": large_frame(),
        "gaussians": by_gaussians(),
        "pixels": by_pixels(),
    }


def beside_torch() -> dict[str, Any]:
    """Forward and backward of one small picture, ours and the peer's two ways."""
    street, pinhole = street_of(SMALL_COUNT), lens(*SMALL)
    with torch.no_grad():
        error = ours(street, pinhole).colours - theirs(street, pinhole)[0]
    ms = interleaved(
        {
            OURS: both(street, partial(ours, pinhole=pinhole)),
            THEIRS: both(street, partial(theirs, pinhole=pinhole)),
            PADDED: both(street, partial(theirs, pinhole=pinhole, group_fragments=None)),
        },
        SLOW_ROUNDS,
    )
    rows = [
        *ratios(ms),
        Row("  ours", ms[OURS], "ms"),
        Row("  agreement of the two pictures", -10 * math.log10(error.square().mean()), "dB"),
    ]
    width, height = SMALL
    title = f"{SMALL_COUNT:,} Gaussians at {width} x {height}, forward + backward"
    return show(title, rows) | {"ms": ms}


def ratios(ms: dict[str, float]) -> list[Row]:
    """How many times as long plain torch takes."""
    return [
        Row(f"{PADDED} / ours", ms[PADDED] / ms[OURS], "x", at_least=100),
        Row(f"{THEIRS} / ours", ms[THEIRS] / ms[OURS], "x"),
    ]


def large_frame() -> dict[str, Any]:
    """A picture of as many Gaussians as a fitted drive has, with and without gradients."""
    street, pinhole = street_of(LARGE_COUNT), lens(*LARGE)
    draw = torch.Generator().manual_seed(0)
    sh = 0.1 * torch.randn(LARGE_COUNT, SH_COEFFICIENTS[-1], 3, generator=draw)
    seen = partial(colours_seen, sh, street.means_m, torch.zeros(3))
    ms = interleaved(
        {
            FORWARD: forward(street, partial(ours, pinhole=pinhole)),
            BOTH: both(street, partial(ours, pinhole=pinhole)),
            "harmonics": seen,
        },
        SLOW_ROUNDS,
    )
    with torch.no_grad():
        drawn = ours(street, pinhole)
    rows = [
        *frame_rows(ms),
        Row("  drawn", float((drawn.radii_px > 0).sum()), "Gaussians"),
        Row("  covered", float((drawn.opacity > 0.5).float().mean()), "of the pixels"),
    ]
    width, height = LARGE
    return show(f"{LARGE_COUNT:,} Gaussians at {width} x {height}", rows) | {"ms": ms}


def frame_rows(ms: dict[str, float]) -> list[Row]:
    """Seconds of the large frame."""
    return [
        Row("a frame", ms[FORWARD] / 1e3, "s", at_most=1),
        Row("a frame and its colours from harmonics of degree 3", sum_s(ms), "s", at_most=1),
        Row("a frame and all gradients", ms[BOTH] / 1e3, "s"),
    ]


def sum_s(ms: dict[str, float]) -> float:
    """Seconds of a frame whose colours depend on where it is seen from."""
    return (ms[FORWARD] + ms["harmonics"]) / 1e3


def by_gaussians() -> dict[str, Any]:
    """Milliseconds against Gaussians, of one size of picture."""
    width, height = COUNTS_SIZE
    print(f"\n{width} x {height}: ms at {', '.join(f'{n:,}' for n in COUNTS)} Gaussians")
    curves = grown(COUNTS, [(street_of(count), lens(width, height)) for count in COUNTS], "n")
    return {"size": [width, height], "counts": list(COUNTS), "curves": curves}


def by_pixels() -> dict[str, Any]:
    """Milliseconds against megapixels, of one street."""
    megapixels = [width * height / 1e6 for width, height in SIZES]
    print(f"\n{SIZES_COUNT:,} Gaussians: ms at {', '.join(f'{m:.2g}' for m in megapixels)} Mpx")
    street = street_of(SIZES_COUNT)
    curves = grown(megapixels, [(street, lens(*size)) for size in SIZES], "p")
    return {"count": SIZES_COUNT, "megapixels": megapixels, "curves": curves}


def grown(x: Any, cases: list[tuple[Street, Pinhole]], name: str) -> dict[str, Any]:
    """Milliseconds of ours and of the peer in each case, all in turns, and the fits."""
    runs: dict[str, dict[int, Callable[[], object]]] = {FORWARD: {}, BOTH: {}, THEIRS: {}}
    for index, (street, pinhole) in enumerate(cases):
        draw = partial(ours, pinhole=pinhole)
        runs[FORWARD][index] = forward(street, draw)
        runs[BOTH][index] = both(street, draw)
        runs[THEIRS][index] = both(street, partial(theirs, pinhole=pinhole))
    mine = {f"{key} {i}": run for key in (FORWARD, BOTH) for i, run in runs[key].items()}
    peers = {f"{THEIRS} {i}": run for i, run in runs[THEIRS].items()}
    ms = interleaved(mine, ROUNDS) | interleaved(peers, 1)
    curves = {}
    for key, cases_of_key in runs.items():
        values = [ms[f"{key} {i}"] for i in cases_of_key]
        fit = fitted_growth(x, values)
        law = f"{fit.fixed:.0f} + c {name}^{fit.exponent:.2f}"
        print(f"  {key:34s}", " ".join(f"{v:8.1f}" for v in values), f"  ~ {law}")
        curves[key] = {"ms": values, "fit": fit._asdict()}
    print(end="", flush=True)
    return curves


def ours(street: Street, pinhole: Pinhole) -> Drawn:
    """The rasteriser's picture."""
    return rasterise(*street, pinhole)


def theirs(street: Street, pinhole: Pinhole, **options: Any) -> tuple[Tensor, Tensor, Tensor]:
    """The peer's picture."""
    return gaussians_peer.draw(*street, pinhole, **options)


def forward(street: Street, draw: Callable[[Street], Any]) -> Callable[[], object]:
    """A call without gradients."""
    return torch.no_grad()(partial(draw, street))


def both(street: Street, draw: Callable[[Street], Any]) -> Callable[[], object]:
    """A call with gradients of all inputs, through colours, opacity and depth."""
    leaves = Street(*(values.clone().requires_grad_() for values in street))

    def run() -> None:
        for leaf in leaves:
            leaf.grad = None
        colours, opacity, depth_m = draw(leaves)[:3]
        (colours.sum() + opacity.sum() + depth_m.mean()).backward()

    return run


def main() -> None:
    """Measure on one thread and draw the growth."""
    from benchmarks import gaussians_plot
    from benchmarks.run import OUT

    torch.set_num_threads(1)
    gaussians_plot.draw(measure(), Path(OUT) / "gaussians.png")


if __name__ == "__main__":
    main()
