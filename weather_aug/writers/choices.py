"""Which frame and which weather each item of a plan gets, as a function of the item's index."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ArgumentError, printable
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy, weather_of
from weather_aug.weather import Weather
from weather_aug.writers.balance import Balanced

SEVERITY = "heavy"
"""Of a weather that is named without one."""


class Choice(Protocol):
    """Frames and weathers of a plan, without a list of them."""

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """Frame (of all scenes' frames in a row) and weather of an item."""

    def shares(self) -> dict[str, float]:
        """Expected share of the items in each weather, by its kind; they sum to 1."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values that join the job; by them a job is told from others."""


@dataclass(frozen=True)
class FromPolicy:
    """Weathers drawn from a policy, over frames in a shuffled order or balanced by class.

    Convention:
        Unless they are balanced, items run through all frames of all scenes in a shuffled order,
        then through all of them again in another, so that any count shows every frame equally
        often, to within one. A balance changes the frames alone, not the weathers.
    """

    policy: WeatherPolicy
    seed: int
    balance: Balanced | None = None

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """Item i gets `policy.draw(seed, 0, i)`."""
        draw = self.policy.draw(self.seed, 0, index)
        if self.balance is not None:
            return self.balance.frame(self.seed, index), draw
        cycle, place = divmod(index, frames)
        return int(_shuffled(self.seed, cycle, frames)[place]), draw

    def shares(self) -> dict[str, float]:
        """The policy's weights."""
        total = sum(self.policy.types.values())
        return {kind: weight / total for kind, weight in self.policy.types.items() if weight}

    def to_dict(self) -> dict[str, Any]:
        """Policy, seed, and the balance if there is one."""
        balance = {} if self.balance is None else {"balance": self.balance.to_dict()}
        return {"policy": self.policy.to_dict(), "seed": self.seed, **balance}


@lru_cache(maxsize=4)
def _shuffled(seed: int, cycle: int, frames: int) -> NDArray[np.int64]:
    order = np.argsort(uniforms(key_of("export-order", seed, cycle), frames), kind="stable")
    order.flags.writeable = False
    return order


@dataclass(frozen=True)
class FromGrid:
    """Every frame in every weather with every seed.

    Convention:
        Seeds run fastest, then weathers in their order, then frames by scene, time and camera: of W
        weathers and S seeds item i is of frame i // (W S), weather (i // S) mod W, seed i mod S.
        Kinds are the weathers' names; there is no severity.
    """

    weathers: Mapping[str, Weather]
    seeds: tuple[int, ...]
    chosen: tuple[int, ...] | None = None
    """Frames, of all scenes' frames in a row; all of them if None."""

    def count(self, frames: int) -> int:
        """How many items there are over so many frames of all scenes."""
        chosen = frames if self.chosen is None else len(self.chosen)
        return chosen * len(self.weathers) * len(self.seeds)

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """See `Choice.item`."""
        rest, seed = divmod(index, len(self.seeds))
        place, which = divmod(rest, len(self.weathers))
        kind = list(self.weathers)[which]
        draw = WeatherDraw(self.weathers[kind], self.seeds[seed], kind, None)
        return place if self.chosen is None else self.chosen[place], draw

    def shares(self) -> dict[str, float]:
        """All alike."""
        return dict.fromkeys(self.weathers, 1 / len(self.weathers))

    def to_dict(self) -> dict[str, Any]:
        """Weathers in their order, seeds, and which frames."""
        weathers = [[kind, weather.to_dict()] for kind, weather in self.weathers.items()]
        frames = None if self.chosen is None else list(self.chosen)
        return {"grid": {"weathers": weathers, "seeds": list(self.seeds), "frames": frames}}


def weathers_by_name(weathers: Mapping[str, Weather] | Sequence[str]) -> dict[str, Weather]:
    """Weathers by name: as they are given, or of texts such as "rain=0.3" or "rain+fog=heavy".

    A text is a type (several at once with "+" between them) and its severity, `SEVERITY` if none
    stands there; the text is the name.

    Raises:
        ArgumentError: If there are none, two have one name, or a text names no weather.
    """
    if isinstance(weathers, str) or not isinstance(weathers, Mapping | Sequence):
        raise ArgumentError(
            f"weathers must be a mapping or a list of texts, got {type(weathers).__name__}"
        )
    if not weathers:
        raise ArgumentError("weathers is empty; give at least one")
    if isinstance(weathers, Mapping):
        return {_name(kind): _weather(kind, weather) for kind, weather in weathers.items()}
    twice = [text for place, text in enumerate(weathers) if text in weathers[:place]]
    if twice:
        raise ArgumentError(f"weather {printable(twice[0])!r} stands twice")
    return {_name(text): weather_named(text) for text in weathers}


def weather_named(text: str) -> Weather:
    """The weather of a text such as "clear", "rain=0.3" or "rain+fog=heavy".

    Raises:
        ArgumentError: If it names none.
    """
    kinds, _, severity = text.partition("=")
    try:
        stop: float | str = float(severity)
    except ValueError:
        stop = severity or SEVERITY
    return reduce(Weather.mix, [weather_of(kind, stop) for kind in kinds.split("+")])


def _name(kind: Any) -> str:
    if not isinstance(kind, str) or not kind:
        raise ArgumentError(
            f"a weather's name must be a text, got {printable(kind)!r}; name weathers of your own "
            "in a mapping"
        )
    return kind


def _weather(kind: str, weather: Any) -> Weather:
    if not isinstance(weather, Weather):
        raise ArgumentError(
            f"weather {printable(kind)!r} must be a Weather, got {type(weather).__name__}"
        )
    return weather
