"""A small latent diffusion model of SD-Turbo's kind, with the library's own classes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

START, END = "<|startoftext|>", "<|endoftext|>"
TOKENS = 77
"""Of a prompt, as CLIP's."""
SD_TURBO_SCHEDULE: dict[str, Any] = dict(
    beta_start=0.00085,
    beta_end=0.012,
    beta_schedule="scaled_linear",
    num_train_timesteps=1000,
    prediction_type="epsilon",
    steps_offset=1,
    timestep_spacing="trailing",
)
"""What scheduler/scheduler_config.json of stabilityai/sd-turbo says."""


@dataclass(frozen=True)
class Sizes:
    """Widths of the networks; the default makes 3.0 M parameters."""

    vae: tuple[int, ...] = (16, 32, 64)
    """Channels by level; a latent is 2 ** (levels - 1) pixels wide."""
    unet: tuple[int, ...] = (32, 64, 96)
    """Channels by level; all but the last look around and read the prompt, and so does the
    middle."""
    text: int = 64
    """Features of a token."""
    layers: int = 1
    """Residual blocks of a level."""


@dataclass(frozen=True, eq=False)
class Parts:
    """The networks of a model, in float32, to be trained."""

    vae: Any
    unet: Any
    text_encoder: Any
    tokenizer: Any

    def parameters(self) -> int:
        """How many there are in all."""
        networks = (self.vae, self.unet, self.text_encoder)
        return sum(p.numel() for network in networks for p in network.parameters())


def fresh(sizes: Sizes, seed: int) -> Parts:
    """Networks with random weights; torch's own stream is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        tokenizer = letters_tokenizer()
        return Parts(_vae(sizes), _unet(sizes), _text_encoder(sizes, len(tokenizer)), tokenizer)


def letters_tokenizer() -> Any:
    """CLIP's byte-level tokenizer that knows letters and no words."""
    from transformers import CLIPTokenizer

    letters = [chr(code) for code in (*range(33, 127), *range(161, 173), *range(174, 256))]
    # Bytes that print as nothing have letters of their own, as in GPT-2.
    letters += [chr(256 + index) for index in range(256 - len(letters))]
    vocabulary = [*letters, *(f"{letter}</w>" for letter in letters), START, END]
    return CLIPTokenizer(
        vocab={token: index for index, token in enumerate(vocabulary)},
        merges=[],
        model_max_length=TOKENS,
    )


def _vae(sizes: Sizes) -> Any:
    from diffusers import AutoencoderKL

    levels = len(sizes.vae)
    return AutoencoderKL(
        sample_size=96,
        latent_channels=4,
        block_out_channels=sizes.vae,
        layers_per_block=sizes.layers,
        down_block_types=["DownEncoderBlock2D"] * levels,
        up_block_types=["UpDecoderBlock2D"] * levels,
        norm_num_groups=8,
        scaling_factor=1.0,
    )


def _unet(sizes: Sizes) -> Any:
    from diffusers import UNet2DConditionModel

    looking = len(sizes.unet) - 1
    return UNet2DConditionModel(
        sample_size=24,
        in_channels=4,
        out_channels=4,
        block_out_channels=sizes.unet,
        layers_per_block=sizes.layers,
        down_block_types=(*["CrossAttnDownBlock2D"] * looking, "DownBlock2D"),
        up_block_types=("UpBlock2D", *["CrossAttnUpBlock2D"] * looking),
        cross_attention_dim=sizes.text,
        # Of SD 2 this is the number of heads, whatever its name says.
        attention_head_dim=tuple(width // 32 for width in sizes.unet),
        norm_num_groups=8,
        use_linear_projection=True,
    )


def _text_encoder(sizes: Sizes, tokens: int) -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=tokens,
            hidden_size=sizes.text,
            intermediate_size=2 * sizes.text,
            num_hidden_layers=2,
            num_attention_heads=2,
            max_position_embeddings=TOKENS,
            bos_token_id=tokens - 2,
            eos_token_id=tokens - 1,
            pad_token_id=tokens - 1,
        )
    )
