"""Pipelines of diffusers from folders: files only, safetensors only, nothing fetched."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from weather_aug._extras import require
from weather_aug.edit.devices import device_of
from weather_aug.edit.diffusion.base import check_words
from weather_aug.edit.loading import quiet_libraries, read_network
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.edit.weights import MODEL_INDEX, digest_of, readable

PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")
LIBRARIES = ("diffusers", "transformers", "torch")


def needs_of(parts: tuple[str, ...] = PARTS) -> tuple[str, ...]:
    """The files that show that a folder holds a pipeline's networks."""
    return (MODEL_INDEX, *(f"{part}/config.json" for part in parts if part in _NETWORKS))


def load_pipeline(
    kind: str, folder: Path, options: PeerOptions, *, to: str, **components: Any
) -> Any:
    """A pipeline on the options' device, silent and without the filter that blackens pictures.

    Args:
        kind: Class of diffusers.
        folder: In the diffusers layout.
        options: Device and precision.
        to: What it is needed for, an infinitive.
        **components: Parts that are not read from the folder.

    Raises:
        ArgumentError: If the device is not there.
        MissingExtraError: If diffusers is not installed.
        DataError: If the files are no such model.
    """
    device = device_of(options.device)
    diffusers = require("diffusers", extra="edit", to=to)
    transformers = require("transformers", extra="edit", to=to)
    kinds = {
        "unet": diffusers.UNet2DConditionModel,
        "vae": diffusers.AutoencoderKL,
        "text_encoder": transformers.CLIPTextModel,
    }
    for part in _NETWORKS:
        if part not in components:
            components[part] = read_network(kinds[part], folder / part)
    with readable(folder), quiet_libraries():
        pipeline = getattr(diffusers, kind).from_pretrained(
            folder,
            local_files_only=True,
            use_safetensors=True,
            safety_checker=None,
            feature_extractor=None,
            image_encoder=None,
            requires_safety_checker=False,
            **components,
        )
        pipeline.set_progress_bar_config(disable=True)
    check_words(folder, pipeline.tokenizer, pipeline.text_encoder.config)
    return pipeline.to(device, precision_of(options))


def precision_of(options: PeerOptions) -> torch.dtype:
    """Of the networks."""
    return torch.float16 if options.half else torch.float32


@contextmanager
def quiet() -> Iterator[None]:
    """Around samplers of diffusers that hand numpy 2 a tensor, which speaks numpy 1's protocol."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "__array__ implementation", DeprecationWarning)
        yield


def pipeline_card(folder: Path, options: PeerOptions) -> dict[str, Any]:
    """What a pipeline's pictures depend on besides its own options."""
    return {
        "base_digest": digest_of(folder, PARTS),
        "versions": {name: version(name) for name in LIBRARIES},
        **options.card("height", "half", "seed"),
    }


_NETWORKS = ("unet", "vae", "text_encoder")
