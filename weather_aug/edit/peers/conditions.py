"""What a ControlNet is shown of a frame, as a picture: classes in colours, edges, or nearness.

| condition  | picture                                          | published ControlNet that fits |
|------------|--------------------------------------------------|--------------------------------|
| ade20k     | the label in the colours of ADE20K's 150 classes | lllyasviel/sd-controlnet-seg   |
| cityscapes | the label in Cityscapes' colours                 | none; for one that you trained |
| canny      | white edges of the picture (Canny, 100 and 200)  | lllyasviel/sd-controlnet-canny |
| depth      | inverse depth, near is white (MiDaS' convention) | lllyasviel/sd-controlnet-depth |

The published ones belong to Stable Diffusion 1.5. Each understands its own kind of picture only.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame
from weather_aug.edit.peers.pictures import edited_size, fitted, mirrored
from weather_aug.errors import DataError
from weather_aug.taxonomy import CLASSES, IGNORE, PALETTE, TRAIN_ID

UInt8 = NDArray[np.uint8]

PUBLISHED = {
    "ade20k": "lllyasviel/sd-controlnet-seg",
    "canny": "lllyasviel/sd-controlnet-canny",
    "depth": "lllyasviel/sd-controlnet-depth",
}
"""ControlNets of Stable Diffusion 1.5, by condition."""
ADE20K = {
    "road": (140, 140, 140),
    "sidewalk": (235, 255, 7),
    "building": (180, 120, 120),
    "wall": (120, 120, 120),
    "fence": (255, 184, 6),
    "pole": (51, 0, 255),
    "traffic light": (41, 0, 255),
    "traffic sign": (255, 5, 153),  # signboard
    "vegetation": (4, 200, 3),  # tree
    "terrain": (4, 250, 7),  # grass
    "sky": (6, 230, 230),
    "person": (150, 5, 61),
    "rider": (150, 5, 61),  # person
    "car": (0, 102, 200),
    "truck": (255, 0, 20),
    "bus": (255, 0, 245),
    "train": (255, 0, 245),  # ADE20K has none; a bus is the nearest
    "motorcycle": (163, 0, 255),  # minibike
    "bicycle": (255, 245, 0),
}
"""Colour of the class of ADE20K that comes nearest, by train class."""
CANNY_LEVELS = (100, 200)
"""Thresholds of the model card's example."""


def condition_of(frame: Frame, kind: str, rows: int | None) -> UInt8:
    """The condition picture of a frame, of the fitted picture's size.

    Args:
        frame: With a label for "ade20k" and "cityscapes", with depth for "depth".
        kind: One of `options.CONDITIONS`.
        rows: Height at which the picture is edited, None for its own.

    Returns:
        (H', W', 3) RGB; black where nothing is known.

    Raises:
        DataError: If the frame lacks what is to be shown.
    """
    if kind == "canny":
        return canny(fitted(frame.image, rows))
    if kind == "depth":
        return mirrored(nearness(frame, rows))
    if frame.label is None:
        raise DataError(
            f"frame {frame.key} has no label, which a ControlNet on {kind} colours is shown; label "
            f"the clip, or take condition='canny' with {PUBLISHED['canny']}"
        )
    height, width = edited_size(frame.label.shape, rows)
    label = np.asarray(frame.label, np.uint8)
    if label.shape != (height, width):
        kind_of = cv2.INTER_NEAREST_EXACT
        label = np.asarray(cv2.resize(label, (width, height), interpolation=kind_of), np.uint8)
    return mirrored(palette_of(kind)[label])


def palette_of(kind: str) -> UInt8:
    """(256, 3) colour of each train id, black for those that are none."""
    table = np.zeros((IGNORE + 1, 3), np.uint8)
    if kind == "cityscapes":
        table[: len(PALETTE)] = PALETTE
        return table
    for name in CLASSES:
        table[TRAIN_ID[name]] = ADE20K[name]
    return table


def canny(image: UInt8) -> UInt8:
    """White edges (H, W, 3) of a picture."""
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), *CANNY_LEVELS)
    return np.repeat(np.asarray(edges, np.uint8)[..., None], 3, axis=2)


def nearness(frame: Frame, rows: int | None) -> UInt8:
    """Inverse depth (H, W, 3), 255 at the nearest surface and 0 in the sky.

    Raises:
        DataError: If the frame has no depth, or no surface has any.
    """
    if frame.depth_m is None:
        raise DataError(
            f"frame {frame.key} has no depth, which a ControlNet on depth is shown; open the clip "
            "with its depth, or take condition='canny'"
        )
    depth_m = np.asarray(frame.depth_m, np.float32)
    with np.errstate(divide="ignore"):
        inverse = np.where(np.isfinite(depth_m) & (depth_m > 0), 1 / depth_m, 0).astype(np.float32)
    nearest = float(inverse.max())
    if not nearest > 0:
        raise DataError(f"frame {frame.key}: its depth shows no surface; take condition='canny'")
    height, width = edited_size(depth_m.shape, rows)
    scaled = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_AREA)
    level = np.round(255 / nearest * np.asarray(scaled)).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=2)
