"""Renders without all that weather does besides its air and its particles.

For tests whose subject these are: the background is then the recorded one, the glass is clean, and
the camera exposes as it was told and adds nothing of its own.
"""

from __future__ import annotations

from typing import Any

from weather_aug.render.options import EFFECTS, RenderOptions


def air_only(max_particles: int = RenderOptions.max_particles, **choices: Any) -> RenderOptions:
    """Options of a render of air and particles alone."""
    return RenderOptions(max_particles, without=EFFECTS, **choices)


AIR_ONLY = air_only()
