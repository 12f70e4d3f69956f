"""A red car that drives ahead on the street of boxes, with its tracked box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from box_street import FACADES, BoxStreet

from weather_aug.clip.types import Box, Frame, FrameKey
from weather_aug.taxonomy import TRAIN_ID

CAR, PARKED = 7, 8
SIZE_M = (4.4, 1.8, 1.6)
RED, BLUE = (230, 20, 20), (20, 20, 230)


def frames(count: int = 6, speed_m: float = 7.0, labelled: bool = True) -> list[Frame]:
    """The car goes `speed_m` a frame along x = 12 + …, y = 1; another stands at x = 20, y = 5."""
    return [_frame(t, speed_m, labelled) for t in range(count)]


def _frame(time_index: int, speed_m: float, labelled: bool) -> Frame:
    centres = {CAR: (12.0 + speed_m * time_index, 1.0, 0.9), PARKED: (20.0, 5.0, 0.9)}
    ranges = {
        track: tuple((c - s / 2, c + s / 2) for c, s in zip(centre, SIZE_M, strict=True))
        for track, centre in centres.items()
    }
    # A class of its own tells the moving car from the parked one, only here.
    hulls = ((TRAIN_ID["car"], *ranges[CAR]), (TRAIN_ID["bus"], *ranges[PARKED]))
    frame = BoxStreet(boxes=(*FACADES, *hulls)).frame(FrameKey(time_index, "front"))
    assert frame.label is not None
    image = frame.image.copy()
    image[frame.label == TRAIN_ID["car"]] = RED
    image[frame.label == TRAIN_ID["bus"]] = BLUE
    boxes = []
    for track, centre in centres.items():
        pose = np.eye(4)
        pose[:3, 3] = centre
        boxes.append(Box(track, "Car", pose, SIZE_M))
    label = frame.label if labelled else None
    return replace(frame, image=image, label=label, boxes=tuple(boxes))
