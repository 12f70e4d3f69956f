"""Random depth networks small enough for tests, in the files and with the classes of real ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

SIDE = 56
"""To which pictures are resized for them, pixels."""
_SMALL = dict(hidden_size=16, num_hidden_layers=4, num_attention_heads=2)


def build_tiny_depth_anything(folder: Path, kind: str = "relative", seed: int = 0) -> Path:
    """Save a Depth Anything over a tiny DINOv2, of a kind: "relative" or "metric"."""
    from transformers import (
        DepthAnythingConfig,
        DepthAnythingForDepthEstimation,
        Dinov2Config,
        DPTImageProcessorPil,
    )

    backbone = Dinov2Config(
        **_SMALL,
        mlp_ratio=2,
        image_size=SIDE,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=4,
        depth_estimation_type=kind,
        max_depth=80 if kind == "metric" else 1,
    )
    processor = DPTImageProcessorPil(
        size={"height": SIDE, "width": SIDE}, keep_aspect_ratio=True, ensure_multiple_of=14
    )
    return _saved(folder, DepthAnythingForDepthEstimation, config, processor, seed)


def build_tiny_dpt(folder: Path, seed: int = 0) -> Path:
    """Save a DPT over its own tiny ViT."""
    from transformers import DPTConfig, DPTForDepthEstimation, DPTImageProcessorPil

    config = DPTConfig(
        **_SMALL,
        intermediate_size=32,
        image_size=64,
        patch_size=16,
        backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
    )
    processor = DPTImageProcessorPil(size={"height": 64, "width": 64})
    return _saved(folder, DPTForDepthEstimation, config, processor, seed)


def build_tiny_glpn(folder: Path, seed: int = 0) -> Path:
    """Save a GLPN, which gives metres."""
    from transformers import GLPNConfig, GLPNForDepthEstimation, GLPNImageProcessorPil

    config = GLPNConfig(
        hidden_sizes=[8, 8, 16, 16],
        num_attention_heads=[1, 1, 2, 2],
        depths=[1, 1, 1, 1],
        decoder_hidden_size=8,
        max_depth=80,
    )
    return _saved(folder, GLPNForDepthEstimation, config, GLPNImageProcessorPil(), seed)


def build_tiny_zoedepth(folder: Path, seed: int = 0) -> Path:
    """Save a ZoeDepth over a tiny BEiT, which gives metres."""
    from transformers import (
        BeitConfig,
        ZoeDepthConfig,
        ZoeDepthForDepthEstimation,
        ZoeDepthImageProcessorPil,
    )

    backbone = BeitConfig(
        **_SMALL,
        intermediate_size=32,
        image_size=64,
        patch_size=16,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    config = ZoeDepthConfig(
        backbone_config=backbone,
        backbone_hidden_size=16,
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        bottleneck_features=8,
        num_relative_features=8,
        num_attractors=[4, 2, 1, 1],
        bin_embedding_dim=8,
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 80.0, "name": "kitti"}],
    )
    processor = ZoeDepthImageProcessorPil(size={"height": 64, "width": 64})
    return _saved(folder, ZoeDepthForDepthEstimation, config, processor, seed)


def _saved(folder: Path, kind: Any, config: Any, processor: Any, seed: int) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = kind(config)
        with torch.no_grad():
            for weight in network.parameters():
                if weight.ndim > 1:
                    # As drawn they are so small that every picture has the same depth.
                    torch.nn.init.kaiming_normal_(weight)
                if weight.ndim == 4 and weight.shape[0] == 1:
                    # Before the last rectifier, which a random sign may leave at 0 everywhere.
                    weight.abs_()
        network.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder
