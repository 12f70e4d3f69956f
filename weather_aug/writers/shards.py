"""Shards: parts of an export that machines render at the same time, each a run of its own.

Shard i of n renders the units u with u % n == i - 1 into the same output. It has a state of its
own, below the output's, with journal, lock and fence; it writes no root files, and removes nothing
of anybody's. The ordinary run, which is alone at the output, takes the lines of all journals that
it finds into its own, as far as their files are whole, renders what is missing, makes the root
files, and removes all states.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError
from weather_aug.writers import layout

if TYPE_CHECKING:
    from weather_aug.writers.plan import ExportPlan
    from weather_aug.writers.target import Target

MAX_SHARDS = 99_999


@dataclass(frozen=True)
class Shard:
    """One of several parts of a plan."""

    number: int
    """1 to `of`, as array jobs are counted."""
    of: int
    """How many there are; with more than units, some are empty."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ArgumentError: If there is no such shard.
        """
        number, of = (check_seed("shard", value) for value in (self.number, self.of))
        if not 1 <= number <= of <= MAX_SHARDS:
            raise ArgumentError(
                f"shard must be (i, n) with 1 <= i <= n <= {MAX_SHARDS}, got ({number}, {of})"
            )

    def units(self, plan: ExportPlan) -> range:
        """The units of this shard."""
        return range(self.number - 1, plan.units, self.of)

    def count(self, plan: ExportPlan) -> int:
        """How many samples it has."""
        units = self.units(plan)
        absent = plan.units * plan.layout.items_per_unit - plan.count
        return len(units) * plan.layout.items_per_unit - absent * (plan.units - 1 in units)

    def has(self, plan: ExportPlan, item: int) -> bool:
        """Whether an item of the plan is one of this shard's."""
        return item // plan.layout.items_per_unit % self.of == self.number - 1

    def state(self, out: Path) -> Path:
        """Folder of this shard's journal, lock and fence, in an output."""
        return out / layout.SHARDS / f"{self.number:05d}{self._suffix}"

    def foreign_journals(self, out: Path) -> Iterator[Path]:
        """Journals of other runs that may hold samples of this shard."""
        if (out / layout.JOURNAL).exists():
            yield out / layout.JOURNAL
        for journal in shard_journals(out):
            # Shards of the same number have no sample in common.
            if not journal.relative_to(out / layout.SHARDS).parts[0].endswith(self._suffix):
                yield journal

    @property
    def _suffix(self) -> str:
        return f"-of-{self.of:05d}"

    def __str__(self) -> str:
        return f"shard {self.number} of {self.of}"


WHOLE = Shard(1, 1)
"""All units."""


@dataclass(frozen=True)
class ShardTarget:
    """A target as one of several shards uses it; see `Target`."""

    whole: Target
    state: Path
    """Folder of this shard's lock, fence and journal."""

    def write_whole(self, relative: str, data: bytes) -> None:
        """As the target does."""
        self.whole.write_whole(relative, data)

    def is_whole(self, relative: str, stored: dict[str, Any], *, digests: bool) -> bool:
        """As the target does."""
        return self.whole.is_whole(relative, stored, digests=digests)

    def make_folders(self, relatives: Iterable[str]) -> None:
        """As the target does."""
        self.whole.make_folders(relatives)

    def remove_leftovers(self, layout: layout.Layout) -> None:
        """Remove nothing: a temporary file may be one that another shard writes just now."""

    def __str__(self) -> str:
        return str(self.whole)


def shard_journals(out: Path) -> list[Path]:
    """Journals of the shards of an output, in the order of their names."""
    return sorted((out / layout.SHARDS).glob(f"*/{layout.JOURNAL}"))
