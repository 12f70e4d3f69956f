"""How the cost grows with the number of particles and of pixels; of the air alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks.crowds import KINDS
from benchmarks.drawn import drawn
from benchmarks.overlays import CASES, FOG, IN_VIEW, air_only, peers, renders
from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.particles.field import MAX_PARTICLES
from weather_aug.render.background import looked_at
from weather_aug.render.compose import render

HEIGHT, WIDTH = 1080, 1920
MOST = MAX_PARTICLES // 2
"""The largest budget that `RenderOptions` takes; a million is refused."""
BUDGETS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, MOST)
SIZES = ((240, 426), (360, 640), (540, 960), (720, 1280), (1080, 1920), (1440, 2560), (2160, 3840))
BY_PIXELS = ("fog", "fog + rain 20k", "fog + snow 20k")
SLOW_PEERS = ("RandomRain (heavy)", "RandomSnow (texture)", "RandomFog (0.5-0.8)")
ROUNDS, SLOW_ROUNDS = 7, 3
LEAST_GROWTH = 1.25


class Power(NamedTuple):
    """y = factor * x ** exponent."""

    factor: float
    exponent: float

    def at(self, x: Any) -> Any:
        """The fit's values."""
        return self.factor * np.asarray(x, float) ** self.exponent


def fitted_power(x: Sequence[float], y: Sequence[float]) -> Power:
    """Least squares of log y over log x; both above 0."""
    exponent, offset = np.polyfit(np.log(x), np.log(y), 1)
    return Power(float(np.exp(offset)), float(exponent))


def measure() -> dict[str, Any]:
    """Print both growths and their exponents."""
    return {"particles": by_particles(), "pixels": by_pixels()}


def by_particles() -> dict[str, Any]:
    """Milliseconds against particles drawn, and the exponent of what they add to the fog pass.

    The fit leaves out counts that add less than a quarter: there fixed costs and noise rule.
    """
    frame, ambience = street(HEIGHT, WIDTH)
    call = partial(render, frame, seed=1, ambience=ambience, layers=looked_at(frame, ambience))
    runs: dict[str, Callable[[], object]] = {"fog": partial(call, FOG, options=air_only(0))}
    for kind, weather in KINDS.items():
        for budget in (0, *BUDGETS):
            runs[f"{kind} {budget}"] = partial(call, weather, options=air_only(budget))
    others = peers()
    runs |= {name: partial(others[name], image=frame.image) for name in SLOW_PEERS}
    ms = interleaved(runs, ROUNDS)
    print(f"\n{HEIGHT} x {WIDTH}: ms against particles drawn (the fog pass: {ms['fog']:.1f} ms)")
    curves = {}
    for kind in KINDS:
        counts = [drawn(runs[f"{kind} {b}"], HEIGHT, WIDTH).particles for b in BUDGETS]
        values = [ms[f"{kind} {b}"] for b in BUDGETS]
        without = ms[f"{kind} 0"]
        clear = [
            (n, v - without)
            for n, v in zip(counts, values, strict=True)
            if v > LEAST_GROWTH * without
        ]
        fit = fitted_power(*zip(*clear, strict=True))
        print(f"  {kind}:", ", ".join(f"{n}: {v:.1f}" for n, v in zip(counts, values, strict=True)))
        print(f"    without particles {without:.1f} ms; they add n^{fit.exponent:.2f}", flush=True)
        curves[kind] = {"drawn": counts, "ms": values, "ms_without": without, "fit": fit._asdict()}
    references = {name: ms[name] for name in ("fog", *SLOW_PEERS)}
    return {"size": [HEIGHT, WIDTH], "curves": curves, "references_ms": references}


def by_pixels() -> dict[str, Any]:
    """Milliseconds against megapixels, and the exponent; peers are medians of fewer rounds."""
    ms: dict[str, list[float]] = {name: [] for name in (*BY_PIXELS, *SLOW_PEERS)}
    counts: dict[str, list[int]] = {name: [] for name in BY_PIXELS if CASES[name][1]}
    for height, width in SIZES:
        frame, ambience = street(height, width)
        cases = renders(frame, ambience, looked_at(frame, ambience))
        ours = {name: cases[name] for name in BY_PIXELS}
        others = peers()
        theirs = {name: partial(others[name], image=frame.image) for name in SLOW_PEERS}
        for name, value in (interleaved(ours, ROUNDS) | interleaved(theirs, SLOW_ROUNDS)).items():
            ms[name].append(value)
        for name, values in counts.items():
            values.append(drawn(ours[name], height, width).particles)
    megapixels = [height * width / 1e6 for height, width in SIZES]
    print(f"\nms at {', '.join(f'{m:.2g}' for m in megapixels)} megapixels ({IN_VIEW} particles)")
    curves = {}
    for name, values in ms.items():
        fit = fitted_power(megapixels, values)
        print(f"  {name:22s}", " ".join(f"{v:9.1f}" for v in values), f"  ~ p^{fit.exponent:.2f}")
        curves[name] = {"ms": values, "fit": fit._asdict(), "drawn": counts.get(name)}
    print(end="", flush=True)
    return {"megapixels": megapixels, "curves": curves}


if __name__ == "__main__":
    measure()
