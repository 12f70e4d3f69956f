"""An adapter on disk: its tensors, and a card that seals them.

Files:
    adapter.safetensors: every trained tensor by its name in `AdaptedModel`, float32.
    card.json: spec, base (id, revision, digest), licence, how it was trained, and the size and
        digest of the tensors; written last.
    trained_on.txt: digests of all pictures it was trained on, where training wrote it; the card
        has its SHA-256.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from weather_aug import _files
from weather_aug._extras import require
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.base import TO, Base
from weather_aug.edit.diffusion.leakage import TRAINED_ON, TrainedOn
from weather_aug.edit.diffusion.spec import AdapterSpec, parse_spec
from weather_aug.errors import ArgumentError, DataError, IntegrityError, printable

FORMAT = "weather_aug adapter"
VERSION = 1
WEIGHTS, CARD = "adapter.safetensors", "card.json"
TRAINED_ON_SHA256 = "trained_on_sha256"
"""Of the record, among what a card says of the training."""
DEFAULT_LICENCE = "that of the base model, and of the pictures that it was trained on"


@dataclass(frozen=True, eq=False)
class Card:
    """What an adapter says of itself."""

    spec: AdapterSpec
    base: str
    base_revision: str
    base_digest: str
    sha256: str
    """Of the weights."""
    licence: str = DEFAULT_LICENCE
    training: Mapping[str, Any] = field(default_factory=dict)
    """JSON values: objective, options, steps, counts of pictures."""


def save_adapter(
    model: AdaptedModel,
    folder: Path,
    *,
    licence: str = DEFAULT_LICENCE,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write an adapter; the card comes last, so what is cut short is no adapter.

    Args:
        model: Whose trained tensors are kept.
        folder: To write to; made if it is not there.
        licence: Under which it may be used.
        training: JSON values for whoever reads the card.

    Raises:
        OutputError: If the folder cannot be written.
    """
    from safetensors.torch import save

    tensors = {
        name: parameter.detach().to("cpu", torch.float32).contiguous()
        for name, parameter in model.trained().items()
    }
    data = save(tensors)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "spec": model.spec.as_json(),
        "base": model.base.name,
        "base_revision": model.base.revision,
        "base_digest": model.base.digest,
        "licence": licence,
        "training": dict(training or {}),
        "weights": {"size": len(data), "sha256": _files.sha256_of(data)},
    }
    with _files.reported(folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CARD).unlink(missing_ok=True)
    _files.write_whole(folder / WEIGHTS, data)
    _files.write_whole(folder / CARD, (json.dumps(content, indent=1) + "\n").encode())


def read_card(folder: Path) -> Card:
    """What an adapter says of itself; its weights are not read.

    Raises:
        DataError: If the folder holds no adapter that this version reads.
    """
    path = folder / CARD
    if not path.is_file():
        raise DataError(
            f"{printable(folder, 200)} is no adapter (no {CARD}); train one with `weather-aug "
            "train-editor PAIRS --base MODEL --out ADAPTER`"
        )
    content = _files.read_json(path)
    try:
        if content["format"] != FORMAT:
            raise DataError(f"{printable(path, 200)} is not of a {FORMAT}")
        if content["version"] != VERSION:
            raise DataError(
                f"{printable(path, 200)} has version {printable(content['version'])}, this program "
                f"reads version {VERSION}; update weather_aug or train the adapter again"
            )
        return Card(
            spec=parse_spec(content["spec"]),
            base=str(content["base"]),
            base_revision=str(content["base_revision"]),
            base_digest=str(content["base_digest"]),
            sha256=str(content["weights"]["sha256"]),
            licence=str(content["licence"]),
            training=dict(content["training"]),
        )
    except DataError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{printable(path, 200)} is malformed: {type(error).__name__} {printable(error)}"
        ) from None


def read_trained_on(folder: Path, card: Card) -> TrainedOn | None:
    """What an adapter was trained on; None where nobody recorded it.

    Raises:
        DataError: If the record is malformed, or the card names one and it is not there.
        IntegrityError: If it is another one than the card names.
    """
    path, sha256 = folder / TRAINED_ON, card.training.get(TRAINED_ON_SHA256)
    if path.exists():
        return TrainedOn.read_file(path, sha256)
    if sha256 is None:
        return None
    raise DataError(
        f"{printable(path, 200)} is missing, which tells what the adapter was trained on; get it "
        "from where the adapter is from"
    )


def load_adapter(folder: Path, base: Base, *, other_base: bool = False) -> AdaptedModel:
    """A base with the adapter of a folder.

    Args:
        folder: That `save_adapter` wrote.
        base: Of the adapter; used up.
        other_base: Take a base with other weights than those the adapter was trained on, as long
            as the shapes are the same.

    Raises:
        DataError: If the folder holds no adapter, or it belongs to another base.
        IntegrityError: If the weights are not those that the card names.
    """
    card = read_card(folder)
    if card.base_digest != base.digest and not other_base:
        raise DataError(
            f"{printable(folder, 200)} was trained on {printable(card.base)} with digest "
            f"{printable(card.base_digest[:12])}, the base {base.name} has {base.digest[:12]}; "
            "give that base, or other_base=True to use it all the same"
        )
    try:
        model = AdaptedModel(base, card.spec)
    except ArgumentError as error:
        raise DataError(
            f"{printable(folder, 200)} does not fit the base {printable(base.name)}: {error}"
        ) from None
    model.load_trained(_weights(folder, card))
    return model.frozen()


def _weights(folder: Path, card: Card) -> dict[str, torch.Tensor]:
    safetensors = require("safetensors.torch", extra="edit", to=TO)
    path = _files.file_inside(folder, WEIGHTS)
    data = path.read_bytes()
    if _files.sha256_of(data) != card.sha256:
        raise IntegrityError(
            f"{printable(path, 200)} has other bytes than its card names; get the adapter again"
        )
    try:
        tensors: dict[str, torch.Tensor] = safetensors.load(data)
    except Exception as error:
        raise DataError(
            f"{printable(path, 200)} is no safetensors file: {printable(error, 200)}"
        ) from None
    return tensors
