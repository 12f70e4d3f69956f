"""Arrays as files: one header that is written and read, and values that stay on the disk."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import SceneError, printable


def npy_bytes(array: NDArray[Any], dtype: str) -> bytes:
    """What numpy writes for a C-ordered array of `dtype`, header and values."""
    return _header(dtype, array.shape) + np.ascontiguousarray(array, dtype).tobytes()


def mapped(path: Path, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """A file that `npy_bytes` wrote, memory-mapped and read-only.

    Raises:
        SceneError: If it cannot be read, or holds another type or shape or too few values.
    """
    header = _header(dtype, shape)
    try:
        with path.open("rb") as file:
            start = file.read(len(header))
            # Nothing can be mapped of an array without values.
            if start == header and 0 in shape:
                return np.zeros(shape, dtype)
        array = np.memmap(path, dtype, "r", len(header), shape) if start == header else None
    except (OSError, ValueError) as error:
        raise SceneError(f"{printable(path, 200)} cannot be read: {printable(error)}") from None
    if array is None:
        raise SceneError(
            f"{printable(path, 200)} is not a {dtype} array of shape {shape}; build the scene again"
        )
    return np.asarray(array)


def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """The only header that is written and read: numpy's parser runs a tokenizer over the text."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + text.ljust(117).encode() + b"\n"
