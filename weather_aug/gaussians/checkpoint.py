"""A fit's state on disk, so that work that was cut short goes on to the bit."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from weather_aug import _files
from weather_aug.errors import DataError, printable

NAME = "fit.npz"
HEAD = "head"


def save(folder: Path, head: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
    """Write `state` in place of the last one; a crash leaves one of the two.

    Args:
        folder: Made if it is missing.
        head: JSON values that say which fit it is of, and how far.
        state: Tensors by name.

    Raises:
        OutputError: If the folder cannot be written.
    """
    with _files.reported(folder):
        folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {name: value.numpy() for name, value in state.items()}
    arrays[HEAD] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    _files.write_whole(folder / NAME, buffer.getvalue())


def load(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """The last head and state; None where there is none.

    Raises:
        DataError: If the file is damaged.
    """
    path = folder / NAME
    if not path.exists():
        return None
    try:
        # numpy leaves a file open that it opened itself and could not read.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            state = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name != HEAD}
            return json.loads(arrays[HEAD].tobytes()), state
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(
            f"{printable(path, 200)} is damaged ({printable(error)}); remove it to start the fit "
            "anew"
        ) from None
