"""Depth of pictures that were seen before, in a folder, found by the pictures' content.

Convention:
    The depth of a picture lies at `ab/abcdef….npy`, named by the SHA-256 of its shape and bytes: a
    float16 array (H, W) of metres, `inf` in the sky. A file is written whole, so any number of
    workers may share a folder. What made the depth is not a part of the name: take one folder for
    one network and one camera.
"""

from __future__ import annotations

import hashlib
import io
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8, like_image
from weather_aug._files import reported, write_whole
from weather_aug.clip.types import FAR_DEPTH_M
from weather_aug.errors import ArgumentError, DataError, printable

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

LEAST_DEPTH_M = 0.01
_ACCEPTED = (np.dtype("<f2"), np.dtype("<f4"))


@dataclass(frozen=True)
class DepthCache:
    """A folder of depths; see the module's Convention."""

    folder: str | os.PathLike[str]
    """Made on first use."""

    def path_of(self, image: UInt8) -> Path:
        """Where the depth of a picture (H, W, 3) uint8 lies, or would."""
        image = image_uint8("image", image)
        digest = hashlib.sha256(np.array(image.shape, "<i8").tobytes())
        digest.update(image.data)
        name = digest.hexdigest()
        return Path(self.folder) / name[:2] / f"{name}.npy"

    def get(self, image: UInt8) -> Float32 | None:
        """Depth (H, W) float32 metres of a picture, `inf` in the sky; None if there is none yet.

        Raises:
            DataError: If the file is damaged, or is no depth of a picture of this shape.
        """
        path = self.path_of(image)
        try:
            with path.open("rb") as file:
                depth = _read(file, image.shape[:2])
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise DataError(
                f"{printable(path, 300)} is no depth that can be used: {printable(error, 200)}; "
                "delete it, and it is found anew"
            ) from None
        return depth

    def put(self, image: UInt8, depth_m: NDArray[np.floating]) -> Float32:
        """Store the depth of a picture, and return it as `get` will.

        Args:
            image: (H, W, 3) uint8 RGB.
            depth_m: (H, W) metres, above 0, `inf` in the sky.

        Raises:
            ArgumentError: If depth has another shape, or is NaN or not above 0 somewhere.
            OutputError: If the folder cannot be written.
        """
        path = self.path_of(image)
        depth_m = np.asarray(depth_m)
        like_image("depth_m", depth_m, image.shape[:2])
        if depth_m.dtype.kind != "f" or not (depth_m > 0).all():
            raise ArgumentError("depth_m must be floats above 0 everywhere, inf in the sky")
        near = np.where(depth_m < FAR_DEPTH_M, depth_m, np.inf)
        stored = np.maximum(near, LEAST_DEPTH_M).astype("<f2")
        with reported(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            # A name of its own, because another worker may write the same picture's depth.
            beside = path.with_name(f"{path.stem}.{secrets.token_hex(8)}")
            write_whole(beside, _header(stored) + stored.tobytes())
            beside.replace(path)
        return stored.astype(np.float32)


def _header(array: NDArray[np.generic]) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, np.lib.format.header_data_from_array_1_0(array))
    return buffer.getvalue()


def _read(file: BinaryIO, shape: tuple[int, ...]) -> Float32:
    """Values of a .npy file, whose header is believed only where it says what is expected."""
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("not a .npy file of version 1.0")
    found, in_columns, dtype = np.lib.format.read_array_header_1_0(file)
    if found != shape or in_columns or dtype not in _ACCEPTED:
        order = "column by column" if in_columns else "row by row"
        raise ValueError(f"it holds {dtype} {found} {order}, not float16 {shape} row by row")
    size = int(np.prod(shape)) * dtype.itemsize
    values = file.read(size + 1)
    if len(values) != size:
        raise ValueError(f"it should hold {size} bytes of values, and holds fewer or more")
    depth = np.frombuffer(values, dtype).reshape(shape).astype(np.float32)
    if not (depth > 0).all():
        raise ValueError("a depth is NaN or not above 0")
    return depth
