"""Depth of a single picture, from the best that is known of it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import like_image
from weather_aug.clip.alone import depth_from_picture
from weather_aug.clip.depth_cache import DepthCache
from weather_aug.clip.depth_network import DepthNetwork
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import IGNORE

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
DepthOf = Callable[[UInt8], Float32]
"""(H, W, 3) uint8 RGB → (H, W) float32 z-depth in metres."""

LEAST_KNOWN_SHARE = 0.5

_warned = False


class GuessedDepthWarning(UserWarning):
    """Depth was guessed from pictures alone; said once in a process."""


@dataclass(frozen=True)
class DepthSource:
    """Where depth comes from that the caller did not give.

    Convention:
        The first that there is: the cache, the network (which then fills the cache), the geometric
        prior of the label, the picture alone (with a warning, once in a process).

    Raises:
        ArgumentError: If `network` is no name, network or function, or `cache` no path.
    """

    cache: str | None = None
    """Folder of depths by the picture's content, see `depth_cache`; made on first use. It holds
    what one network makes of one camera's pictures."""
    network: str | DepthNetwork | DepthOf | None = None
    """A folder or name of a `depth-estimation` model of transformers, see `DepthNetwork`; or any
    function from picture to depth (metres; NaN, 0 and less unknown, `inf` sky)."""

    def __post_init__(self) -> None:
        try:
            cache = None if self.cache is None else str(os.fspath(self.cache))
        except TypeError:
            raise ArgumentError(
                f"depth_cache must be a folder, got {type(self.cache).__name__}"
            ) from None
        network: Any = self.network
        if isinstance(network, os.PathLike):
            network = str(os.fspath(network))
        if not (network is None or isinstance(network, str | DepthNetwork) or callable(network)):
            raise ArgumentError(
                "depth_network must be the folder or name of a model, or a function from picture "
                f"to depth, got {type(network).__name__}"
            )
        object.__setattr__(self, "cache", cache)
        object.__setattr__(self, "network", network)

    def depth_m(
        self, image: UInt8, label: UInt8 | None, camera: Camera, camera_height_m: float
    ) -> Float32:
        """(H, W) float32 z-depth in metres, above 0, `inf` in the sky.

        Args:
            image: (H, W, 3) uint8 RGB.
            label: (H, W) uint8 train ids, 255 ignored; None where nobody labelled.
            camera: Of the picture's size.
            camera_height_m: Height of the camera over the ground, metres.

        Raises:
            ArgumentError: If a function of the caller gives no depth of the picture, or mostly
                unknown depth, or the picture is no picture for a network.
            DataError: If a file of the cache or of the network cannot be used.
            MissingExtraError: If a network is named and transformers are not installed.
            OutputError: If the cache cannot be written.
        """
        cache = None if self.cache is None else DepthCache(self.cache)
        stored = None if cache is None else cache.get(image)
        if stored is not None:
            return stored
        network = DepthNetwork(self.network) if isinstance(self.network, str) else self.network
        if network is None:
            return _guessed(image, label, camera, camera_height_m)
        if isinstance(network, DepthNetwork):
            found = network.depth_m(image, label, camera, camera_height_m)
        else:
            found = _checked(network(image), image.shape[:2])
        return found if cache is None else cache.put(image, found)


def _checked(depth: Any, shape: tuple[int, int]) -> Float32:
    """What a caller's function gives, unknown depth as far; refused if it is mostly unknown."""
    depth = np.asarray(depth)
    like_image("the depth of depth_network", depth, shape)
    if depth.dtype.kind != "f":
        raise ArgumentError(f"depth_network must give float metres, got {depth.dtype}")
    known = depth > 0
    share = np.count_nonzero(known) / known.size
    if share < LEAST_KNOWN_SHARE:
        raise ArgumentError(
            f"depth_network knows the depth (above 0, inf in the sky) of {share:.0%} of the pixels "
            "only; complete it first"
        )
    with np.errstate(over="ignore"):
        return np.where(known, depth, np.inf).astype(np.float32)


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
