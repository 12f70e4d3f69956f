"""What a render draws: particles, their splats, and the pixels that these touch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from unittest.mock import patch

import numba
import numpy as np

from weather_aug.render import stage
from weather_aug.render.project import CONIC, HALF_HEIGHT, HALF_WIDTH, LEAN, LIGHT, REACH2, U, V


class Drawn(NamedTuple):
    """How much a frame has to draw."""

    particles: int
    """That touch the picture."""
    splats: int
    """A long streak is drawn as several."""
    fragments: int
    """Pixels inside the splats' footprints, counted once for each splat."""


def drawn(run: Callable[[], object], height: int, width: int) -> Drawn:
    """What `run`, a call of `render` for a whole (height, width) picture, draws."""
    seen: list[Any] = []
    original = stage.splats_of

    def watched(*args: Any, **kwargs: Any) -> Any:
        seen.append(original(*args, **kwargs))
        return seen[-1]

    with patch.object(stage, "splats_of", watched):
        run()
    # What glass and lens see of the whole, shrunk, is drawn after it.
    splats = seen[0]
    # The parts of a streak follow each other and share shape and depth.
    new = (np.diff(splats[:, CONIC:LIGHT], axis=0) != 0).any(axis=1)
    particles = int(new.sum()) + 1 if len(splats) else 0
    return Drawn(particles, len(splats), int(fragments(splats, height, width)))


@numba.njit(cache=False)
def fragments(splats, height, width):
    """Pixels of the picture inside the footprints of splats (M, 16), before the depth test."""
    count = 0
    for m in range(splats.shape[0]):
        s = splats[m]
        u, v, half_v = s[U], s[V], s[HALF_HEIGHT]
        a, b, c = s[CONIC], s[CONIC + 1], s[CONIC + 2]
        half_u = s[HALF_WIDTH] + abs(s[LEAN]) * half_v
        first, last = max(int(v - half_v), 0), min(int(v + half_v) + 1, height - 1)
        start, stop = max(int(u - half_u), 0), min(int(u + half_u) + 1, width - 1)
        for y in range(first, last + 1):
            dy = np.float32(y) - v
            for x in range(start, stop + 1):
                dx = np.float32(x) - u
                power = (a * dx + np.float32(2.0) * b * dy) * dx + c * dy * dy
                count += power <= s[REACH2]
    return count
