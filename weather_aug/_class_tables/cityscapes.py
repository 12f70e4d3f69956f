"""Cityscapes and the data sets that took over its classes: KITTI-360 and BDD100K."""

from __future__ import annotations

from weather_aug._class_tables.table import CLASSES, ClassTable, as_named, numbered

TRAIN_IDS = ClassTable(numbered(CLASSES) | {255: "unlabeled"}, as_named())

_FIRST_IDS = numbered(
    (
        "unlabeled",
        "ego vehicle",
        "rectification border",
        "out of roi",
        "static",
        "dynamic",
        "ground",
        "road",
        "sidewalk",
        "parking",
        "rail track",
        "building",
        "wall",
        "fence",
        "guard rail",
        "bridge",
        "tunnel",
        "pole",
        "polegroup",
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
        "caravan",
        "trailer",
        "train",
        "motorcycle",
        "bicycle",
    )
)

# Licence plates have id -1, which 8-bit pictures hold as 255 and GTA5, in these ids, as 34.
CITYSCAPES = ClassTable(_FIRST_IDS | dict.fromkeys((34, 255), "license plate"), as_named())

KITTI360 = ClassTable(
    _FIRST_IDS
    | numbered(
        (
            "garage",
            "gate",
            "stop",
            "smallpole",
            "lamp",
            "trash bin",
            "vending machine",
            "box",
            "unknown construction",
            "unknown vehicle",
            "unknown object",
        ),
        34,
    )
    | {255: "license plate"},
    as_named() | {"garage": "building", "gate": "fence", "smallpole": "pole"},
)

BDD100K_RAW = ClassTable(
    numbered(
        (
            "unlabeled",
            "dynamic",
            "ego vehicle",
            "ground",
            "static",
            "parking",
            "rail track",
            "road",
            "sidewalk",
            "bridge",
            "building",
            "fence",
            "garage",
            "guard rail",
            "tunnel",
            "wall",
            "banner",
            "billboard",
            "lane divider",
            "parking sign",
            "pole",
            "polegroup",
            "street light",
            "traffic cone",
            "traffic device",
            "traffic light",
            "traffic sign",
            "traffic sign frame",
            "terrain",
            "vegetation",
            "sky",
            "person",
            "rider",
            "bicycle",
            "bus",
            "car",
            "caravan",
            "motorcycle",
            "trailer",
            "train",
            "truck",
        )
    ),
    as_named(),
)
