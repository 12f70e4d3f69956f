"""Which frame and which weather each item of a plan gets, as a function of the item's index."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy


class Choice(Protocol):
    """Frames and weathers of a plan, without a list of them."""

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """Frame (of all scenes' frames in a row) and weather of an item."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values that join the job; by them a job is told from others."""


@dataclass(frozen=True)
class FromPolicy:
    """Weathers drawn from a policy, over frames in a shuffled order.

    Convention:
        Items run through all frames of all scenes in a shuffled order, then through all of them
        again in another, so that any count shows every frame equally often, to within one.
    """

    policy: WeatherPolicy
    seed: int

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """Item i gets `policy.draw(seed, 0, i)`."""
        cycle, place = divmod(index, frames)
        frame = int(_shuffled(self.seed, cycle, frames)[place])
        return frame, self.policy.draw(self.seed, 0, index)

    def to_dict(self) -> dict[str, Any]:
        """Policy and seed."""
        return {"policy": self.policy.to_dict(), "seed": self.seed}


@lru_cache(maxsize=4)
def _shuffled(seed: int, cycle: int, frames: int) -> NDArray[np.int64]:
    order = np.argsort(uniforms(key_of("export-order", seed, cycle), frames), kind="stable")
    order.flags.writeable = False
    return order
