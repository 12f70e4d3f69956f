"""The tinting editor with a record of what trained it, by style."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tinting_editor import Tinting

from weather_aug.edit.diffusion.leakage import TrainedOn


@dataclass
class Recorded(Tinting):
    """Tells for some styles what it was trained on."""

    records: Mapping[str, TrainedOn] = field(default_factory=dict)

    def trained_on(self, style: str) -> TrainedOn | None:
        return self.records.get(style)


def record(*digits: str) -> TrainedOn:
    """A record of digests that are one digit, 64 times."""
    return TrainedOn(frozenset(digit * 64 for digit in digits))
