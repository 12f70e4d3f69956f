"""Weather that becomes more severe, or less, as a training goes on."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError, printable
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.severity import parse_severity

Range = tuple[float, float]


@dataclass(frozen=True)
class SeverityCurriculum:
    """The range of severities as a piecewise linear function of the epoch.

    Convention:
        Each stage is (epoch, (low, high)). Between two stages both ends of the range move on a
        straight line; before the first and after the last they stay. All else is the policy's.

    Raises:
        ArgumentError: If there is no stage, epochs do not increase, or a range is not in [0, 1].

    Example:
        >>> SeverityCurriculum(((0, (0.1, 0.3)), (10, (0.1, 1.0)))).severity(5)
        (0.1, 0.65)
    """

    stages: tuple[tuple[int, Range], ...]

    def __post_init__(self) -> None:
        try:
            stages = tuple((_epoch(epoch), _range(severity)) for epoch, severity in self.stages)
        except (TypeError, ValueError) as error:
            raise ArgumentError(
                f"stages must be pairs (epoch, (low, high)) of severities in [0, 1]: {error}"
            ) from None
        epochs = [epoch for epoch, _ in stages]
        if not stages or epochs != sorted(set(epochs)):
            raise ArgumentError(f"stages must be one or more, of increasing epochs, got {epochs}")
        object.__setattr__(self, "stages", stages)

    def severity(self, epoch: int) -> Range:
        """The range (low, high) of an epoch."""
        after = bisect_right([start for start, _ in self.stages], epoch)
        if after == 0:
            return self.stages[0][1]
        if after == len(self.stages):
            return self.stages[-1][1]
        (start, first), (end, second) = self.stages[after - 1 : after + 1]
        share = (epoch - start) / (end - start)
        low, high = (a + share * (b - a) for a, b in zip(first, second, strict=True))
        return low, high

    def policy_at(self, policy: WeatherPolicy, epoch: int) -> WeatherPolicy:
        """The policy with the range of an epoch."""
        return replace(policy, severity=self.severity(epoch))

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON values."""
        return {"stages": [[epoch, list(severity)] for epoch, severity in self.stages]}

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> SeverityCurriculum:
        """The inverse of `to_dict`; unknown fields are refused.

        Raises:
            ArgumentError: If it is no such object.
        """
        if not isinstance(state, Mapping) or set(state) != {"stages"}:
            raise ArgumentError(
                f'a SeverityCurriculum is read from {{"stages": ...}}, got {printable(state)}'
            )
        return cls(state["stages"])


def _epoch(epoch: int) -> int:
    return check_seed("epoch", epoch)


def _range(severity: Any) -> Range:
    low, high = (parse_severity(end) for end in severity)
    if low > high:
        raise ValueError(f"{severity} is no range (low, high)")
    return low, high
