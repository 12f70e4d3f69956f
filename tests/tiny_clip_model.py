"""A random CLIP small enough for tests, in the files and with the classes of the real ones."""

from __future__ import annotations

from pathlib import Path

import torch

SIDE = 32
"""Of the pictures that it sees, pixels."""


def build_tiny_clip(folder: Path, seed: int = 0) -> Path:
    """Save a CLIP of some thousand weights, a tokenizer of letters, and its preprocessing."""
    from transformers import CLIPConfig, CLIPImageProcessorPil, CLIPModel, CLIPTokenizer

    letters = "abcdefghijklmnopqrstuvwxyz"
    merges = [("s", "n"), ("r", "a"), ("i", "n</w>")]
    words = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{c}</w>" for c in letters)]
    words += ["".join(pair) for pair in merges]
    vocabulary = {word: index for index, word in enumerate(words)}
    CLIPTokenizer(vocab=vocabulary, merges=merges, model_max_length=77).save_pretrained(folder)
    small = dict(hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2)
    texts = dict(vocab_size=len(words), max_position_embeddings=77, bos_token_id=0, eos_token_id=1)
    config = CLIPConfig(
        text_config=small | texts,
        vision_config=small | dict(image_size=SIDE, patch_size=8),
        projection_dim=12,
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        CLIPModel(config).save_pretrained(folder)
    CLIPImageProcessorPil(
        size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE}
    ).save_pretrained(folder)
    return folder
