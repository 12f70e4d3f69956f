"""Weights that come from elsewhere: found without the network, or a sentence on how to get them."""

import socket
import sys
from pathlib import Path

import pytest

from weather_aug.edit import weights
from weather_aug.edit.weights import (
    LICENCES,
    digest_of,
    is_model_id,
    licence_of,
    located,
    missing_weights,
    readable,
)
from weather_aug.errors import DataError, MissingExtraError

MODEL = "someone/some-model"


@pytest.fixture(autouse=True)
def no_network(monkeypatch, tmp_path):
    """An empty cache, and a network that nobody may ask."""

    def refused(*_):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refused)
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))


def fetched(cache: Path, model_id: str, names=("model_index.json",)) -> Path:
    """The cache as huggingface_hub leaves it after a download."""
    folder = cache / f"models--{model_id.replace('/', '--')}"
    snapshot = folder / "snapshots" / ("a" * 40)
    snapshot.mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("a" * 40)
    for name in names:
        (snapshot / name).write_text("{}")
    return snapshot


@pytest.mark.parametrize("model_id", [*LICENCES, MODEL])
def test_what_is_missing_is_said_in_one_sentence(model_id):
    with pytest.raises(DataError) as caught:
        located(model_id, to="edit", what="the model")
    said = str(caught.value)
    assert said == str(missing_weights(model_id, licence_of(model_id), "the model"))
    folder = model_id.split("/")[1]
    for part in (
        model_id,
        f"licence: {LICENCES.get(model_id, 'see its model card')}",
        f"`hf download {model_id} --local-dir {folder}`",
        "editor='physical', which needs no weights",
    ):
        assert part in said
    assert "\n" not in said and ". " not in said


def test_a_model_that_was_fetched_is_found(tmp_path):
    snapshot = fetched(tmp_path / "cache", MODEL)
    assert located(MODEL, to="edit") == snapshot


def test_a_download_that_was_cut_short_is_to_be_repeated(tmp_path):
    fetched(tmp_path / "cache", MODEL, names=("README.md",))
    with pytest.raises(DataError, match=f"hf download {MODEL}"):
        located(MODEL, to="edit")


def test_a_folder_is_itself(tmp_path):
    (tmp_path / "model_index.json").write_text("{}")
    assert located(tmp_path, to="edit") == tmp_path
    with pytest.raises(DataError, match=r"no unet/config\.json in it"):
        located(tmp_path, to="edit", needs=("unet/config.json",))


@pytest.mark.parametrize("name", ["/nowhere/at/all", "nowhere", "a/b/c", "../a", "a/..", ""])
def test_what_is_neither_folder_nor_id_is_refused(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert not is_model_id(name)
    if name in ("", "../a"):
        # Path("") is this folder, which holds no model.
        with pytest.raises(DataError):
            located(name, to="edit")
        return
    with pytest.raises(DataError, match="is no folder, and no model id"):
        located(name, to="edit", what="the model")


def test_without_the_hub_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"weather-aug\[edit\]"):
        located(MODEL, to="edit")


@pytest.fixture
def model(tmp_path):
    for name in ("unet/a.safetensors", "unet/config.json", "vae/b.safetensors"):
        path = tmp_path / "model" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path / "model"


def check_digest_covers_what_is_read(model):
    whole = digest_of(model, ("unet", "vae"))
    assert whole == digest_of(model, ("vae", "unet"))
    weights_file = model / "unet" / "a.safetensors"
    old = weights_file.read_bytes()
    weights_file.write_bytes(old[:-1] + b"!")
    assert digest_of(model, ("unet", "vae")) != whole
    weights_file.write_bytes(old)
    for unread in ("unet/a.fp16.safetensors", "unet/a.bin", "unet/a.md"):
        (model / unread).write_bytes(b"something")
    assert digest_of(model, ("unet", "vae")) == whole
    weights_file.rename(model / "unet" / "c.safetensors")
    assert digest_of(model, ("unet", "vae")) != whole


def test_a_digest_covers_what_is_read(model):
    check_digest_covers_what_is_read(model)


def test_a_digest_of_names_alone_is_caught(model, monkeypatch):
    monkeypatch.setattr(weights, "READ", (".json",))
    with pytest.raises((AssertionError, DataError)):
        check_digest_covers_what_is_read(model)


def test_a_part_without_files_is_refused(model):
    (model / "scheduler").mkdir()
    with pytest.raises(DataError, match="nothing to read"):
        digest_of(model, ("scheduler",))


def test_what_a_library_says_becomes_one_sentence(tmp_path):
    with pytest.raises(DataError, match="no model that can be read: KeyError") as caught:
        with readable(tmp_path):
            raise KeyError("unet\nwith\nlines")
    assert "\n" not in str(caught.value)
