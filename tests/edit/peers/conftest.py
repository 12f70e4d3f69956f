"""Tiny models of every peer, written once, and a rig's moment of odd sizes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tiny_clip import TinyClip
from tiny_diffusion import build_tiny_controlnet, build_tiny_sd

from weather_aug.edit.background import Moment

# The editor's street lies beside this folder's parent.
sys.path.insert(0, str(Path(__file__).parents[1]))


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Networks this small only wait for a second thread, for minutes where the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def tiny_sd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_sd(tmp_path_factory.mktemp("sd") / "model", seed=1)


@pytest.fixture(scope="session")
def tiny_instruct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("instruct") / "model"
    return build_tiny_sd(folder, seed=2, latent_channels_in=8)


@pytest.fixture(scope="session")
def tiny_control(tiny_sd: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_controlnet(tmp_path_factory.mktemp("control") / "model", tiny_sd, seed=3)


@pytest.fixture(scope="session")
def moment() -> Moment:
    """Two cameras at time 1, whose sides no step of a network divides."""
    clip = TinyClip(width=97, height=53)
    return Moment(now=tuple(clip.frame(key) for key in clip.keys if key.time_index == 1))
