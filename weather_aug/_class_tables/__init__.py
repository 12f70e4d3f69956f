"""Class tables by name, the other names they answer to, and the names that say too little."""

from __future__ import annotations

from weather_aug._class_tables.camvid import CAMVID_11, CAMVID_32
from weather_aug._class_tables.cityscapes import BDD100K_RAW, CITYSCAPES, KITTI360, TRAIN_IDS
from weather_aug._class_tables.mapillary import MAPILLARY_V1_2, MAPILLARY_V2_0
from weather_aug._class_tables.nuscenes import NUIMAGES, NUSCENES_LIDARSEG
from weather_aug._class_tables.pandaset import PANDASET
from weather_aug._class_tables.waymo import WAYMO

TABLES = {
    "train_ids": TRAIN_IDS,
    "cityscapes": CITYSCAPES,
    "kitti360": KITTI360,
    "bdd100k": TRAIN_IDS,
    "bdd100k_raw": BDD100K_RAW,
    "waymo": WAYMO,
    "pandaset": PANDASET,
    "nuscenes_lidarseg": NUSCENES_LIDARSEG,
    "nuimages": NUIMAGES,
    "camvid11": CAMVID_11,
    "camvid32": CAMVID_32,
    "mapillary_v1.2": MAPILLARY_V1_2,
    "mapillary_v2.0": MAPILLARY_V2_0,
}

ALIASES = {
    "cityscapes_train_ids": "train_ids",
    "cityscapes_label_ids": "cityscapes",
    "acdc_train_ids": "train_ids",
    "acdc_label_ids": "cityscapes",
    "muses_train_ids": "train_ids",
    "muses_label_ids": "cityscapes",
    "bdd": "bdd100k",
    "bdd10k": "bdd100k",
    "bdd100k_train_ids": "bdd100k",
    "bdd_raw": "bdd100k_raw",
    "waymo_camera": "waymo",
    "panda": "pandaset",
    "lidarseg": "nuscenes_lidarseg",
    "mapillary_v1": "mapillary_v1.2",
    "mapillary_v2": "mapillary_v2.0",
    "mapillary_vistas_v1.2": "mapillary_v1.2",
    "mapillary_vistas_v2.0": "mapillary_v2.0",
}

# Ids of one table are ids of the other as well, so a wrong guess would go unnoticed.
_TWO_KINDS = "files that end in labelTrainIds are {0}_train_ids, in labelIds {0}_label_ids"
AMBIGUOUS = {
    "acdc": _TWO_KINDS.format("acdc"),
    "muses": _TWO_KINDS.format("muses"),
    "nuscenes": "points are nuscenes_lidarseg, pictures are nuimages",
    "camvid": "merged classes are camvid11, all of them camvid32",
    "mapillary": "66 classes are mapillary_v1.2, 124 are mapillary_v2.0",
    "mapillary_vistas": "66 classes are mapillary_v1.2, 124 are mapillary_v2.0",
}
