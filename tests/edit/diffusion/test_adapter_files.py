"""Adapters on disk: equal pictures after loading, and a sentence for whatever is not one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from small_base import adapted, perturbed, pictures
from tiny_diffusion import build_tiny_sd

from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.adapter_files import (
    CARD,
    TRAINED_ON_SHA256,
    WEIGHTS,
    load_adapter,
    read_card,
    read_trained_on,
    save_adapter,
)
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.leakage import TRAINED_ON, TrainedOn
from weather_aug.edit.diffusion.spec import AdapterSpec, parse_spec
from weather_aug.errors import DataError, IntegrityError, OutputError


@pytest.fixture(scope="module")
def model(small_base: Path) -> AdaptedModel:
    return perturbed(adapted(small_base), seed=4)


@pytest.fixture
def folder(model: AdaptedModel, tmp_path: Path) -> Path:
    save_adapter(model, tmp_path / "adapter", training={"steps": 7})
    return tmp_path / "adapter"


def change_card(folder: Path, change: Callable[[Any], None]) -> None:
    content = json.loads((folder / CARD).read_text())
    change(content)
    (folder / CARD).write_text(json.dumps(content))


def test_saved_and_loaded_it_gives_equal_pictures(
    model: AdaptedModel, folder: Path, small_base: Path
) -> None:
    image, label = pictures()
    loaded = load_adapter(folder, load_base(str(small_base)))
    with torch.no_grad():
        for style in (*model.spec.styles, {"snow": 0.5, "fog": 0.2}):
            assert torch.equal(loaded(image, label, style), model(image, label, style))
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_the_card_tells_what_it_is(folder: Path, model: AdaptedModel) -> None:
    card = read_card(folder)
    assert card.spec == model.spec
    assert (card.base, card.base_digest) == (model.base.name, model.base.digest)
    assert card.training == {"steps": 7} and "base model" in card.licence
    content = json.loads((folder / CARD).read_text())
    assert content["spec"]["unet_rank"] == 2 and "to_q" in content["spec"]["unet_targets"]


def test_the_fully_trained_convolution_is_saved(folder: Path) -> None:
    """CycleGAN-Turbo's files lack it."""
    from safetensors.torch import load_file

    names = set(load_file(folder / WEIGHTS))
    assert {"unet.conv_in.change.weight", "unet.conv_in.change.bias"} <= names


def test_saving_twice_gives_the_same_bytes(folder: Path, model: AdaptedModel) -> None:
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    save_adapter(model, folder, training={"steps": 7})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first


def test_a_base_of_another_shape_is_refused(folder: Path, tmp_path: Path) -> None:
    wider = build_tiny_sd(tmp_path / "wider", seed=0, width=16)
    with pytest.raises(DataError, match="trained on"):
        load_adapter(folder, load_base(str(wider)))
    with pytest.raises(DataError, match="base of another shape"):
        load_adapter(folder, load_base(str(wider)), other_base=True)


def test_a_base_of_other_weights_is_taken_only_on_demand(folder: Path, tmp_path: Path) -> None:
    other = build_tiny_sd(tmp_path / "other", seed=1)
    with pytest.raises(DataError, match="other_base=True"):
        load_adapter(folder, load_base(str(other)))
    load_adapter(folder, load_base(str(other)), other_base=True)


def test_changed_weights_are_noticed(folder: Path, small_base: Path) -> None:
    data = bytearray((folder / WEIGHTS).read_bytes())
    data[-1] ^= 1
    (folder / WEIGHTS).write_bytes(data)
    with pytest.raises(IntegrityError, match="other bytes"):
        load_adapter(folder, load_base(str(small_base)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="x"), "weather_aug adapter"),
        (lambda c: c.update(version=99), "version"),
        (lambda c: c.pop("base"), "malformed"),
        (lambda c: c["spec"].update(unet_rank=0), "unet_rank"),
        (lambda c: c["spec"].update(unet_rank=10**9), "unet_rank"),
        (lambda c: c["spec"].update(more=1), "description"),
        (lambda c: c["spec"].update(prompts={"../x": "y"}), "plain word"),
        (lambda c: c["spec"].pop("unet_targets"), "description"),
        (lambda c: c["spec"].update(conditioning="colour"), "conditioning"),
    ],
)
def test_a_card_that_is_none_is_refused(
    folder: Path, change: Callable[[Any], None], message: str
) -> None:
    change_card(folder, change)
    with pytest.raises(DataError, match=message):
        read_card(folder)


def test_a_folder_without_a_card_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="train-editor"):
        read_card(tmp_path)


def test_a_write_that_is_cut_short_leaves_no_card(
    folder: Path, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    from weather_aug import _files

    def full(path: Path, data: bytes) -> None:
        raise OutputError("cannot write: No space left on device")

    monkeypatch.setattr(_files, "write_whole", full)
    with pytest.raises(OutputError):
        save_adapter(model, folder)
    with pytest.raises(DataError):
        read_card(folder)


def test_specs_survive_json() -> None:
    for spec in (
        AdapterSpec(),
        AdapterSpec(prompts={"snow": "s"}, conditioning="gray", skips=False, unet_rank=4),
    ):
        assert parse_spec(json.loads(json.dumps(spec.as_json()))) == spec


def test_targets_that_the_base_lacks_are_the_adapters_fault(folder: Path, small_base: Path) -> None:
    change_card(folder, lambda card: card["spec"].update(unet_targets=["no_such_layer"]))
    with pytest.raises(DataError, match="no_such_layer"):
        load_adapter(folder, load_base(str(small_base)))


def test_the_card_names_the_record_of_what_trained_it(folder: Path) -> None:
    """Without a name whatever stands there is believed; a named one is there as it was."""
    assert read_trained_on(folder, read_card(folder)) is None
    record = TrainedOn(frozenset(["0" * 64, "1" * 64]))
    record.write(folder)
    assert read_trained_on(folder, read_card(folder)) == record
    sha256 = hashlib.sha256(record.as_bytes()).hexdigest()
    change_card(folder, lambda card: card["training"].update({TRAINED_ON_SHA256: sha256}))
    assert read_trained_on(folder, read_card(folder)) == record
    TrainedOn(frozenset(["0" * 64])).write(folder)
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        read_trained_on(folder, read_card(folder))
    (folder / TRAINED_ON).unlink()
    with pytest.raises(DataError, match=r"trained_on\.txt is missing"):
        read_trained_on(folder, read_card(folder))
