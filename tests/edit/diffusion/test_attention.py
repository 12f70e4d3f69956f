"""Temporal-View attention: against loops in float64, and in a UNet of diffusers."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.edit.diffusion import attention as module
from weather_aug.edit.diffusion.attention import TemporalViewProcessor, temporal_view
from weather_aug.edit.diffusion.options import (
    RELEASE_WEIGHTS,
    SELF_ONLY,
    AttentionWeights,
    paper_weights,
)
from weather_aug.edit.diffusion.references import VIEW_TABLES, Links, window_links
from weather_aug.errors import ArgumentError

pytest.importorskip("diffusers")

Float64 = NDArray[np.float64]

UNEVEN = AttentionWeights(0.5, 0.25, 0.15, 0.05)
"""All different, so that none can stand for another."""
HEADS, HEAD_CHANNELS, CHANNELS, TOKENS = 2, 3, 5, 7


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def with_random_parameters(network: Any, seed: int = 0) -> Any:
    """Norms and biases as well, so that one that is forgotten shows."""
    with torch.no_grad():
        for index, parameter in enumerate(network.parameters()):
            scale = 0.3 if parameter.ndim > 1 else 0.5
            parameter += scale * random(*parameter.shape, seed=1000 * seed + index).to(parameter)
    return network.eval()


def layer(**options: Any) -> Any:
    from diffusers.models.attention_processor import Attention

    channels = options.pop("query_dim", CHANNELS)
    made = Attention(query_dim=channels, heads=HEADS, dim_head=HEAD_CHANNELS, **options)
    return with_random_parameters(made.double())


def array(tensor: Tensor) -> Float64:
    return tensor.detach().numpy()


def softmax(scores: Float64) -> Float64:
    raised = np.exp(scores - scores.max())
    return raised / raised.sum()


def looked(of: Any, queries_from: Float64, keys_from: Float64, bias: Float64) -> Float64:
    """(tokens, channels): one picture's queries to one picture's keys, token by token."""
    query = queries_from @ array(of.to_q.weight).T
    key = keys_from @ array(of.to_k.weight).T
    value = keys_from @ array(of.to_v.weight).T
    out = np.zeros_like(query)
    for head in range(HEADS):
        own = slice(head * HEAD_CHANNELS, (head + 1) * HEAD_CHANNELS)
        for token in range(len(query)):
            scores = key[:, own] @ query[token, own] / math.sqrt(HEAD_CHANNELS) + bias
            out[token, own] = softmax(scores) @ value[:, own]
    return out


def by_loops(
    of: Any,
    states: Float64,
    views: tuple[int, ...],
    weights: AttentionWeights,
    bias: Float64 | None = None,
) -> Float64:
    """The equation, picture by picture: pictures of every view at every time, time by time."""
    times = len(states) // len(views)
    bias = np.zeros(states.shape[:2]) if bias is None else bias
    out = []
    for time in range(times):
        for view, reference in enumerate(views):
            this = time * len(views) + view
            terms = (
                (weights.itself, this),
                (weights.view, time * len(views) + reference),
                (weights.before, max(time - 1, 0) * len(views) + view),
                (weights.after, min(time + 1, times - 1) * len(views) + view),
            )
            mixed = sum(
                weight * looked(of, states[this], states[source], bias[source])
                for weight, source in terms
            )
            projection = of.to_out[0]
            out.append(mixed @ array(projection.weight).T + array(projection.bias))
    return np.stack(out)


def links_of(views: tuple[int, ...], times: int) -> Links:
    names = [f"camera {view}" for view in range(len(views))]
    references = {name: names[view] for name, view in zip(names, views, strict=True)}
    return window_links([names] * times, references)


def check_against_loops(
    tables: Mapping[int, tuple[int, ...]] = VIEW_TABLES, weights: AttentionWeights = UNEVEN
) -> None:
    of = layer()
    for count, views in VIEW_TABLES.items():
        for times in (1, 2, 3):
            states = random(count * times, TOKENS, CHANNELS, seed=count)
            expected = by_loops(of, states.numpy(), views, weights)
            of.set_processor(TemporalViewProcessor(links_of(tables[count], times), weights))
            with torch.no_grad():
                np.testing.assert_allclose(array(of(states)), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("weights", (RELEASE_WEIGHTS, paper_weights(), UNEVEN, SELF_ONLY))
def test_it_is_the_equation_for_every_table_and_window(weights: AttentionWeights) -> None:
    check_against_loops(weights=weights)


_SHARES = module.shares


def _attended_with_own_values(
    query: Tensor, key: Tensor, value: Tensor, mask: None, shares: tuple[dict[int, float], ...]
) -> Tensor:
    rows = [
        sum(
            weight
            * module.scaled_dot_product_attention(
                query[this : this + 1], key[source : source + 1], value[this : this + 1]
            )
            for source, weight in share.items()
        )
        for this, share in enumerate(shares)
    ]
    return torch.cat(rows)


def _without_itself(links: Links, weights: AttentionWeights) -> tuple[dict[int, float], ...]:
    return tuple(
        {source: weight for source, weight in share.items() if source != this} or share
        for this, share in enumerate(_SHARES(links, weights))
    )


def _last_wins(links: Links, weights: AttentionWeights) -> tuple[dict[int, float], ...]:
    """References that coincide, but their weights are not added."""
    named = (weights.view, links.view), (weights.before, links.before), (weights.after, links.after)
    return tuple(
        {this: weights.itself} | {sources[this]: weight for weight, sources in named}
        for this in range(len(links))
    )


FAULTS: dict[str, tuple[str, Callable[..., Any]]] = {
    "before for after": (
        "shares",
        lambda links, weights: _SHARES(Links(links.view, links.after, links.before), weights),
    ),
    "weights of view and before": (
        "shares",
        lambda links, w: _SHARES(links, AttentionWeights(w.itself, w.before, w.view, w.after)),
    ),
    "itself forgotten": ("shares", _without_itself),
    "weights not added": ("shares", _last_wins),
    "values of its own": ("_attended", _attended_with_own_values),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_loops_catch(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, *FAULTS[fault])
    with pytest.raises(AssertionError):
        check_against_loops()


WRONG_TABLES = {
    "all at the front": (5, (0, 0, 0, 0, 0)),
    "sides crossed": (5, (0, 0, 0, 2, 1)),
    "pair looks left": (2, (0, 0)),
    "back at the right": (6, (0, 0, 0, 1, 2, 4)),
}


@pytest.mark.parametrize("fault", WRONG_TABLES)
def test_the_loops_catch_a_wrong_table(fault: str) -> None:
    count, views = WRONG_TABLES[fault]
    with pytest.raises(AssertionError):
        check_against_loops(tables={**VIEW_TABLES, count: views})


def test_a_mask_goes_with_the_keys() -> None:
    of = layer()
    states = random(3, TOKENS, CHANNELS)
    bias = np.zeros((3, TOKENS))
    bias[0, 2:], bias[1, :3] = -1e4, -1e4
    of.set_processor(TemporalViewProcessor(links_of((0, 0, 0), 1), UNEVEN))
    with torch.no_grad():
        found = of(states, attention_mask=torch.from_numpy(bias)[:, None])
    np.testing.assert_allclose(
        array(found), by_loops(of, states.numpy(), (0, 0, 0), UNEVEN, bias), rtol=0, atol=1e-10
    )


LAYERS: dict[str, dict[str, Any]] = {
    "plain": {},
    "as in a VAE": {
        "query_dim": 6,
        "norm_num_groups": 3,
        "residual_connection": True,
        "rescale_output_factor": 1.7,
        "bias": True,
    },
    "normed queries": {"qk_norm": "layer_norm", "dropout": 0.5},
    "spatial norm": {"query_dim": 32, "spatial_norm_dim": 4},
}


@pytest.mark.parametrize("name", LAYERS)
def test_every_part_of_the_stock_layer_is_kept(name: str) -> None:
    """Equal bits, of tokens and of pictures."""
    of = layer(**LAYERS[name])
    channels = of.to_q.in_features
    temb = random(3, 4, 4, 6, seed=2) if of.spatial_norm is not None else None
    inputs = [random(3, channels, 4, 6)]
    if temb is None:
        inputs.append(random(3, TOKENS, channels))
    for states in inputs:
        with torch.no_grad():
            of.set_processor(TemporalViewProcessor(links_of((0, 0, 0), 1), SELF_ONLY))
            ours = of(states, temb=temb)
            of.set_processor(type(of)(channels).processor)
            assert torch.equal(of(states, temb=temb), ours)


def test_pictures_are_attended_to_one_by_one_and_what_has_no_weight_not_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of five views at three times: each sees itself, 4 their view, each the times there are."""
    batches = []
    stock = module.scaled_dot_product_attention

    def counted(query: Tensor, *args: Any, **options: Any) -> Tensor:
        batches.append(len(query))
        return stock(query, *args, **options)

    monkeypatch.setattr(module, "scaled_dot_product_attention", counted)
    of, states = layer(), random(15, TOKENS, CHANNELS)
    for weights, calls in (
        (RELEASE_WEIGHTS, 15 + 3 * 4 + 2 * (2 * 5)),
        (AttentionWeights(0.6, 0.4, 0, 0), 15 + 3 * 4),
        (AttentionWeights(0.6, 0, 0.2, 0.2), 15 + 2 * (2 * 5)),
    ):
        batches.clear()
        of.set_processor(TemporalViewProcessor(links_of(VIEW_TABLES[5], 3), weights))
        of(states)
        assert [1] * calls == batches
    batches.clear()
    of.set_processor(TemporalViewProcessor(links_of(VIEW_TABLES[5], 3), SELF_ONLY))
    of(states)
    assert [15] == batches


