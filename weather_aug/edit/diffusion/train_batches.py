"""Which pairs a training sees, and a step's batch as the objectives want it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from torch.utils.data import DataLoader

from weather_aug._keys import key_of, uniforms
from weather_aug.edit.diffusion.leakage import check_no_leak
from weather_aug.edit.diffusion.pair_data import PairImages, StyleBatches
from weather_aug.edit.diffusion.pairs import PairList
from weather_aug.edit.diffusion.spec import CLEAR
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError, printable
from weather_aug.taxonomy import IGNORE


def chosen(pair_list: PairList, options: TrainOptions) -> PairList:
    """The pairs of the styles that are learnt, when it is certain that none leaks.

    Raises:
        ArgumentError: If a style has no pairs, or they do not go with the objective.
        DataError: If a picture of the split "train" is held out as well.
    """
    styles = options.styles or pair_list.selected("train").styles
    for style in styles:
        pair_list.selected("train", style)
    judged = [pair for pair in pair_list.pairs if pair.split != "train" or pair.style in styles]
    # Of other styles, too: their clear pictures may be the same.
    check_no_leak(replace(pair_list, pairs=tuple(judged)))
    kept = tuple(pair for pair in judged if pair.style in styles)
    if options.objective == "cycle":
        # Clear is where every cycle starts.
        kept = tuple(pair for pair in kept if pair.style != CLEAR)
        if not any(pair.split == "train" for pair in kept):
            raise ArgumentError('the objective "cycle" needs pairs of a style besides clear')
    unaligned = sum(pair.split == "train" and not pair.aligned for pair in kept)
    if options.objective == "paired" and unaligned:
        raise ArgumentError(
            f"{unaligned} pairs of {printable(pair_list.name)!r} show different places; the "
            'objective "paired" compares pixels: take "cycle" or "epsilon", or list aligned pairs '
            "alone"
        )
    return replace(pair_list, pairs=kept)


def batches(
    pair_list: PairList, options: TrainOptions, *, first_step: int = 0
) -> Iterator[dict[str, Any]]:
    """The batch of each step from `first_step` to the options' last; see `collated`.

    Args:
        pair_list: Its split "train" is seen.
        options: How to train.
        first_step: From 0 on.

    Raises:
        DataError: If a picture or label cannot be read.
        IntegrityError: If a picture is not the one that was listed.
    """
    images = PairImages(
        pair_list,
        options.size,
        short_side=options.short_side,
        mirrored=options.mirrored,
        seed=options.seed,
    )
    chosen = StyleBatches(
        pair_list, options.batch_size, options.seed, first_step=first_step, steps=options.steps
    )
    loader: DataLoader[dict[str, Any]] = DataLoader(
        images,
        batch_sampler=chosen,
        collate_fn=collated,
        num_workers=options.workers,
        pin_memory=options.device == "cuda",
        # Nothing is drawn from it; without one the process's own stream is used up.
        generator=torch.Generator(),
    )
    for step, batch in enumerate(loader, start=first_step):
        yield without_labels(batch, step, options)


def collated(items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch of items of one style.

    Args:
        items: Of `PairImages`.

    Returns:
        `source` and `target` (B, 3, H, W) in [-1, 1], `source_label` and `target_label` (B, H, W)
        train ids, `style`, and `aligned`, whether all are.
    """
    tensors = ("source", "target", "source_label", "target_label")
    batch: dict[str, Any] = {name: torch.stack([item[name] for item in items]) for name in tensors}
    (style,) = {item["style"] for item in items}
    return batch | {"style": style, "aligned": all(item["aligned"] for item in items)}


def without_labels(batch: Mapping[str, Any], step: int, options: TrainOptions) -> dict[str, Any]:
    """The batch of a step with some pictures' labels withheld: all of such a label is unknown."""
    changed = dict(batch)
    count = len(batch["source"])
    draws = uniforms(key_of("train.labels", options.seed, step), 2 * count).reshape(2, count)
    for name, numbers in zip(("source_label", "target_label"), draws, strict=True):
        withheld = torch.from_numpy(numbers < options.label_dropout)[:, None, None]
        changed[name] = torch.where(withheld, IGNORE, batch[name])
    return changed


def split(batch: Mapping[str, Any], parts: int) -> Iterator[dict[str, Any]]:
    """Equal parts of a batch, in its order."""
    count = len(batch["source"]) // parts
    for first in range(0, count * parts, count):
        yield {
            name: value[first : first + count] if isinstance(value, torch.Tensor) else value
            for name, value in batch.items()
        }


def counts_of(pair_list: PairList) -> dict[str, int]:
    """Pairs that are trained on, by style."""
    return {
        style: count for (style, split), count in pair_list.counts().items() if split == "train"
    }


def digest_of_pairs(pair_list: PairList) -> str:
    """SHA-256 of what the pairs are, wherever their folder stands."""
    digest = hashlib.sha256()
    for pair in pair_list.pairs:
        digest.update(json.dumps(asdict(pair)).encode() + b"\n")
    return digest.hexdigest()
