"""What a class table is, and the 19 classes that every table leads to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

CLASSES = (
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
)


@dataclass(frozen=True)
class ClassTable:
    """A data set's classes, by name.

    Convention:
        `names` declares the ids. A name that neither `classes` nor `relaxed` holds is not trained
        on. `relaxed` comes on top of `classes` and never changes what is in it.
    """

    names: dict[int, str]
    """Name of each id, as the data set writes it."""
    classes: dict[str, str]
    """Train class of a name."""
    relaxed: dict[str, str] = field(default_factory=dict)
    """Train class of a name where a near fit is better than none."""
    colours: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    """RGB colour of each id, for data sets that publish their labels in colour."""
    other_names: dict[str, str | None] = field(default_factory=dict)
    """Names that other releases of the data set use, and their train class."""


def numbered(names: Iterable[str], first: int = 0) -> dict[int, str]:
    """Names by id, counted from `first`."""
    return dict(enumerate(names, first))


def all_as(train_class: str, *names: str) -> dict[str, str]:
    """Each of `names` with one train class."""
    return dict.fromkeys(names, train_class)


def as_named(*but: str) -> dict[str, str]:
    """The 19 classes under their own names, without those in `but`."""
    return {name: name for name in CLASSES if name not in but}
