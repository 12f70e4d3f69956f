"""The frozen base model: SD-Turbo, or one of its shape, from a folder in the diffusers layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from weather_aug._extras import require
from weather_aug.edit.diffusion.one_step import LAST_STEP
from weather_aug.edit.loading import quiet_libraries, read_network
from weather_aug.edit.weights import digest_of, is_model_id, located, readable
from weather_aug.errors import DataError, printable

PARTS = ("unet", "vae", "text_encoder", "tokenizer", "scheduler")
WHAT = "the one-step diffusion model"
TO = "edit backgrounds by diffusion"


@dataclass(frozen=True, eq=False)
class Base:
    """A one-step text-to-image model, frozen.

    Convention:
        Weights are those of the files, on the CPU in float32; nothing changes them. Files are
        safetensors only: nothing is unpickled.
    """

    name: str
    """Id or the folder's name."""
    revision: str
    """The hub's commit where the folder tells it, else ""."""
    digest: str
    """Of all files that are read: two bases with the same are the same."""
    folder: Path
    unet: Any
    """UNet2DConditionModel."""
    vae: Any
    """AutoencoderKL."""
    alpha_bars: torch.Tensor
    """(1000,) float64 cumulative products of the training schedule."""

    @property
    def alpha_bar(self) -> float:
        """At the last time step, where one-step models start."""
        return float(self.alpha_bars[LAST_STEP])

    @property
    def factor(self) -> int:
        """Pixels of a picture's side for one of the latent's."""
        return 2 ** (len(self.vae.config.block_out_channels) - 1)

    def embed(self, prompts: Sequence[str]) -> torch.Tensor:
        """(N, tokens, width) of the text encoder, which is read for this and let go.

        Raises:
            DataError: If the files of tokenizer and text encoder cannot be read, or the two and
                the UNet are not of one model.
        """
        transformers = require("transformers", extra="edit", to=TO)
        with readable(self.folder), quiet_libraries():
            tokenizer = transformers.CLIPTokenizer.from_pretrained(
                self.folder / "tokenizer", local_files_only=True
            )
        encoder = read_network(transformers.CLIPTextModel, self.folder / "text_encoder")
        check_words(self.folder, tokenizer, encoder.config)
        self._check_width(encoder.config)
        tokens = tokenizer(
            list(prompts),
            padding="max_length",
            max_length=encoder.config.max_position_embeddings,
            truncation=True,
            return_tensors="pt",
        )
        with torch.inference_mode():
            hidden = encoder.eval()(tokens.input_ids)[0]
        # Inference tensors cannot take part in training.
        return hidden.clone()

    def _check_width(self, config: Any) -> None:
        width = self.unet.config.cross_attention_dim
        if config.hidden_size != width:
            raise DataError(
                f"{printable(self.folder, 200)}: the UNet reads texts of width {printable(width)}, "
                f"the text encoder gives {config.hidden_size}; only models with one text encoder, "
                "such as SD-Turbo, can be used"
            )


def load_base(base: str) -> Base:
    """Read a base model.

    Args:
        base: Folder in the diffusers layout, or an id that is in the local cache.

    Raises:
        MissingExtraError: If diffusers is not installed.
        DataError: If it is not there, which says how to fetch it, or its files are no such model.
    """
    diffusers = require("diffusers", extra="edit", to=TO)
    needs = [f"{part}/config.json" for part in ("unet", "vae", "text_encoder")]
    folder = located(base, to=TO, what=WHAT, needs=[*needs, "scheduler/scheduler_config.json"])
    unet = read_network(diffusers.UNet2DConditionModel, folder / "unet")
    vae = read_network(diffusers.AutoencoderKL, folder / "vae")
    with readable(folder), quiet_libraries():
        schedule = diffusers.DDPMScheduler.from_pretrained(
            folder / "scheduler", local_files_only=True
        )
    _check(folder, unet, vae, schedule)
    return Base(
        name=base if is_model_id(base) and not Path(base).is_dir() else folder.resolve().name,
        revision=folder.name if folder.parent.name == "snapshots" else "",
        digest=digest_of(folder, PARTS),
        folder=folder,
        unet=unet.eval().requires_grad_(False),
        vae=vae.eval().requires_grad_(False),
        alpha_bars=schedule.alphas_cumprod.double(),
    )


def check_words(folder: Path, tokenizer: Any, config: Any) -> None:
    """Refuse a tokenizer that is not the text encoder's.

    One whose vocabulary is missing loads without a word, and makes the same text of all.

    Args:
        folder: Of the model, to be named.
        tokenizer: Of transformers.
        config: Of the text encoder.

    Raises:
        DataError: If they do not know as many tokens.
    """
    if len(tokenizer) != config.vocab_size:
        raise DataError(
            f"{printable(folder, 200)}: the tokenizer knows {len(tokenizer)} tokens, the text "
            f"encoder {config.vocab_size}; a file of the tokenizer is missing, or they are not of "
            "one model"
        )


def _check(folder: Path, unet: Any, vae: Any, schedule: Any) -> None:
    kind = schedule.config.prediction_type
    if kind != "epsilon":
        raise DataError(
            f"{printable(folder, 200)}: its scheduler says prediction_type {printable(kind)!r}; "
            "only models that predict the noise (epsilon), such as SD-Turbo, can be used"
        )
    if len(schedule.alphas_cumprod) != LAST_STEP + 1:
        raise DataError(f"{printable(folder, 200)}: its schedule has not {LAST_STEP + 1} steps")
    latent = vae.config.latent_channels
    if (unet.config.in_channels, unet.config.out_channels) != (latent, latent):
        raise DataError(
            f"{printable(folder, 200)}: the UNet maps {unet.config.in_channels} channels to "
            f"{unet.config.out_channels}, the VAE's latent has {latent}; they are not of one model"
        )