CAMERAS = ("a", "b", "c")


@given(
    st.lists(st.lists(st.sampled_from(CAMERAS), unique=True), min_size=1, max_size=3).filter(any),
    st.fixed_dictionaries({name: st.sampled_from(CAMERAS) for name in CAMERAS}),
)
@settings(max_examples=25, deadline=None)
def test_the_weight_of_a_missing_camera_falls_to_the_picture_itself(
    times: list[list[str]], references: dict[str, str]
) -> None:
    of = layer()
    pictures = [(time, name) for time, names in enumerate(times) for name in names]
    states = random(len(pictures), TOKENS, CHANNELS)
    of.set_processor(TemporalViewProcessor(window_links(times, references), UNEVEN))
    with torch.no_grad():
        found = array(of(states))
    state_by_picture = dict(zip(pictures, states.numpy(), strict=True))
    no_bias = np.zeros(TOKENS)
    for (time, name), got in zip(pictures, found, strict=True):
        own = state_by_picture[time, name]
        mixed = sum(
            weight * looked(of, own, state_by_picture.get(wanted, own), no_bias)
            for weight, wanted in (
                (UNEVEN.itself, (time, name)),
                (UNEVEN.view, (time, references[name])),
                (UNEVEN.before, (time - 1, name)),
                (UNEVEN.after, (time + 1, name)),
            )
        )
        expected = mixed @ array(of.to_out[0].weight).T + array(of.to_out[0].bias)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10)


