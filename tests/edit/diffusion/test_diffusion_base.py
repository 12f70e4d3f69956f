"""Bases from disk: what is not there or not one is one sentence; nothing is unpickled."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.options import SD_TURBO
from weather_aug.errors import DataError


@pytest.fixture
def copied(small_base: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_base, tmp_path / "base"))


def change_json(path: Path, **values: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_it_is_frozen_and_knows_its_schedule(small_base: Path) -> None:
    base = load_base(str(small_base))
    assert not any(p.requires_grad for net in (base.unet, base.vae) for p in net.parameters())
    assert base.factor == 8
    # SD-Turbo's last step is nearly all noise.
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    assert base.alpha_bar == pytest.approx(float((1 - betas).prod()), rel=1e-4)


def test_equal_files_are_equal_bases(small_base: Path, copied: Path) -> None:
    first = load_base(str(small_base)).digest
    assert load_base(str(copied)).digest == first
    # Another licence file next to the weights is no other model; other weights are.
    (copied / "LICENSE.md").write_text("words")
    assert load_base(str(copied)).digest == first
    change_json(copied / "scheduler" / "scheduler_config.json", beta_end=0.0121)
    assert load_base(str(copied)).digest != first


def test_weights_that_are_not_here_say_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(DataError) as caught:
        load_base(SD_TURBO)
    said = str(caught.value)
    assert "\n" not in said
    for word in (SD_TURBO, "Stability AI Community License", "hf download", "physical"):
        assert word in said


def test_pickled_weights_are_not_read(copied: Path) -> None:
    weights = next((copied / "unet").glob("*.safetensors"))
    torch.save({}, copied / "unet" / "diffusion_pytorch_model.bin")
    weights.unlink()
    with pytest.raises(DataError, match="no model that can be read"):
        load_base(str(copied))


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("scheduler/scheduler_config.json", {"prediction_type": "v_prediction"}, "epsilon"),
        ("scheduler/scheduler_config.json", {"num_train_timesteps": 500}, "1000 steps"),
        ("unet/config.json", {"block_out_channels": [8, 8]}, "no model that can be read"),
    ],
)
def test_another_kind_of_model_is_refused(
    copied: Path, name: str, values: dict[str, object], message: str
) -> None:
    change_json(copied / name, **values)
    with pytest.raises(DataError, match=message):
        load_base(str(copied))


def test_a_part_that_is_missing_is_named(copied: Path) -> None:
    shutil.rmtree(copied / "vae")
    with pytest.raises(DataError, match="vae"):
        load_base(str(copied))


def test_a_tokenizer_without_its_words_is_refused(copied: Path) -> None:
    """It loads, and all prompts would be one text."""
    (copied / "tokenizer" / "tokenizer.json").unlink()
    with pytest.raises(DataError, match="tokenizer knows"):
        load_base(str(copied)).embed(["snow", "rain"])


def test_prompts_are_as_long_as_the_text_encoder_reads(small_base: Path, copied: Path) -> None:
    path = copied / "tokenizer" / "tokenizer_config.json"
    config = json.loads(path.read_text())
    del config["model_max_length"]
    path.write_text(json.dumps(config))
    expected = load_base(str(small_base)).embed(["snow"])
    assert torch.equal(load_base(str(copied)).embed(["snow"]), expected)


def test_a_text_encoder_of_another_width_is_refused(copied: Path) -> None:
    from transformers import CLIPTextConfig, CLIPTextModel

    folder = copied / "text_encoder"
    config = CLIPTextConfig.from_pretrained(folder)
    config.hidden_size *= 2
    CLIPTextModel(config).save_pretrained(folder)
    with pytest.raises(DataError, match="texts of width"):
        load_base(str(copied)).embed(["snow"])
