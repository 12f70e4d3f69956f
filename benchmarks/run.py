"""Print all ratios: `make bench`. One process, one core, processor time, interleaved medians."""

from __future__ import annotations

import os

os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")

import cv2
import torch

from benchmarks import overlays, sample


def main() -> None:
    """Run every benchmark on one thread."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    overlays.main()
    sample.main()


if __name__ == "__main__":
    main()
