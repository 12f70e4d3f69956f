"""Class tables: from a data set's ids to the 19 Cityscapes train ids, by 256-entry look-ups.

Train ids are the only label space inside this package; 255 means ignore. The tables themselves are
in `weather_aug/_class_tables/`; docs/labels.md shows them and helps to choose.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from weather_aug import _class_tables
from weather_aug._checks import image_uint8, like_image
from weather_aug._class_tables import table as _table
from weather_aug._class_tables.category_json import name_by_index
from weather_aug._class_tables.lookup import known_name, plain
from weather_aug.errors import ArgumentError, DataError, printable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

IGNORE = 255

CLASSES = _table.CLASSES
"""The 19 train classes; a class's place is its train id."""

PALETTE = (
    (128, 64, 128),
    (244, 35, 232),
    (70, 70, 70),
    (102, 102, 156),
    (190, 153, 153),
    (153, 153, 153),
    (250, 170, 30),
    (220, 220, 0),
    (107, 142, 35),
    (152, 251, 152),
    (70, 130, 180),
    (220, 20, 60),
    (255, 0, 0),
    (0, 0, 142),
    (0, 0, 70),
    (0, 60, 100),
    (0, 80, 100),
    (0, 0, 230),
    (119, 11, 32),
)

TRAIN_ID = {name: index for index, name in enumerate(CLASSES)}
ROAD, SIDEWALK, BUILDING, VEGETATION, TERRAIN, SKY = (
    TRAIN_ID[name] for name in ("road", "sidewalk", "building", "vegetation", "terrain", "sky")
)
GROUND = (ROAD, SIDEWALK, TERRAIN)

TAXONOMIES = tuple(_class_tables.TABLES)
"""Names of the class tables."""

_MAX_ID = 255

# Whether a value of a data set's uncertainty mask says that the class cannot be told. MUSES marks
# with 127 where only the instance cannot be told: the class stands.
_UNCERTAIN_BY_VALUE = {
    "acdc": {0: False, 1: True},
    "muses": {0: False, 127: False, 255: True},
}


@dataclass(frozen=True)
class Taxonomy:
    """A data set's label ids and the train id of each.

    Convention:
        Ids are in 0..255. `class_by_id` holds every declared id; None stands for ids that are not
        trained on. An id outside it is a fault of the file, never silently another class.

    Raises:
        ArgumentError: If an id is outside 0..255, a class is not one of the 19, two ids have one
            colour, or `names` or `colours` holds an id that is not declared.
    """

    name: str
    class_by_id: dict[int, str | None]
    """Train class of each id, or None."""
    names: dict[int, str] = field(default_factory=dict)
    """What the data set calls each id; may be empty."""
    colours: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    """RGB colour of each id, 0..255, for labels that are kept in colour; may be empty."""

    def __post_init__(self) -> None:
        for index, train_class in self.class_by_id.items():
            if not isinstance(index, int) or not 0 <= index <= _MAX_ID:
                raise ArgumentError(
                    f"class_by_id has the id {printable(index)}; ids must be integers in "
                    f"0..{_MAX_ID}"
                )
            if train_class is not None and train_class not in TRAIN_ID:
                raise ArgumentError(
                    f"class_by_id maps {index} to {printable(train_class)!r}; it must be None or "
                    f"one of {', '.join(CLASSES)}"
                )
        for argument, ids in (("names", self.names.keys()), ("colours", self.colours.keys())):
            undeclared = sorted(ids - self.class_by_id.keys())
            if undeclared:
                raise ArgumentError(
                    f"{argument} has the id {undeclared[0]}, which class_by_id does not declare"
                )
        if len(set(self.colours.values())) != len(self.colours):
            raise ArgumentError("colours gives two ids one colour; the label cannot be read back")

    def train_ids(self, label: NDArray[np.integer], *, where: str) -> NDArray[np.uint8]:
        """Map ids of this data set to train ids.

        Args:
            label: Ids of pixels (H, W) or of points (N,), any integer type. The indices of a
                palette PNG, not its colours; classes, not instances.
            where: The file or argument to name if an id is unknown.

        Returns:
            Train ids of the same shape, 255 for what is not trained on.

        Raises:
            ArgumentError: If the label is not an integer array of such a shape.
            DataError: If the label holds an id that this taxonomy does not declare.
        """
        import numpy as np

        _check_ids(label, where)
        table = np.full(_MAX_ID + 1, IGNORE, np.uint8)
        declared = np.zeros(_MAX_ID + 1, bool)
        for index, name in self.class_by_id.items():
            table[index] = IGNORE if name is None else TRAIN_ID[name]
            declared[index] = True
        in_range = (label >= 0) & (label <= _MAX_ID)
        small = np.where(in_range, label, 0).astype(np.uint8)
        known = in_range & declared[small]
        if not known.all():
            place = _first_place(~known)
            raise DataError(
                f"{printable(where)}: label id {int(label[place])} at {_shown(place)} is not one "
                f"of {self.name}; {_cure(int(label[place]))}"
            )
        return table[small]

    def train_ids_of_colours(
        self, label_rgb: NDArray[np.uint8], *, where: str
    ) -> NDArray[np.uint8]:
        """Map a label kept in colour to train ids.

        Args:
            label_rgb: (H, W, 3) uint8 RGB (libraries that read BGR must swap it first).
            where: The file or argument to name if a colour is unknown.

        Returns:
            (H, W) train ids, 255 for what is not trained on.

        Raises:
            ArgumentError: If this taxonomy has no colours, or the label is not such an array.
            DataError: If the label holds a colour that this taxonomy does not declare, as it does
                after lossy compression or smooth resizing.
        """
        import numpy as np

        if not self.colours:
            raise ArgumentError(
                f"{self.name} has no table of colours; give train_ids() the ids, for a palette PNG "
                "its indices, read without converting it to RGB"
            )
        codes = _codes(image_uint8(printable(where), label_rgb))
        ids = np.array(list(self.colours), np.uint8)
        known_codes = _codes(np.array(list(self.colours.values()), np.uint8))
        order = np.argsort(known_codes)
        nearest = order[np.searchsorted(known_codes[order], codes).clip(max=len(order) - 1)]
        unknown = known_codes[nearest] != codes
        if unknown.any():
            place = _first_place(unknown)
            colour = tuple(int(v) for v in label_rgb[place])
            raise DataError(
                f"{printable(where)}: colour {colour} at {_shown(place)} is not one of "
                f"{self.name}; labels must be RGB and stored and resized without mixing colours"
            )
        return self.train_ids(ids[nearest], where=where)


