"""Class tables: from a data set's ids to the 19 Cityscapes train ids, by 256-entry look-ups.

Train ids are the only label space inside this package; 255 means ignore.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from weather_aug.errors import ArgumentError, DataError, printable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

IGNORE = 255

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

_CITYSCAPES_IDS = {
    7: "road",
    8: "sidewalk",
    11: "building",
    12: "wall",
    13: "fence",
    17: "pole",
    19: "traffic light",
    20: "traffic sign",
    21: "vegetation",
    22: "terrain",
    23: "sky",
    24: "person",
    25: "rider",
    26: "car",
    27: "truck",
    28: "bus",
    31: "train",
    32: "motorcycle",
    33: "bicycle",
}

_CAMVID_11 = (
    "sky",
    "building",
    "pole",
    "road",
    "sidewalk",
    "vegetation",
    "traffic sign",
    "fence",
    "car",
    "person",
    "rider",
)


@dataclass(frozen=True)
class Taxonomy:
    """A data set's label ids and the train id of each.

    Convention:
        `class_by_id` holds every declared id; None stands for ids that are not trained on. An id
        outside it is a fault of the file, never silently another class.
    """

    name: str
    class_by_id: dict[int, str | None]

    def train_ids(self, label: NDArray[np.integer], *, where: str) -> NDArray[np.uint8]:
        """Map a (H, W) array of this data set's ids to train ids.

        Args:
            label: Integer array of ids.
            where: The file or argument to name if an id is unknown.

        Raises:
            DataError: If the label holds an id that this taxonomy does not declare.
        """
        import numpy as np

        table = np.full(256, IGNORE, np.uint8)
        declared = np.zeros(256, bool)
        for index, name in self.class_by_id.items():
            table[index] = IGNORE if name is None else TRAIN_ID[name]
            declared[index] = True
        in_range = (label >= 0) & (label <= 255)
        small = np.where(in_range, label, 0).astype(np.uint8)
        known = in_range & declared[small]
        if not known.all():
            row, column = (int(v) for v in np.argwhere(~known)[0])
            raise DataError(
                f"{printable(where)}: label id {int(label[row, column])} at row {row}, column "
                f"{column} is not one of {self.name}; choose another with taxonomy=…"
            )
        return table[small]


def _taxonomies() -> dict[str, Taxonomy]:
    train = {**dict(enumerate(CLASSES)), IGNORE: None}
    unlabelled = dict.fromkeys((*range(35), 255))
    cityscapes: dict[int, str | None] = {**unlabelled, **_CITYSCAPES_IDS}
    camvid: dict[int, str | None] = dict(enumerate(_CAMVID_11)) | {11: None, 255: None}
    return {
        "train_ids": Taxonomy("train_ids", train),
        "cityscapes": Taxonomy("cityscapes", cityscapes),
        "camvid11": Taxonomy("camvid11", camvid),
    }


_TAXONOMIES = _taxonomies()


def taxonomy(name: str) -> Taxonomy:
    """Return the taxonomy called `name`.

    Raises:
        ArgumentError: If there is none of that name.
    """
    try:
        return _TAXONOMIES[name]
    except KeyError:
        known = ", ".join(_TAXONOMIES)
        raise ArgumentError(f"no taxonomy {printable(name)!r}; there are {known}") from None


def coloured(label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Paint train ids (H, W) in the Cityscapes palette, (H, W, 3) uint8; ignore is black."""
    import numpy as np

    table = np.zeros((256, 3), np.uint8)
    table[: len(PALETTE)] = PALETTE
    return table[label]
