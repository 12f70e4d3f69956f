"""The figures of docs/physics.md: what the library draws, beside what the formulas say.

python recipes/02_physics_figures.py --out docs/figures      # or: make figures
"""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path

from physics_figures import depth, fog, motion, severity, sizes, streaks, strength
from PIL import Image

FIGURES = {
    "01_sizes_and_speeds": sizes.drops_and_flakes,
    "02_explicit_and_residual": depth.explicit_and_residual,
    "03_beer_lambert": depth.beer_lambert,
    "04_streaks": streaks.streaks,
    "05_resolution": strength.resolution,
    "06_extinction": strength.extinction,
    "07_fog": fog.fog,
    "08_stationarity": motion.stationarity,
    "09_gusts": motion.gusts,
    "10_severity": severity.severity,
}


def main() -> None:
    """Draw the figures and print how far each measurement is from its reference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/figures"))
    parser.add_argument("--quick", action="store_true", help="fewer samples: more noise")
    parser.add_argument("--only", nargs="*", default=list(FIGURES), choices=list(FIGURES))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        start_s = time.perf_counter()
        figure, found = FIGURES[name](options.quick)
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png")
        # A palette holds a diagram in a third of the bytes, and the same bytes each time.
        picture = Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE)
        picture.save(options.out / f"{name}.png", optimize=True)
        print(f"{name} ({time.perf_counter() - start_s:.0f} s)")
        for what, value in found.items():
            print(f"  {what}: {value:.4g}")


if __name__ == "__main__":
    main()