def taxonomy(name: str, *, relaxed: bool = False) -> Taxonomy:
    """Return the class table called `name`.

    Args:
        name: One of `TAXONOMIES` or another spelling of it; case, blanks, dots, dashes and
            underscores do not count.
        relaxed: Train also on classes that fit a train class nearly (docs/labels.md lists them).
            A table that has none is the same either way.

    Raises:
        ArgumentError: If there is none of that name, or the name fits two that cannot be told
            from the files' ids.
    """
    known = known_name(name)
    table = _class_tables.TABLES[known]
    class_of = _class_of_name(table, relaxed)
    return Taxonomy(
        f"{known} (relaxed)" if relaxed and table.relaxed else known,
        {index: class_of.get(label) for index, label in table.names.items()},
        dict(table.names),
        dict(table.colours),
    )


def taxonomy_of_names(
    name: str, names: Sequence[str] | Mapping[int, str], *, relaxed: bool = False
) -> Taxonomy:
    """Return the class table called `name` for a release with ids of its own.

    CamVid's 11 classes stand in different orders, and a Mapillary config file lists its own.

    Args:
        name: As for `taxonomy`; its classes are used, its ids are not.
        names: Class name of each id: in the order of the ids, counted from 0, or by id. Case,
            blanks, dashes and underscores do not count. Where the table itself ignores 255, so
            does this one.
        relaxed: As for `taxonomy`.

    Raises:
        ArgumentError: If a name is unknown or stands twice, or a train class of the table is left
            without any name.
    """
    known = known_name(name)
    table = _class_tables.TABLES[known]
    if isinstance(names, str | bytes) or not isinstance(names, Sequence | Mapping):
        raise ArgumentError(f"names must be a list or a mapping, got {type(names).__name__}")
    given = dict(names) if isinstance(names, Mapping) else dict(enumerate(names))
    class_by_name: dict[str, str | None] = dict.fromkeys(table.names.values())
    class_by_name |= table.other_names | _class_of_name(table, relaxed)
    class_by_plain = {plain(key): value for key, value in class_by_name.items()}
    unknown = [label for label in given.values() if plain(label) not in class_by_plain]
    if unknown:
        raise ArgumentError(
            f"names has {printable(unknown[0])!r}, which is no class of {known}; there are "
            f"{', '.join(class_by_name)}"
        )
    spelt = [plain(label) for label in given.values()]
    twice = [label for label in given.values() if spelt.count(plain(label)) > 1]
    if twice:
        raise ArgumentError(f"names has {printable(twice[0])!r} twice; each id needs its own")
    class_by_id = {index: class_by_plain[plain(label)] for index, label in given.items()}
    missing = set(table.classes.values()) - set(class_by_id.values())
    if missing:
        raise ArgumentError(
            f"names has no class for {', '.join(sorted(missing))}, so it is not the whole list of "
            f"{known}; give every class"
        )
    if IGNORE in table.names:
        class_by_id.setdefault(IGNORE, None)
    return Taxonomy(f"{known} (by name)", class_by_id, given)


