"""h = W0 x + sum_i w_i L_i x: the algebra of the adapter, on a small model of the real shape."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_base import adapted, perturbed, pictures

from weather_aug.edit.diffusion.adapted import SET, AdaptedModel, FullConv
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.checkpointing import enable_checkpointing
from weather_aug.edit.diffusion.skips import decode, encode
from weather_aug.edit.diffusion.spec import CLEAR, PROMPTS, AdapterSpec
from weather_aug.errors import ArgumentError, DataError


@pytest.fixture(scope="module")
def model(small_base: Path) -> AdaptedModel:
    """Trained, or so it looks: every tensor has been moved away from zero."""
    return perturbed(adapted(small_base), seed=3)


def low_rank_layers(network: Any) -> Iterator[tuple[str, Any]]:
    from peft.tuners.lora import LoraLayer

    for name, layer in network.named_modules():
        if isinstance(layer, LoraLayer):
            yield name, layer


def by_hand(layer: Any, x: torch.Tensor, weights: dict[str, float], scale: float) -> torch.Tensor:
    """W0 x + sum_i w_i s B_i A_i x, in float64 and without peft."""
    out = layer.base_layer.double()(x)
    for name, weight in weights.items():
        out = out + weight * scale * layer.lora_B[name](layer.lora_A[name](x))
    return out


def an_input(layer: Any) -> torch.Tensor:
    base = layer.base_layer
    generator = torch.Generator().manual_seed(5)
    if isinstance(base, torch.nn.Conv2d):
        shape = (2, base.in_channels, 6, 8)
    else:
        shape = (2, 7, base.in_features)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    "weights", [{"snow": 1.0}, {"snow": 0.5, "rain": 0.3, CLEAR: 0.2}, {"fog": 0.25, CLEAR: 0.75}]
)
def test_every_layer_of_the_unet_adds_its_sets(small_base: Path, weights: dict[str, float]) -> None:
    model = perturbed(adapted(small_base), seed=3).double()
    kinds = set()
    with torch.no_grad(), model.styled(weights):
        for name, layer in low_rank_layers(model.unet):
            x = an_input(layer)
            expected = by_hand(layer, x, {SET.format(k): w for k, w in weights.items()}, 1.0)
            assert (layer(x) - expected).abs().max() <= 1e-6, name
            kinds.add((type(layer.base_layer), name.rsplit(".", 1)[-1]))
    assert {kind for kind, _ in kinds} == {torch.nn.Linear, torch.nn.Conv2d}
    wanted = {"to_q", "to_k", "to_v", "0", "proj_in", "proj_out", "proj", "2", "conv1", "conv2"}
    assert wanted | {"conv_out", "conv_shortcut"} <= {name for _, name in kinds}


def test_every_layer_of_the_vae_adds_the_shared_set(small_base: Path) -> None:
    model = perturbed(adapted(small_base), seed=3).double()
    count = 0
    with torch.no_grad():
        for name, layer in low_rank_layers(model.vae):
            x = an_input(layer)
            expected = by_hand(layer, x, {"shared": 1.0}, model.spec.vae_scale)
            assert (layer(x) - expected).abs().max() <= 1e-6, name
            count += 1
    assert count > 20


def test_the_first_convolution_adds_its_change(model: AdaptedModel) -> None:
    conv = model.unet.conv_in
    assert isinstance(conv, FullConv)
    x = torch.randn(1, conv.base.in_channels, 4, 4, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        whole = torch.nn.functional.conv2d(
            x,
            conv.base.weight + conv.change.weight,
            conv.base.bias + conv.change.bias,
            padding=conv.base.padding,
        )
        assert (conv(x) - whole).abs().max() <= 1e-5


def test_a_weight_at_the_wrong_set_is_noticed(small_base: Path) -> None:
    """The algebra's check can fail."""
    model = perturbed(adapted(small_base), seed=3).double()
    name, layer = next(low_rank_layers(model.unet))
    x = an_input(layer)
    with torch.no_grad(), model.styled("snow"):
        wrong = by_hand(layer, x, {SET.format("rain"): 1.0}, 1.0)
        assert (layer(x) - wrong).abs().max() > 1e-3, name


def test_untrained_it_is_the_base(small_base: Path) -> None:
    image, label = pictures()
    base = load_base(str(small_base))
    with torch.no_grad():
        latent = encode(base.vae, image).latent
        prompt = base.embed([PROMPTS["snow"]])
        noise = base.unet(latent, 999, encoder_hidden_states=prompt).sample
        alpha = base.alpha_bar
        latent = (latent - (1 - alpha) ** 0.5 * noise) / alpha**0.5
        expected = decode(base.vae, latent)
        assert torch.equal(adapted(small_base)(image, label, "snow"), expected)


def base_tensors(model: AdaptedModel) -> dict[str, torch.Tensor]:
    own = set(model.trained())
    return {name: tensor.clone() for name, tensor in model.named_parameters() if name not in own}


def test_switching_styles_leaves_the_base_untouched(model: AdaptedModel) -> None:
    image, label = pictures()
    before = base_tensors(model)
    with torch.no_grad():
        first = model(image, label, "snow")
        for style in ("rain", {"fog": 0.5, "rain": 0.5}, "clear"):
            assert not torch.equal(model(image, label, style), first)
        assert torch.equal(model(image, label, "snow"), first)
    after = base_tensors(model)
    assert all(torch.equal(after[name], tensor) for name, tensor in before.items())
    fresh = base_tensors(adapted_again(model))
    assert all(torch.equal(fresh[name], tensor) for name, tensor in before.items())


