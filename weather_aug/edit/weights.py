"""Weights that come from elsewhere: where they lie on this machine, and what to do if they do not.

Nothing here touches the network: a folder is a folder, and the id of a model is looked up in the
local cache of huggingface_hub alone.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from weather_aug._extras import require
from weather_aug.errors import DataError, printable

LICENCES = {
    "stabilityai/sd-turbo": "Stability AI Community License, https://stability.ai/license",
    "timbrooks/instruct-pix2pix": "MIT",
    "stable-diffusion-v1-5/stable-diffusion-v1-5": "CreativeML OpenRAIL-M",
    "lllyasviel/sd-controlnet-seg": "OpenRAIL",
    "lllyasviel/sd-controlnet-canny": "OpenRAIL",
    "lllyasviel/sd-controlnet-depth": "OpenRAIL",
}
"""Licence of each model that an editor asks for, as its card states it."""
UNKNOWN_LICENCE = "see its model card"
MODEL_INDEX = "model_index.json"
READ = (".json", ".txt", ".safetensors")
"""Endings of the files of a model folder that are read; pickles never are."""

_MODEL_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_VARIANT = re.compile(r"\.(fp16|bf16|non_ema|ema_only)\b")


def located(
    base: str | Path,
    *,
    to: str,
    what: str = "weights",
    needs: Iterable[str] = (MODEL_INDEX,),
) -> Path:
    """The folder of a model: itself, or the local cache's snapshot of a model id.

    Args:
        base: A folder, or the id of a model ("owner/name") that was fetched before.
        to: What it is needed for, an infinitive such as "edit with InstructPix2Pix".
        what: What the weights are, such as "the one-step diffusion model".
        needs: Files the folder must hold, relative to it.

    Raises:
        DataError: If nothing is there, or a file is missing from it; it says how to get the model.
        MissingExtraError: If a model id is to be looked up and huggingface_hub is not installed.
    """
    name, needs = str(base), tuple(needs)
    folder = Path(base)
    if not folder.is_dir():
        if not is_model_id(name):
            raise DataError(
                f"{printable(name)} is no folder, and no model id such as owner/name; "
                f"give a folder with {what} in it, or use editor='physical', which needs none"
            )
        folder = _cached(name, to, what)
        if not all((folder / path).is_file() for path in needs):
            raise missing_weights(name, licence_of(name), what)
    for path in needs:
        if not (folder / path).is_file():
            raise DataError(
                f"{printable(folder)}: no {path} in it, so it does not hold {what}; give the "
                "folder of a model in the diffusers layout"
            )
    return folder


def is_model_id(name: str) -> bool:
    """Whether a text has the form of a model's id, "owner/name"."""
    return _MODEL_ID.fullmatch(name) is not None and ".." not in name


def licence_of(model_id: str) -> str:
    """Licence of a model as its card states it, or where to read it."""
    return LICENCES.get(model_id, UNKNOWN_LICENCE)


def missing_weights(model_id: str, licence: str, what: str) -> DataError:
    """The error for weights that are not on this machine, in one sentence.

    Args:
        model_id: Such as "stabilityai/sd-turbo".
        licence: As the model's card states it.
        what: What the weights are, such as "the one-step diffusion model".
    """
    shown = printable(model_id)
    folder = shown.rsplit("/", 1)[-1]
    return DataError(
        f"{what} {shown} (licence: {licence}) is not on this machine; fetch it with "
        f"`hf download {shown} --local-dir {folder}` and give that folder, or use "
        "editor='physical', which needs no weights"
    )


def digest_of(folder: Path, parts: Iterable[str] = ("",)) -> str:
    """BLAKE2b, 32 hex digits, of what is read of a model: names and bytes.

    Args:
        folder: Of the model.
        parts: Subfolders of it that are read, such as "unet"; "" is the folder itself. Files of
            other precisions (*.fp16.*) and of types that are never read do not count.

    Raises:
        DataError: If a part holds no file that could be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in sorted(parts):
        paths = sorted(path for path in (folder / part).glob("*") if _is_read(path))
        if not paths:
            raise DataError(f"{printable(folder / part)}: nothing to read ({', '.join(READ)})")
        for path in paths:
            digest.update(f"{part}/{path.name}\0{path.stat().st_size}\0".encode())
            with path.open("rb") as file:
                while block := file.read(1 << 22):
                    digest.update(block)
    return digest.hexdigest()


def _is_read(path: Path) -> bool:
    return path.is_file() and path.suffix in READ and not _VARIANT.search(path.name)


def _cached(model_id: str, to: str, what: str) -> Path:
    hub = require("huggingface_hub", extra="edit", to=to)
    errors = require("huggingface_hub.errors", extra="edit", to=to)
    try:
        return Path(hub.snapshot_download(model_id, local_files_only=True))
    except (errors.LocalEntryNotFoundError, errors.HFValidationError) as error:
        raise missing_weights(model_id, licence_of(model_id), what) from error


@contextmanager
def readable(folder: Path) -> Iterator[None]:
    """What the libraries raise on files that are not theirs, as one typed sentence.

    Raises:
        DataError: If anything goes wrong within the block.
    """
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        raise DataError(
            f"{printable(folder, 200)} is no model that can be read: "
            f"{type(error).__name__} {printable(error, 300)}"
        ) from error