def nuscenes_lidarseg(category_json: str | os.PathLike[str], *, relaxed: bool = False) -> Taxonomy:
    """Return the class table of nuScenes-lidarseg with the ids of a copy's own category.json.

    The ids 25 to 30 differ between sources; this file is what the labels were written with.

    Args:
        category_json: `v1.0-*/category.json` after nuScenes-lidarseg was unpacked over nuScenes.
        relaxed: As for `taxonomy`.

    Raises:
        DataError: If the file cannot be read, or does not give each of the 32 classes its own id.
    """
    return taxonomy_of_names(
        "nuscenes_lidarseg", name_by_index(Path(category_json)), relaxed=relaxed
    )


def certain_train_ids(
    train_ids: NDArray[np.uint8],
    mask: NDArray[np.integer],
    *,
    kind: Literal["acdc", "muses"],
    where: str,
) -> NDArray[np.uint8]:
    """Return train ids with 255 where annotators marked the class as uncertain.

    Args:
        train_ids: (H, W) uint8.
        mask: (H, W) integers as shipped: of ACDC `gt_invIds` (0 valid, 1 invalid), of MUSES
            `gt_uncertainty` (0 certain, 127 instance uncertain, 255 class uncertain). Of MUSES
            only 255 is ignored: where the instance is uncertain the class is not.
        kind: Whose mask it is.
        where: The file or argument to name if the mask holds another value.

    Raises:
        ArgumentError: If `kind` is unknown, or the arrays are not integers of one shape (H, W).
        DataError: If the mask holds another value, or the label holds what is no train id.
    """
    import numpy as np

    if kind not in _UNCERTAIN_BY_VALUE:
        raise ArgumentError(
            f"kind must be one of {', '.join(_UNCERTAIN_BY_VALUE)}, got {printable(kind)!r}"
        )
    label = taxonomy("train_ids").train_ids(train_ids, where="train_ids")
    _check_ids(mask, where)
    like_image(printable(where), mask, label.shape)
    uncertain_by_value = _UNCERTAIN_BY_VALUE[kind]
    unknown = ~np.isin(mask, list(uncertain_by_value))
    if unknown.any():
        place = _first_place(unknown)
        values = ", ".join(str(value) for value in uncertain_by_value)
        raise DataError(
            f"{printable(where)}: value {int(mask[place])} at {_shown(place)} is not one of "
            f"{kind}'s mask ({values}); check kind="
        )
    uncertain = np.isin(mask, [value for value, yes in uncertain_by_value.items() if yes])
    return np.where(uncertain, np.uint8(IGNORE), label)


def coloured(label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Paint train ids (H, W) in the Cityscapes palette, (H, W, 3) uint8; ignore is black."""
    import numpy as np

    table = np.zeros((256, 3), np.uint8)
    table[: len(PALETTE)] = PALETTE
    return table[label]


def _class_of_name(table: _table.ClassTable, relaxed: bool) -> dict[str, str]:
    return table.classes | (table.relaxed if relaxed else {})


def _check_ids(label: Any, where: str) -> None:
    import numpy as np

    shown = printable(where)
    if not isinstance(label, np.ndarray) or not np.issubdtype(label.dtype, np.integer):
        kind = label.dtype if isinstance(label, np.ndarray) else type(label).__name__
        raise ArgumentError(f"{shown} must be a numpy array of integer ids, got {kind}")
    if label.ndim == 3:
        raise ArgumentError(
            f"{shown} has shape {label.shape}, so it holds colours; ids must be (H, W): read a "
            "palette PNG without converting it to RGB, or use train_ids_of_colours()"
        )
    if label.ndim not in (1, 2):
        raise ArgumentError(f"{shown} must have shape (H, W) or (N,), got {label.shape}")


def _cure(unknown_id: int) -> str:
    if unknown_id > _MAX_ID:
        return (
            "ids this high are instances (1000 or 256 times the class, plus a number): give the "
            "semantic label instead, or divide first"
        )
    return "choose another with taxonomy=…"


def _first_place(mask: NDArray[np.bool_]) -> tuple[int, ...]:
    import numpy as np

    return tuple(int(v) for v in np.argwhere(mask)[0])


def _shown(place: tuple[int, ...]) -> str:
    if len(place) == 1:
        return f"index {place[0]}"
    return f"row {place[0]}, column {place[1]}"


def _codes(rgb: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """One number for each colour of a (…, 3) array."""
    import numpy as np

    return rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