def adapted_again(model: AdaptedModel) -> AdaptedModel:
    return adapted(model.base.folder)


def test_what_was_active_is_active_again_after_an_error(model: AdaptedModel) -> None:
    image, label = pictures()
    with torch.no_grad(), model.styled("rain") as prompt:
        latent = model.encode(image, label).latent
        before = model.noise(latent, prompt)
        with pytest.raises(RuntimeError), model.styled("fog"):
            raise RuntimeError
        assert torch.equal(model.noise(latent, prompt), before)


def test_only_the_set_that_acted_and_the_shared_parts_get_gradients(small_base: Path) -> None:
    """Also where others act by the time of the backward pass."""
    image, label = pictures()
    model = perturbed(adapted(small_base), seed=3)
    out = model(image, label, "rain")
    with model.styled("snow"):
        out.square().mean().backward()
    learning = {name for name, p in model.named_parameters() if p.grad is not None}
    assert learning == {
        name
        for name in model.trained()
        if not name.startswith("unet.")
        or f".{SET.format('rain')}." in name
        or name.startswith("unet.conv_in.change.")
    }


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(("rain", "snow", "fog")), st.floats(0, 0.33), min_size=1, max_size=3
    )
)
def test_a_blend_fades_to_clear(model: AdaptedModel, weights: dict[str, float]) -> None:
    whole = model.weights_of(weights)
    assert sum(whole.values()) == pytest.approx(1)
    assert all(whole.get(name, 0) == weight for name, weight in weights.items())


def test_without_a_clear_style_a_blend_is_as_given(small_base: Path) -> None:
    spec = AdapterSpec(prompts={"snow": PROMPTS["snow"]}, unet_rank=2)
    model = adapted(small_base, spec)
    assert model.weights_of({"snow": 0.4}) == {"snow": 0.4}
    with pytest.raises(ArgumentError, match="above 0"):
        model.weights_of({"snow": 0.0})


@pytest.mark.parametrize(
    ("style", "message"),
    [
        ("hail", "hail"),
        ({"snow": -0.1}, r"\[0, 1\]"),
        ({"snow": float("nan")}, r"\[0, 1\]"),
        ({"snow": 0.8, "rain": 0.3}, "sum to 1.1"),
    ],
)
def test_a_style_that_is_none_is_refused(model: AdaptedModel, style: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message), model.styled(style):
        pass


def test_prompts_are_blended_like_the_sets(model: AdaptedModel) -> None:
    with model.styled("snow") as snow, model.styled("rain") as rain:
        pass
    with model.styled({"snow": 0.25, "rain": 0.75}) as both:
        assert torch.allclose(both, 0.25 * snow + 0.75 * rain, atol=1e-6)


def test_checkpointing_changes_no_gradient(small_base: Path) -> None:
    image, label = pictures()
    gradients = []
    for checkpointing in (False, True):
        model = perturbed(adapted(small_base), seed=3)
        if checkpointing:
            enable_checkpointing(model)
        model(image, label, "snow").square().mean().backward()
        gradients.append({k: p.grad for k, p in model.trained().items() if p.grad is not None})
    assert gradients[0].keys() == gradients[1].keys() and gradients[0]
    for name, gradient in gradients[0].items():
        assert torch.allclose(gradient, gradients[1][name], rtol=1e-4, atol=1e-7), name


def test_tensors_of_another_shape_are_refused(small_base: Path) -> None:
    model = adapted(small_base)
    tensors = {name: p.detach().clone() for name, p in model.trained().items()}
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    last = sorted(tensors)[-1]
    for broken, message in [
        ({k: v for k, v in tensors.items() if k != last}, "another shape"),
        (tensors | {"unet.more": torch.zeros(1)}, "unet.more"),
        (tensors | {last: torch.zeros(1, 2, 3)}, r"\(1, 2, 3\)"),
        (tensors | {last: tensors[last] * float("nan")}, "NaN"),
    ]:
        with pytest.raises(DataError, match=message):
            model.load_trained(broken)
    assert all(torch.equal(p, before[name]) for name, p in model.trained().items())


def test_targets_that_are_nowhere_are_refused(small_base: Path) -> None:
    with pytest.raises(ArgumentError, match="no_such_layer"):
        adapted(small_base, AdapterSpec(unet_targets=("no_such_layer",), unet_rank=2))
    with pytest.raises(ArgumentError, match="conv_in"):
        AdapterSpec(unet_targets=("conv_in", "to_q"))


def test_the_order_in_which_a_blend_is_given_changes_no_bit(model: AdaptedModel) -> None:
    blend = {"snow": 0.3, "fog": 0.2, "rain": 0.5}
    other = dict(reversed(blend.items()))
    assert list(model.weights_of(blend)) == list(model.weights_of(other))


def test_rounding_is_no_share_of_clear(model: AdaptedModel) -> None:
    assert set(model.weights_of({"snow": 0.7, "rain": 0.3 - 1e-12})) == {"snow", "rain"}
