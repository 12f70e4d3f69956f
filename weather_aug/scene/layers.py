"""What the editor knows of a frame, kept beside its picture.

    frames/000012_front.layers.npy      (20, h, w) float16 maps of `edit.physical.layers.NAMES`
    frames/000012_front.small.npy       (h', w', 3) uint8 sRGB, the picture at most 256 px wide
    frames/000012_front.classes.npy     (H, W) uint8 train ids, where they are not the label's

The few numbers beside the maps stand in the manifest. A scene of before all this was stored has
none of it; its frames are then looked at when they are rendered, to the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Frame
from weather_aug.edit.physical.layers import NAMES, Layers, layers_of, thumbnail_shape
from weather_aug.edit.physical.mirror_seen import Seen
from weather_aug.edit.physical.site import STEEPEST_SLOPE, Site, site_of
from weather_aug.errors import SceneError, printable
from weather_aug.scene.arrays import mapped, npy_bytes
from weather_aug.scene.route import part_near

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

LARGEST = 4096.0
"""No layer of a picture is greater; kernels take no number that is."""
LARGEST_UP_M = 1e11
MOST_TINT = 10.0
PARTS = ("layers", "small", "classes")
_MAPS, _BYTES = "<f2", "|u1"
_SIGNLESS = np.uint16(0x7FFF)
_LARGEST_BITS = int(np.float16(LARGEST).view(np.uint16))


class Street(NamedTuple):
    """What a frame's layers need to know of its drive."""

    axes_world: Float64
    """(3, 3), rows along the street, to its left, up."""
    camera_height_m: float
    """Over the road."""
    route: Float64 | None
    """Of the camera, as `route_of` gives it."""


@dataclass(frozen=True, eq=False)
class LayersRecord:
    """What the manifest says of a frame's layers."""

    step: int
    """Pixels of a cell."""
    tint: Float32
    """(3,)."""
    plane: Float64
    """(3,) of the road in street axes."""
    illumination: float


def layers_seen(
    frame: Frame, street: Street, mirrored: Callable[[Site], Seen] | None = None
) -> Layers:
    """Look at a frame of a drive, or of none.

    Args:
        frame: With depth.
        street: What its drive knows.
        mirrored: Renders the street's mirror image in a site's road, as `geometry.seen_in_road`
            does; None where the drive is not reconstructed.
    """
    site = site_of(frame, street.axes_world, street.camera_height_m)
    route = street.route
    return layers_of(
        site,
        None if route is None else part_near(route, site.origin[:2]),
        None if mirrored is None else mirrored(site),
    )


def encode_layers(frame: Frame, layers: Layers) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The manifest's entry for a frame's layers, as JSON values, and the bytes of each part.

    Raises:
        SceneError: If a layer holds what is no number, or one that no picture gives.
    """
    if not _in_range(layers.maps):
        raise SceneError(
            f"frame {frame.key}: its surfaces cannot be told (a layer is not finite, or beyond "
            f"{LARGEST:g}); repair its depth or calibration"
        )
    entry = {
        "step": int(layers.step),
        "tint": layers.tint.tolist(),
        "plane": layers.plane.tolist(),
        "illumination": layers.illumination,
    }
    parts = {
        "layers": npy_bytes(layers.maps, _MAPS),
        "small": npy_bytes(layers.thumbnail, _BYTES),
    }
    if frame.label is None or not np.array_equal(frame.label, layers.classes):
        parts["classes"] = npy_bytes(layers.classes, _BYTES)
    return entry, parts


def parse_layers(entry: Any) -> LayersRecord:
    """A record from the manifest's entry; whatever is malformed raises ValueError or TypeError."""
    step = entry["step"]
    if isinstance(step, bool) or step != int(step) or step < 1:
        raise ValueError("the step of layers must be a whole number of pixels")
    tint = _numbers(entry["tint"], MOST_TINT).astype(np.float32)
    plane = _numbers(entry["plane"], LARGEST_UP_M)
    if np.abs(plane[1:]).max() > STEEPEST_SLOPE:
        raise ValueError("the road's plane is too steep")
    illumination = float(entry["illumination"])
    if not 0 <= illumination <= LARGEST:
        raise ValueError("illumination is out of its range")
    for array in (tint, plane):
        array.flags.writeable = False
    return LayersRecord(int(step), tint, plane, illumination)


def read_layers(
    record: LayersRecord, camera: Camera, label: UInt8 | None, paths: dict[str, Path]
) -> Layers:
    """A frame's layers, memory-mapped.

    Args:
        record: Of the manifest.
        camera: Of the frame.
        label: (H, W) train ids of the frame; they are the classes where no file holds others.
        paths: Files by name of the part.

    Raises:
        SceneError: If a file cannot be read, or holds another type, shape or range.
    """
    height, width = camera.height, camera.width
    shape = (len(NAMES), -(-height // record.step), -(-width // record.step))
    maps = mapped(paths["layers"], _MAPS, shape)
    if not _in_range(maps):
        raise SceneError(
            f"{printable(paths['layers'], 200)} holds a number that is not finite, or beyond "
            f"{LARGEST:g}; build the scene again"
        )
    small = mapped(paths["small"], _BYTES, (*thumbnail_shape(height, width), 3))
    if "classes" in paths:
        label = mapped(paths["classes"], _BYTES, (height, width))
    assert label is not None
    return Layers(
        float(record.step), maps, record.tint, record.plane, label, record.illumination, small
    )


def _in_range(maps: NDArray[np.float16]) -> bool:
    """Whether all values are numbers in the range of layers.

    By their bits, which are ordered like the numbers; NaN and infinity are above all of them.
    """
    return int((maps.view(np.uint16) & _SIGNLESS).max()) <= _LARGEST_BITS


def _numbers(value: Any, most: float) -> Float64:
    numbers = np.array(value, np.float64)
    if numbers.shape != (3,) or not (np.abs(numbers) <= most).all():
        raise ValueError(f"expected three numbers up to {most:g}")
    return numbers
