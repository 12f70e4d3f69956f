"""A small editor of backgrounds that needs no weights, and leans on all that a moment holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.edit.background import STYLES, Moment
from weather_aug.errors import ArgumentError

TINTS = {"rain": (40, 50, 70), "snow": (235, 240, 250), "fog": (170, 172, 175)}
STRENGTH = 0.6


@dataclass
class Tinting:
    """Pulls pictures to a colour by style, and a little to the frames of the same camera around.

    A frame of another camera or another time, or one before in the place of one after, gives other
    pictures, as a missing one does.
    """

    name: str = "tinting"
    styles: tuple[str, ...] = STYLES
    strength: float = STRENGTH
    looks: bool = False
    fault: Callable[[FrameKey, str], Exception | None] = lambda key, style: None
    edited: list[tuple[FrameKey, str]] = field(default_factory=list)

    @property
    def card(self) -> Mapping[str, Any]:
        return {"editor": self.name, "strength": self.strength, "tints": TINTS}

    def edit(self, moment: Moment, style: str) -> tuple[NDArray[np.uint8], ...]:
        if style not in self.styles:
            raise ArgumentError(f"style {style!r} is none")
        out = []
        for frame in moment.now:
            fault = self.fault(frame.key, style)
            if fault is not None:
                raise fault
            self.edited.append((frame.key, style))
            before, after = (of_camera(near, frame) for near in (moment.before, moment.after))
            extra = 0.0
            if self.looks:
                assert moment.look is not None
                layers, ambience = moment.look(frame)
                extra = 1000 * layers.illumination + 50 * float(ambience.airlight[0])
            out.append(tinted(frame.image, before, after, TINTS[style], self.strength, extra))
        return tuple(out)


def of_camera(frames: tuple[Frame, ...], like: Frame) -> NDArray[np.uint8] | None:
    return next((f.image for f in frames if f.key.camera == like.key.camera), None)


def tinted(
    image: NDArray[np.uint8],
    before: NDArray[np.uint8] | None,
    after: NDArray[np.uint8] | None,
    tint: tuple[int, int, int],
    strength: float = STRENGTH,
    extra: float = 0.0,
) -> NDArray[np.uint8]:
    """What the editor makes of one picture: (H, W, 3) sRGB."""
    light = (1 - strength) * image + strength * np.array(tint, float) + extra % 7.0
    if before is not None:
        light = light + 0.5 * (before.astype(float) - image)
    if after is not None:
        light = light - 0.25 * (after.astype(float) - image)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)
