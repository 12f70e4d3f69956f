"""Noise keyed by what it is for: the seed, the frame, the style; never by who draws it when."""

from __future__ import annotations

import hashlib

import torch

from weather_aug._keys import key_of
from weather_aug.clip.types import FrameKey
from weather_aug.edit.background import STYLES


def generator_of(seed: int, key: FrameKey, style: str) -> torch.Generator:
    """A generator on the CPU: its numbers are the same whatever device the networks are on.

    Args:
        seed: Of the options.
        key: Of the frame that is edited.
        style: One of `STYLES`.
    """
    name = hashlib.blake2b(key.camera.encode(), digest_size=8).digest()
    camera = int.from_bytes(name, "little")
    drawn = key_of("edit-peers", seed, key.time_index, camera, STYLES.index(style))
    generator = torch.Generator("cpu")
    return generator.manual_seed(drawn % 2**63)
