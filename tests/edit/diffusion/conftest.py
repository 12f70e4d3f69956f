"""Fixtures of the diffusion editor's tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Networks this small wait for each other's threads more than they compute."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def small_base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a random model of SD-Turbo's shape."""
    from tiny_diffusion import build_tiny_sd

    return build_tiny_sd(tmp_path_factory.mktemp("small") / "base", seed=0)
