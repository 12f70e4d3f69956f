"""Networks from files: whole, and in silence."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import load_file, save_file

from tests.tiny_diffusion import build_tiny_sd
from weather_aug.edit import loading
from weather_aug.edit.diffusion.base import load_base
from weather_aug.errors import DataError


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_sd(tmp_path_factory.mktemp("base"), seed=0)


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder"])
def test_weights_that_are_missing_are_not_drawn(part: str, base: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(base, tmp_path / "base"))
    path = next((folder / part).glob("*.safetensors"))
    weights = load_file(path)
    weights.pop(sorted(weights)[5])
    save_file(weights, path, metadata={"format": "pt"})
    with pytest.raises(DataError, match="1 of the weights are missing, such as"):
        load_base(str(folder)).embed(["snow"])


def _settings() -> tuple[Any, ...]:
    from diffusers.utils import logging as diffusers
    from transformers.utils import logging as transformers

    hook = transformers.set_tqdm_hook(None)
    transformers.set_tqdm_hook(hook)
    bars = diffusers.is_progress_bar_enabled(), transformers.is_progress_bar_enabled()
    return *bars, diffusers.get_verbosity(), transformers.get_verbosity(), hook


def test_loading_says_nothing_and_leaves_settings(
    base: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = _settings()
    load_base(str(base)).embed(["snow"])
    assert capfd.readouterr() == ("", "")
    assert _settings() == before
    with pytest.raises(ZeroDivisionError), loading.quiet_libraries():
        raise ZeroDivisionError
    assert _settings() == before


def test_the_libraries_would_speak(
    base: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from transformers.utils import logging as transformers

    monkeypatch.setattr(transformers, "set_tqdm_hook", lambda hook: None)
    load_base(str(base)).embed(["snow"])
    sys.stderr.flush()
    assert "Loading weights" in capfd.readouterr().err