@pytest.fixture(scope="module")
def unet() -> Any:
    """Of the shape of SD-Turbo's, tiny: self-attentions on the way down, in the middle and up."""
    from diffusers import UNet2DConditionModel

    made = UNet2DConditionModel(
        sample_size=8,
        layers_per_block=1,
        block_out_channels=(8, 16),
        norm_num_groups=4,
        cross_attention_dim=8,
        attention_head_dim=4,
        use_linear_projection=True,
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
    )
    return with_random_parameters(made)


def noise(unet: Any, pictures: Tensor) -> Tensor:
    text = random(1, 4, 8, seed=7).to(pictures).expand(len(pictures), -1, -1)
    return unet(pictures, 999, encoder_hidden_states=text).sample


def latents(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return random(count, 4, 8, 8, dtype=dtype)


def edited(unet: Any, pictures: Tensor, links: Links, weights: AttentionWeights = UNEVEN) -> Tensor:
    with torch.no_grad(), temporal_view(unet, links, weights):
        return noise(unet, pictures)


@torch.no_grad()
def test_with_itself_alone_the_unet_gives_the_stock_bits(unet: Any) -> None:
    pictures = latents(9)
    stock = noise(unet, pictures)
    assert torch.equal(stock, edited(unet, pictures, links_of((0, 0, 0), 3), SELF_ONLY))
    assert not torch.allclose(stock, edited(unet, pictures, links_of((0, 0, 0), 3)), atol=1e-2)
    # One picture of a clip of one frame: the release's four weights fall on it, and add to 1.
    one = edited(unet, pictures[:1], links_of((0,), 1), RELEASE_WEIGHTS)
    assert torch.equal(noise(unet, pictures[:1]), one)


def test_two_runs_are_equal(unet: Any) -> None:
    links = links_of((0, 0, 0), 3)
    assert torch.equal(edited(unet, latents(9), links), edited(unet, latents(9), links))


@pytest.mark.parametrize("seed", range(3))
def test_another_order_of_the_pictures_gives_the_same_pictures(unet: Any, seed: int) -> None:
    pictures, links = latents(9, torch.float64), links_of((0, 0, 0), 3)
    order = np.random.default_rng(seed).permutation(9)
    place = np.argsort(order)
    permuted = Links(
        *(
            tuple(int(place[indices[this]]) for this in order)
            for indices in (links.view, links.before, links.after)
        )
    )
    unet.double()
    try:
        straight = edited(unet, pictures, links)
        mixed = edited(unet, pictures[order], permuted)
    finally:
        unet.float()
    # GEMMs of a batch may round by where a row stands.
    torch.testing.assert_close(straight[order], mixed, rtol=0, atol=1e-12)


def reached(links: Links, changed: int) -> set[int]:
    """Pictures that look at a picture, or at one that does, through all layers."""
    found = {changed}
    for _ in range(len(links)):
        found |= {
            this
            for this in range(len(links))
            if found & {links.view[this], links.before[this], links.after[this]}
        }
    return found


@pytest.mark.parametrize("changed", range(5))
def test_a_picture_that_nobody_looks_at_changes_no_other(unet: Any, changed: int) -> None:
    links = links_of(VIEW_TABLES[5], 1)
    pictures = latents(5)
    others = pictures.clone()
    others[changed] += 1
    same = (edited(unet, pictures, links) == edited(unet, others, links)).flatten(1).all(1)
    assert reached(links, changed) == set(np.flatnonzero(~same.numpy()).tolist())


def test_only_self_attention_is_replaced_and_only_inside_the_block(unet: Any) -> None:
    before = dict(unet.attn_processors)
    with temporal_view(unet, links_of((0,), 1), UNEVEN):
        inside = unet.attn_processors
    for name, processor in inside.items():
        assert isinstance(processor, TemporalViewProcessor) == name.endswith("attn1.processor")
        assert processor is before[name] or name.endswith("attn1.processor")
    assert before == unet.attn_processors
    with pytest.raises(KeyError), temporal_view(unet, links_of((0,), 1), UNEVEN):
        raise KeyError
    assert before == unet.attn_processors


def test_what_does_not_fit_is_refused_and_the_unet_left_whole(unet: Any) -> None:
    before = dict(unet.attn_processors)
    with pytest.raises(ArgumentError, match="for a batch of 2 pictures, this one has 3"):
        edited(unet, latents(3), links_of((1, 0), 1))
    assert before == unet.attn_processors
    with (
        pytest.raises(ArgumentError, match="no self-attention"),
        temporal_view(torch.nn.Linear(1, 1), links_of((0,), 1), UNEVEN),
    ):
        pass
    of = layer()
    of.set_processor(TemporalViewProcessor(links_of((0,), 1), UNEVEN))
    states = random(1, TOKENS, CHANNELS)
    with pytest.raises(ArgumentError, match="attends to encoder states"):
        of(states, encoder_hidden_states=states)


@torch.no_grad()
def test_low_rank_layers_act_as_the_weights_that_they_add_up_to(unet: Any) -> None:
    peft = pytest.importorskip("peft")
    adapted = copy.deepcopy(unet).double()
    pictures, links = latents(6, torch.float64), links_of((0, 0), 3)
    without = edited(adapted, pictures, links)
    config = peft.LoraConfig(r=2, lora_alpha=2, target_modules=["to_q", "to_k", "to_v", "to_out.0"])
    adapted.add_adapter(config, adapter_name="rain")
    for index, (name, parameter) in enumerate(adapted.named_parameters()):
        if "lora_" in name:
            parameter.copy_(0.3 * random(*parameter.shape, seed=index))
    low_rank = edited(adapted, pictures, links)
    assert torch.equal(noise(adapted, pictures), edited(adapted, pictures, links, SELF_ONLY))
    adapted.fuse_lora()
    torch.testing.assert_close(edited(adapted, pictures, links), low_rank, rtol=0, atol=1e-10)
    assert not torch.allclose(without, low_rank, atol=1e-2)


def test_gradients_are_the_same_with_checkpointing(unet: Any) -> None:
    links, pictures = links_of((0, 0), 2), latents(4)

    def gradient(inside: bool) -> Tensor:
        unet.zero_grad()
        with temporal_view(unet, links, UNEVEN):
            loss = noise(unet, pictures).square().mean()
            if inside:
                loss.backward()
        if not inside:
            loss.backward()
        return unet.mid_block.attentions[0].transformer_blocks[0].attn1.to_k.weight.grad.clone()

    unet.train()
    try:
        plain = gradient(inside=True)
        unet.enable_gradient_checkpointing()
        assert torch.equal(plain, gradient(inside=True))
        assert plain.abs().max() > 0
        # Outside, the layers would run again without their references; torch notices.
        with pytest.raises(torch.utils.checkpoint.CheckpointError):
            gradient(inside=False)
    finally:
        unet.disable_gradient_checkpointing()
        unet.eval().zero_grad()
