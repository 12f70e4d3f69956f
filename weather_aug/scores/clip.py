"""CLIP-S and CLIP-DS: whether a picture shows what a text says, and changed the way the text did.

Convention:
    Scores are plain cosines in [-1, 1], float64; others multiply CLIP-S by 100 or by 2.5. The
    scores are functions of embeddings (see `Encoder`), pictures and texts alike, so that whoever
    has embeddings of another model needs no CLIP.

The weights are read from a folder or from the local cache, never from the network.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8
from weather_aug._extras import require
from weather_aug.edit.loading import quiet_libraries
from weather_aug.errors import ArgumentError, DataError, printable

Float64 = NDArray[np.float64]

CLIP_LARGE = "openai/clip-vit-large-patch14"
"""Model that CLIP scores are mostly reported with; 1.7 GB."""
CLIP_BASE = "openai/clip-vit-base-patch32"
"""The smaller one, 0.6 GB; its scores are other numbers, to be compared with its own only."""
BATCH = 16
_NO_CHANGE = 1e-6
"""A difference of unit embeddings that is no longer than float32 rounding has no direction."""


def clip_s(pictures: Float64, text: Float64) -> Float64:
    """CLIP-S: cosine of each picture's embedding and a text's.

    Args:
        pictures: (..., D) embeddings of pictures, of any length but 0.
        text: (D,) embedding of what they should show, or (..., D).

    Returns:
        (...) in [-1, 1].

    Raises:
        ArgumentError: If an embedding is 0 or not finite, or the shapes do not fit.

    Source:
        Hessel et al., "CLIPScore" (2021), without its factor of 2.5 and its cut at 0.
    """
    return _cosine(_unit("pictures", pictures), _unit("text", text))


def clip_ds(edited: Float64, clear: Float64, text_edited: Float64, text_clear: Float64) -> Float64:
    """CLIP-DS: cosine of a picture's change and its text's change, in CLIP's space.

    Embeddings are made unit vectors first, then subtracted, as InstructPix2Pix's evaluation does.
    A picture that the editor left as it was has no direction: its score is 0.

    Args:
        edited: (..., D) embeddings of edited pictures, of any length but 0.
        clear: (..., D) of the same pictures before.
        text_edited: (D,) embedding of what the edited pictures should show.
        text_clear: (D,) of what they showed before.

    Returns:
        (...) in [-1, 1].

    Raises:
        ArgumentError: If an embedding is 0 or not finite, the shapes do not fit, or both texts are
            one.

    Source:
        Gal et al., "StyleGAN-NADA" (2021); Brooks et al., "InstructPix2Pix" (2023).
    """
    said = _unit("text_edited", text_edited) - _unit("text_clear", text_clear)
    if (np.linalg.norm(said, axis=-1) <= _NO_CHANGE).any():
        raise ArgumentError("text_edited and text_clear have one embedding; give two texts")
    changed = _unit("edited", edited) - _unit("clear", clear)
    length = np.linalg.norm(changed, axis=-1, keepdims=True)
    moved = np.divide(changed, length, out=np.zeros_like(changed), where=length > _NO_CHANGE)
    return _cosine(moved, _unit("text_edited - text_clear", said))


@dataclass(frozen=True, eq=False)
class Encoder:
    """A CLIP model that is ready to embed pictures and texts; `load_encoder` makes it."""

    source: str
    """Folder or id that it was loaded from."""
    model: Any
    """transformers.CLIPModel, in evaluation."""
    tokenizer: Any
    processor: Any
    device: str

    def pictures(self, images: Sequence[NDArray[np.uint8]]) -> Float64:
        """(N, D) embeddings of pictures, not normalised.

        The model's own preprocessing: the shorter side is resized (bicubic), the middle square is
        cut out. Of a wide driving picture it sees the middle.

        Args:
            images: (H, W, 3) uint8 sRGB each; sizes may differ.

        Raises:
            ArgumentError: If there are none, or one is no such picture.
        """
        import torch

        checked = [image_uint8(f"images[{i}]", image) for i, image in enumerate(images)]
        if not checked:
            raise ArgumentError("images is empty; give at least one picture")
        found = []
        with torch.inference_mode():
            for start in range(0, len(checked), BATCH):
                # The layout is told: of a picture 3 pixels wide nobody could guess it.
                batch = self.processor(
                    checked[start : start + BATCH],
                    return_tensors="pt",
                    input_data_format="channels_last",
                )
                output = self.model.get_image_features(**batch.to(self.device))
                found.append(output.pooler_output.double().cpu().numpy())
        return np.concatenate(found)

    def texts(self, prompts: Sequence[str]) -> Float64:
        """(N, D) embeddings of texts, not normalised; what is too long for the model is cut.

        Raises:
            ArgumentError: If there are none.
        """
        import torch

        if not prompts or isinstance(prompts, str):
            raise ArgumentError("prompts must be a list of at least one text")
        tokens = self.tokenizer(
            list(prompts),
            padding=True,
            truncation=True,
            max_length=self.model.config.text_config.max_position_embeddings,
            return_tensors="pt",
        )
        with torch.inference_mode():
            output = self.model.get_text_features(**tokens.to(self.device))
        embeddings: Float64 = output.pooler_output.double().cpu().numpy()
        return embeddings


def load_encoder(source: str | Path = CLIP_LARGE, *, device: str = "cpu") -> Encoder:
    """Load a CLIP model with its tokenizer and preprocessing.

    Args:
        source: Folder in the layout of transformers, or the id of a model in the local cache. The
            weights must be safetensors: pickles are not read.
        device: Of torch.

    Raises:
        MissingExtraError: If transformers is not installed.
        DataError: If the weights are not there, or are no CLIP model.
    """
    transformers = require("transformers", extra="edit", to="score pictures with CLIP")
    with _readable(source), quiet_libraries():
        model, loaded = transformers.CLIPModel.from_pretrained(
            source, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
        # The library fills what is missing with random numbers, and only logs it.
        if loaded["missing_keys"]:
            raise ValueError(f"{len(loaded['missing_keys'])} of its weights are missing")
        tokenizer = transformers.CLIPTokenizer.from_pretrained(source, local_files_only=True)
        if len(tokenizer) < model.config.text_config.vocab_size:
            raise ValueError("its tokenizer has fewer words than its text model")
        processor = transformers.CLIPImageProcessorPil.from_pretrained(
            source, local_files_only=True
        )
    return Encoder(str(source), model.eval().to(device), tokenizer, processor, device)


@contextmanager
def _readable(source: str | Path) -> Iterator[None]:
    """What the library says of files that are not there, or no such model, in one sentence."""
    shown = printable(source, 160)
    try:
        yield
    except Exception as error:
        # Whatever a stranger's file makes a parser raise.
        if Path(source).is_dir():
            reason = printable(str(error).strip().split("\n")[0], 160)
            raise DataError(f"{shown} holds no CLIP model that can be read: {reason}") from error
        raise DataError(
            f"the CLIP model {shown} is not on this machine; fetch {CLIP_LARGE} (licence: MIT) "
            f"with `hf download {CLIP_LARGE} --local-dir clip` and give that folder, or leave "
            "the CLIP scores out"
        ) from error


def _unit(name: str, embeddings: Any) -> Float64:
    """(..., D) of length 1."""
    array = np.asarray(embeddings, np.float64)
    if array.ndim < 1 or not np.isfinite(array).all():
        raise ArgumentError(f"{name} must be finite embeddings of shape (..., D)")
    # The largest number first: squares of tiny or huge ones leave float64.
    largest = np.abs(array).max(axis=-1, keepdims=True, initial=0.0)
    if not (largest > 0).all():
        raise ArgumentError(f"{name} has an embedding of length 0, which points nowhere")
    scaled = array / largest
    return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)


def _cosine(a: Float64, b: Float64) -> Float64:
    if a.shape[-1] != b.shape[-1]:
        raise ArgumentError(
            f"embeddings have {a.shape[-1]} and {b.shape[-1]} numbers; they must be of one model"
        )
    return np.clip((a * b).sum(axis=-1), -1.0, 1.0)
