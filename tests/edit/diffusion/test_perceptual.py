"""Distances of pictures as a network sees them: the formula, without the adapter, and the names."""

from __future__ import annotations

import copy
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_base import adapted, perturbed, pictures

from weather_aug.edit.diffusion import perceptual
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.perceptual import (
    VGG_FILE,
    BaseEncoder,
    VaeFeatures,
    perceptual_distance,
)
from weather_aug.edit.diffusion.skips import encode
from weather_aug.edit.diffusion.spec import AdapterSpec
from weather_aug.errors import ArgumentError, DataError, MissingExtraError

SPEC = AdapterSpec(prompts={"snow": "snow"}, unet_rank=1, unet_targets=("to_q",))


@pytest.fixture(scope="module")
def vae(small_base: Path) -> Any:
    """The base's own, without an adapter, in float64."""
    return load_base(str(small_base)).vae.double()


@pytest.fixture(scope="module")
def model(small_base: Path) -> AdaptedModel:
    return perturbed(adapted(small_base, SPEC), seed=2).double()


def two_pictures() -> tuple[torch.Tensor, torch.Tensor]:
    image, _ = pictures(2, 16, 24)
    return image.double(), image.double().flip(0) * 0.5 + 0.1


def by_hand(vae: Any, image: torch.Tensor, reference: torch.Tensor) -> list[float]:
    """The definition, one pixel after the other."""
    blocks = [*vae.encoder.down_blocks, vae.encoder.mid_block]
    taken: list[torch.Tensor] = []
    hooks = [
        block.register_forward_pre_hook(lambda _, inputs: taken.append(inputs[0]))
        for block in blocks
    ]
    with torch.no_grad():
        vae.encoder(image)
        vae.encoder(reference)
    for hook in hooks:
        hook.remove()
    found = []
    for sample in range(len(image)):
        layers = []
        for ours, theirs in zip(taken[: len(blocks)], taken[len(blocks) :], strict=True):
            pixels = []
            for a, b in zip(ours[sample].flatten(1).T, theirs[sample].flatten(1).T, strict=True):
                cosine = float(a @ b) / math.sqrt(float(a @ a) * float(b @ b))
                pixels.append(2 - 2 * cosine)
            layers.append(sum(pixels) / len(pixels))
        found.append(sum(layers) / len(layers))
    return found


def test_the_distance_is_that_of_the_base_without_its_adapter(
    vae: Any, model: AdaptedModel
) -> None:
    image, reference = two_pictures()
    wanted = by_hand(vae, image, reference)
    assert VaeFeatures(model.vae)(image, reference).tolist() == pytest.approx(wanted, rel=1e-4)
    assert VaeFeatures(vae)(image, reference).tolist() == pytest.approx(wanted, rel=1e-4)


def test_a_distance_through_the_adapter_is_seen(
    vae: Any, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perceptual, "_without_adapter", copy.deepcopy)
    image, reference = two_pictures()
    wanted = by_hand(vae, image, reference)
    assert VaeFeatures(model.vae)(image, reference).tolist() != pytest.approx(wanted, rel=1e-4)


def test_the_bases_encoder_is_the_base_and_takes_no_memory(vae: Any, model: AdaptedModel) -> None:
    image, _ = two_pictures()
    plain = BaseEncoder(model.vae)
    with torch.no_grad():
        assert torch.equal(encode(plain, image).latent, encode(vae, image).latent)
    own = {parameter.data_ptr() for parameter in model.vae.parameters()}
    assert {parameter.data_ptr() for parameter in plain.parameters()} <= own
    assert not [name for name, _ in plain.named_parameters() if "lora" in name]


def test_asking_it_changes_nothing_in_the_model(model: AdaptedModel) -> None:
    image, reference = two_pictures()
    flags = {name: p.requires_grad for name, p in model.named_parameters()}
    with torch.no_grad():
        before = model(image, None, "snow")
        VaeFeatures(model.vae)(image, reference)
        assert torch.equal(model(image, None, "snow"), before)
    assert flags == {name: p.requires_grad for name, p in model.named_parameters()}


def test_gradients_reach_the_picture_alone(model: AdaptedModel) -> None:
    image, reference = (picture.requires_grad_() for picture in two_pictures())
    found = {}
    for checkpointing in (False, True):
        image.grad = None
        VaeFeatures(model.vae, checkpointing=checkpointing)(image, reference).sum().backward()
        assert image.grad is not None
        found[checkpointing] = image.grad
    assert torch.equal(found[False], found[True])
    assert float(found[False].abs().min()) > 0
    assert reference.grad is None
    assert all(parameter.grad is None for parameter in model.parameters())


def test_equal_pictures_are_not_apart_and_a_black_one_has_a_gradient(vae: Any) -> None:
    distance = VaeFeatures(vae)
    image, reference = two_pictures()
    assert distance(image, image).tolist() == [0.0, 0.0]
    assert all(0 < value < 4 for value in distance(image, reference).tolist())
    zero = torch.zeros_like(image).requires_grad_()
    distance(zero, image).sum().backward()
    assert zero.grad is not None
    assert torch.isfinite(zero.grad).all()


def test_names(vae: Any) -> None:
    assert perceptual_distance("none", vae) is None
    assert isinstance(perceptual_distance("vae", vae), VaeFeatures)
    with pytest.raises(ArgumentError, match=r"vgg.*vae, lpips, none"):
        perceptual_distance("vgg", vae)  # type: ignore[arg-type]


def test_lpips_that_is_not_installed_is_named(vae: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(MissingExtraError, match=r"pip install lpips.*'vae'"):
        perceptual_distance("lpips", vae)


def test_lpips_never_fetches_its_weights(
    vae: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Net(torch.nn.Module):
        def forward(self, image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
            return (image - reference).square().mean((1, 2, 3), keepdim=True)

    asked: list[dict[str, Any]] = []
    package = SimpleNamespace(LPIPS=lambda **options: asked.append(options) or Net())
    monkeypatch.setitem(sys.modules, "lpips", package)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(DataError, match=f"BSD-3-Clause.*curl.*{VGG_FILE}"):
        perceptual_distance("lpips", vae)
    assert not asked
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / VGG_FILE).touch()
    distance = perceptual_distance("lpips", vae)
    image, reference = two_pictures()
    assert distance is not None
    assert distance(image, reference).shape == (2,)
    assert asked == [{"net": "vgg", "verbose": False}]
