"""Tiny random diffusion models in the published layout, written by the library's own classes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

START, END = "<|startoftext|>", "<|endoftext|>"
HIDDEN = 32
"""Features of a token."""
SD_TURBO_SCHEDULER: dict[str, Any] = dict(
    beta_start=0.00085,
    beta_end=0.012,
    beta_schedule="scaled_linear",
    prediction_type="epsilon",
    steps_offset=1,
    timestep_spacing="trailing",
)
"""What scheduler/scheduler_config.json of stabilityai/sd-turbo says."""


def build_tiny_sd(
    folder: Path, seed: int, *, latent_channels_in: int = 4, vae_levels: int = 4, width: int = 8
) -> Path:
    """Write a whole model shaped like SD-Turbo, with random weights.

    Args:
        folder: To write to.
        seed: Of the weights; torch's own stream is left as it was.
        latent_channels_in: Of the UNet; InstructPix2Pix has 8.
        vae_levels: A latent is 2 ** (vae_levels - 1) pixels wide.
        width: Channels of the first level; 8 makes 0.9 M parameters in all, 16 makes 3.5 M.

    Returns:
        The folder, in the layout of diffusers: unet (4 levels, linear projections), vae,
        text_encoder, tokenizer, scheduler and model_index.json.
    """
    from diffusers import EulerDiscreteScheduler, StableDiffusionPipeline

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet, vae, text = _unet(latent_channels_in, width), _vae(vae_levels, width), _text_encoder()
    pipeline = StableDiffusionPipeline(
        vae=vae,
        text_encoder=text,
        tokenizer=tiny_tokenizer(),
        unet=unet,
        scheduler=EulerDiscreteScheduler(**SD_TURBO_SCHEDULER),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder, safe_serialization=True)
    return folder


def build_tiny_controlnet(folder: Path, base: Path, seed: int) -> Path:
    """Write a ControlNet for the UNet of `base`, its zero convolutions already trained a little."""
    from diffusers import ControlNetModel, UNet2DConditionModel

    unet = UNet2DConditionModel.from_pretrained(base, subfolder="unet")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = ControlNetModel.from_unet(unet, conditioning_embedding_out_channels=(8, 8, 16, 16))
        for layer in [*net.controlnet_down_blocks, net.controlnet_mid_block]:
            torch.nn.init.normal_(layer.weight, std=0.2)
        # As they come, six small convolutions leave nothing of what they are shown.
        for layer in net.controlnet_cond_embedding.modules():
            if isinstance(layer, torch.nn.Conv2d):
                torch.nn.init.kaiming_normal_(layer.weight)
    net.save_pretrained(folder, safe_serialization=True)
    return folder


def tiny_tokenizer() -> Any:
    """CLIP's byte-level tokenizer that knows letters and no words."""
    from transformers import CLIPTokenizer

    letters = [chr(code) for code in (*range(33, 127), *range(161, 173), *range(174, 256))]
    # The bytes that print as nothing have letters of their own, as in GPT-2.
    letters += [chr(256 + index) for index in range(256 - len(letters))]
    vocabulary = [*letters, *(f"{letter}</w>" for letter in letters), START, END]
    return CLIPTokenizer(
        vocab={token: index for index, token in enumerate(vocabulary)},
        merges=[],
        model_max_length=77,
    )


def _unet(channels_in: int, width: int) -> Any:
    from diffusers import UNet2DConditionModel

    return UNet2DConditionModel(
        sample_size=8,
        in_channels=channels_in,
        out_channels=4,
        block_out_channels=(width, 2 * width, 4 * width, 4 * width),
        layers_per_block=2,
        down_block_types=(*["CrossAttnDownBlock2D"] * 3, "DownBlock2D"),
        up_block_types=("UpBlock2D", *["CrossAttnUpBlock2D"] * 3),
        cross_attention_dim=HIDDEN,
        attention_head_dim=(1, 2, 4, 4),
        norm_num_groups=8,
        use_linear_projection=True,
    )


def _vae(levels: int, width: int) -> Any:
    from diffusers import AutoencoderKL

    return AutoencoderKL(
        sample_size=64,
        latent_channels=4,
        block_out_channels=(width, 2 * width, 4 * width, 4 * width)[:levels],
        layers_per_block=2,
        down_block_types=["DownEncoderBlock2D"] * levels,
        up_block_types=["UpDecoderBlock2D"] * levels,
        norm_num_groups=8,
        scaling_factor=0.18215,
    )


def _text_encoder() -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    tokens = len(tiny_tokenizer())
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=tokens,
            hidden_size=HIDDEN,
            intermediate_size=2 * HIDDEN,
            num_hidden_layers=2,
            num_attention_heads=2,
            max_position_embeddings=77,
            bos_token_id=tokens - 2,
            eos_token_id=tokens - 1,
            pad_token_id=tokens - 1,
        )
    )
