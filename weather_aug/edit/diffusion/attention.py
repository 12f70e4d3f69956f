"""Temporal-View attention: self-attention whose queries also look at other pictures of the batch.

Convention:
    An attention layer keeps its weights; what it does with them is a processor of diffusers, which
    is replaced for a while. The layer's queries of a picture meet keys and values of the picture
    itself, of another camera's, and of the same camera's before and after; the results are added
    with fixed weights. Nothing is learnt.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

from weather_aug.edit.diffusion.options import AttentionWeights
from weather_aug.edit.diffusion.references import Links
from weather_aug.errors import ArgumentError

SELF_ATTENTION = "attn1"
"""What diffusers calls the self-attention of a transformer block."""


class TemporalViewProcessor:
    """Processor of diffusers' `Attention` for one batch layout, in place of its `AttnProcessor2_0`.

    The output is `itself * Self + view * View + before * Before + after * After` before the
    layer's output projection. Terms of weight 0 are not computed, and references that coincide are
    computed once with the sum of their weights; where every picture refers only to itself with a
    weight of 1 the bits are the stock processor's.

    Each picture is attended to on its own: what grows with their number is tensors of the size of
    the layer's output, never a matrix of tokens by tokens where torch has a fused attention. A
    picture's attention does not depend on where in the batch it stands.
    """

    def __init__(self, links: Links, weights: AttentionWeights):
        self._shares = shares(links, weights)

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
    ) -> Tensor:
        """Attention of a batch to itself and its references, as diffusers calls it.

        Args:
            attn: The `Attention` layer; its projections may be low-rank layers of peft.
            hidden_states: (B, tokens, channels) or (B, channels, height, width).
            encoder_hidden_states: Has to be None: this is self-attention.
            attention_mask: (B, 1, tokens), added to the scores of a picture's keys, whoever looks
                at them.
            temb: For a layer with a spatial norm.

        Returns:
            Of the shape of `hidden_states`.

        Raises:
            ArgumentError: If the batch is not as long as the links, or there are encoder states.
        """
        batch = hidden_states.shape[0]
        if batch != len(self._shares):
            raise ArgumentError(
                f"the links are for a batch of {len(self._shares)} pictures, this one has {batch}; "
                "make them with window_links from the pictures of the batch"
            )
        if encoder_hidden_states is not None:
            raise ArgumentError(
                "Temporal-View attention is self-attention, but this layer attends to encoder "
                "states; leave its processor as it is"
            )
        residual = hidden_states
        if attn.spatial_norm is not None:
            hidden_states = attn.spatial_norm(hidden_states, temb)
        shape = hidden_states.shape
        if len(shape) == 4:
            hidden_states = hidden_states.flatten(2).transpose(1, 2)
        tokens = hidden_states.shape[1]
        mask = attn.prepare_attention_mask(attention_mask, tokens, batch)
        if mask is not None:
            mask = mask.view(batch, attn.heads, -1, mask.shape[-1])
        if attn.group_norm is not None:
            hidden_states = attn.group_norm(hidden_states.transpose(1, 2)).transpose(1, 2)

        query, key, value = (
            projection(hidden_states).unflatten(-1, (attn.heads, -1)).transpose(1, 2)
            for projection in (attn.to_q, attn.to_k, attn.to_v)
        )
        if attn.norm_q is not None:
            query = attn.norm_q(query)
        if attn.norm_k is not None:
            key = attn.norm_k(key)
        hidden_states = _attended(query, key, value, mask, self._shares)
        hidden_states = hidden_states.transpose(1, 2).flatten(2).to(query.dtype)

        hidden_states = attn.to_out[1](attn.to_out[0](hidden_states))
        if len(shape) == 4:
            hidden_states = hidden_states.transpose(1, 2).reshape(shape)
        if attn.residual_connection:
            hidden_states = hidden_states + residual
        return hidden_states / attn.rescale_output_factor


def shares(links: Links, weights: AttentionWeights) -> tuple[dict[int, float], ...]:
    """For each picture the weights of those it looks at, by batch index; none is 0."""
    terms = (
        (weights.itself, range(len(links))),
        (weights.view, links.view),
        (weights.before, links.before),
        (weights.after, links.after),
    )
    found = []
    for this in range(len(links)):
        by_source: dict[int, list[float]] = {}
        for weight, sources in terms:
            if weight:
                by_source.setdefault(sources[this], []).append(weight)
        # Exactly rounded sums: the release's four weights are 1 where all fall on one picture.
        found.append({source: math.fsum(parts) for source, parts in by_source.items()})
    return tuple(found)


def _attended(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    mask: Tensor | None,
    shares_by_picture: tuple[dict[int, float], ...],
) -> Tensor:
    """(B, heads, tokens, channels of a head): each picture's weighted sum over its sources."""
    if all(by_source == {this: 1.0} for this, by_source in enumerate(shares_by_picture)):
        return scaled_dot_product_attention(query, key, value, attn_mask=mask)
    mixed = []
    for this, by_source in enumerate(shares_by_picture):
        terms = (
            weight
            * scaled_dot_product_attention(
                query[this : this + 1],
                key[source : source + 1],
                value[source : source + 1],
                attn_mask=None if mask is None else mask[source : source + 1],
            )
            for source, weight in by_source.items()
        )
        mixed.append(reduce(torch.add, terms))
    return torch.cat(mixed)


@contextmanager
def temporal_view(unet: torch.nn.Module, links: Links, weights: AttentionWeights) -> Iterator[None]:
    """Let a UNet's self-attentions look at other pictures of its batch, inside a `with` block.

    Attention to text stays as it is, and so does the UNet after the block, errors included. With
    gradient checkpointing the backward pass runs layers again and belongs inside the block too.

    Args:
        unet: diffusers' `UNet2DConditionModel`, with or without low-rank layers of peft. It is
            changed inside the block, so that it serves one batch layout at a time.
        links: Of the pictures of the batch.
        weights: Of the four terms.

    Raises:
        ArgumentError: If the UNet has no self-attention; from its forward pass, if a batch is not
            as long as the links.
    """
    layers = [
        module
        for name, module in unet.named_modules()
        if name.rpartition(".")[2] == SELF_ATTENTION and hasattr(module, "set_processor")
    ]
    if not layers:
        raise ArgumentError(f"the UNet has no self-attention named {SELF_ATTENTION}")
    stock: list[tuple[Any, Any]] = [(layer, layer.processor) for layer in layers]
    processor = TemporalViewProcessor(links, weights)
    try:
        for layer, _ in stock:
            layer.set_processor(processor)
        yield
    finally:
        for layer, previous in stock:
            layer.set_processor(previous)
