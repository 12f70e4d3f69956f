"""Depth of a single picture, from the best that is known of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.alone import depth_from_picture
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import Camera
from weather_aug.taxonomy import IGNORE

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
DepthOf = Callable[[UInt8], Float32]
"""(H, W, 3) uint8 RGB → (H, W) float32 z-depth in metres."""

_warned = False


class GuessedDepthWarning(UserWarning):
    """Depth was guessed from pictures alone; said once in a process."""


@dataclass(frozen=True)
class DepthSource:
    """Where depth comes from that the caller did not give.

    Convention:
        The first that there is: the cache, the network (which then fills the cache), the geometric
        prior of the label, the picture alone (with a warning, once in a process).
    """

    cache: str | None = None
    """Folder of depths by the picture's content; made on first use."""
    network: str | DepthOf | None = None
    """A folder or name of a `depth-estimation` model of transformers, or any function."""

    def depth_m(
        self, image: UInt8, label: UInt8 | None, camera: Camera, camera_height_m: float
    ) -> Float32:
        """(H, W) float32 z-depth in metres, `inf` in the sky.

        Args:
            image: (H, W, 3) uint8 RGB.
            label: (H, W) uint8 train ids, 255 ignored; None where nobody labelled.
            camera: Of the picture's size.
            camera_height_m: Height of the camera over the ground, metres.
        """
        return _guessed(image, label, camera, camera_height_m)


def _guessed(image: UInt8, label: UInt8 | None, camera: Camera, camera_height_m: float) -> Float32:
    """From the label, or from the picture alone where there is none or it ignores everything."""
    if label is not None and (label != IGNORE).any():
        return geometric_prior_depth(
            label,
            focal_px=camera.focal_px[1],
            principal_px=camera.principal_px,
            camera_height_m=camera_height_m,
        )
    _warn_once()
    return depth_from_picture(
        image,
        focal_px=camera.focal_px[1],
        principal_px=camera.principal_px,
        camera_height_m=camera_height_m,
    )


def _warn_once() -> None:
    global _warned
    if _warned:
        return
    _warned = True
    warnings.warn(
        "depth is guessed from pictures alone (flat ground, upright things), since there is "
        "neither depth nor mask; give depth=, masks, depth_cache= or depth_network= for better "
        "weather",
        GuessedDepthWarning,
        stacklevel=4,
    )
