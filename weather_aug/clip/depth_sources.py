"""Depth of a single picture, from the best that is known of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import Camera

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
DepthOf = Callable[[UInt8], Float32]
"""(H, W, 3) uint8 RGB → (H, W) float32 z-depth in metres."""


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
        assert label is not None
        return geometric_prior_depth(
            label,
            focal_px=camera.focal_px[1],
            principal_px=camera.principal_px,
            camera_height_m=camera_height_m,
        )
