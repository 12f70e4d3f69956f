"""Fixtures of the diffusion editor's tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def small_base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a random model of SD-Turbo's shape."""
    from tiny_diffusion import build_tiny_sd

    return build_tiny_sd(tmp_path_factory.mktemp("small") / "base", seed=0)
