"""HRDA and MIC in small: a network of two scales, its averaged teacher, and one step of training.

DACS (Tranheden et al., 2021): a teacher's pseudo-labels, mixed by class; HRDA (Hoyer et al., 2022):
context and detail under scale attention; MIC (Hoyer et al., 2023): masked consistency. Left out:
the distance to ImageNet's features, which needs weights, and the margins of pseudo-labels.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers import SegformerConfig, SegformerForSemanticSegmentation
from transformers.models.segformer.modeling_segformer import SegformerDecodeHead
from uda.frames import augmented

from weather_aug._keys import key_of
from weather_aug.taxonomy import CLASSES, IGNORE

AVERAGE, CONFIDENT, DETAIL_WEIGHT = 0.999, 0.968, 0.1
HIDDEN, BLOCKS_ACROSS = 0.7, 16  # MIC: 70 % of the blocks of 64 pixels in crops of 1024.
Box = tuple[slice, ...]  # Rows and columns.


@dataclass(frozen=True)
class Method:
    """What changes from a quick look to a long training."""

    iterations: int = 200
    batch: int = 2  # Source pictures of a step, and as many target pictures.
    crop_px: int = 256  # Side of a crop, a multiple of 32; a detail has half of it.
    rate: float = 1e-3  # Of AdamW. The trainers' 6e-5 is for weights that have seen ImageNet.
    widths: tuple[int, ...] = (16, 32, 80, 128)
    head: int = 64


class Network(nn.Module):
    """A SegFormer that sees all at half resolution and boxes in full, fused class by class.

    Pictures are (B, 3, H, W) float32, normalised, scores (B, 19, H, W). Equal seeds, equal weights.
    """

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        dropouts = ("hidden_dropout_prob", "classifier_dropout_prob", "drop_path_rate")
        config = SegformerConfig(
            num_labels=len(CLASSES),
            hidden_sizes=list(method.widths),
            depths=[1] * len(method.widths),
            decoder_hidden_size=method.head,
            **dict.fromkeys(dropouts, 0.0),  # They would draw from the global generator.
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(key_of("uda network", seed) % 2**63)
            segmenter = SegformerForSemanticSegmentation(config)
            self.encoder, self.head = segmenter.segformer, segmenter.decode_head
            self.attention = SegformerDecodeHead(config)
        for head in (self.head, self.attention):
            # Statistics of batches of two would mix clear, pasted and masked pictures.
            head.batch_norm = nn.GroupNorm(8, method.head)

    def forward(self, pictures: Tensor, boxes: Sequence[Box]) -> tuple[Tensor, list[Tensor]]:
        """Fused scores, and those of each box alone; outside of the boxes the context decides."""
        size = pictures.shape[-2:]
        half = functional.interpolate(pictures, scale_factor=0.5, mode="bilinear", antialias=True)
        context, trust = self._scores(half, size, self.head, self.attention)
        details, total, times = [], torch.zeros_like(context), context.new_zeros(1, 1, *size)
        for rows, columns in boxes:
            part = pictures[..., rows, columns]
            details += self._scores(part, part.shape[-2:], self.head)
            around = (columns.start, size[1] - columns.stop, rows.start, size[0] - rows.stop)
            total = total + functional.pad(details[-1], around)
            times[..., rows, columns] += 1
        trust = trust.sigmoid() * (times > 0)
        return (1 - trust) * context + trust * total / times.clamp(min=1), details

    def whole(self, pictures: Tensor) -> Tensor:
        """Scores with details everywhere: nine boxes of half the sides, half over each other."""
        rows, columns = (
            [slice(start, start + (side + 1) // 2) for start in (0, side // 4, side // 2)]
            for side in pictures.shape[-2:]
        )
        return self(pictures, [(down, across) for down in rows for across in columns])[0]

    def _scores(self, pictures: Tensor, size: Sequence[int], *heads: nn.Module) -> list[Tensor]:
        features = self.encoder(pictures, output_hidden_states=True).hidden_states
        return [functional.interpolate(head(features), size, mode="bilinear") for head in heads]


class Learner(nn.Module):
    """Student, teacher and optimiser; what a step draws hangs on (seed, step) alone."""

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        self.method, self.seed, self.student = method, seed, Network(method, seed)
        self.teacher = copy.deepcopy(self.student).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(self.student.parameters(), weight_decay=0.01)

    def step(self, done: int, source: Tensor, label: Tensor, target: Tensor) -> dict[str, float]:
        """Lower the losses once, after `done` steps.

        Takes (B, 3, H, W) uint8 pictures, and (B, H, W) int64 train ids of the source, 255 ignored;
        gives the losses, and as q the mean weight of the pseudo-labels.
        """
        key = key_of("uda step", self.seed, done)
        generator = torch.Generator().manual_seed(key % 2**63)
        follow(self.teacher, self.student, done)
        pseudo, weight = pseudo_labels(self.teacher, target)
        mixed, truth, counts = class_mix(source, label, target, pseudo, weight, generator)
        kept = torch.stack([block_mask(target.shape[-1], generator) for _ in target])
        views = {
            "source": (normalised(source), label, torch.ones_like(weight)),
            "mixed": (normalised(augmented("photometric", mixed, key)), truth, counts),
            "masked": (normalised(target) * kept[:, None], pseudo, weight),
        }
        steps, told = self.method.iterations, {"q": weight.mean().item()}
        for group in self.optimiser.param_groups:
            rise, fall = (done + 1) / (0.0375 * steps), 1 - done / steps
            group["lr"] = self.method.rate * min(1, rise) * fall
        self.optimiser.zero_grad()
        for name, (pictures, truth, counts) in views.items():
            half = target.shape[-1] // 2
            places = (8 * torch.randint(half // 8 + 1, (2,), generator=generator)).tolist()
            box = tuple(slice(place, place + half) for place in places)
            fused, (detail,) = self.student(pictures, [box])
            fine = entropy(detail, truth[..., *box], counts[..., *box])
            loss = (1 - DETAIL_WEIGHT) * entropy(fused, truth, counts) + DETAIL_WEIGHT * fine
            loss.backward()  # View by view, so that one graph at a time is in memory.
            told[name] = loss.item()
        self.optimiser.step()
        return told

    def tensors(self) -> dict[str, Tensor]:
        """All that a training needs to go on, besides its step."""
        slots = self.optimiser.state_dict()["state"].items()
        moments = {f"adamw.{i}.{name}": value for i, slot in slots for name, value in slot.items()}
        return self.state_dict() | moments

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take up what `tensors` gave."""
        own, state = self.state_dict().keys(), self.optimiser.state_dict()
        self.load_state_dict({name: tensors[name] for name in own})
        for name in tensors.keys() - own:
            _, index, slot = name.split(".")
            state["state"].setdefault(int(index), {})[slot] = tensors[name]
        self.optimiser.load_state_dict(state)


@torch.no_grad()
def follow(teacher: nn.Module, student: nn.Module, done: int) -> None:
    """Move a teacher towards its student: at first the mean of all students so far."""
    kept = min(1 - 1 / (done + 1), AVERAGE)
    for old, new in zip(teacher.parameters(), student.parameters(), strict=True):
        old.mul_(kept).add_(new, alpha=1 - kept)


@torch.no_grad()
def pseudo_labels(teacher: nn.Module, target: Tensor) -> tuple[Tensor, Tensor]:
    """(B, H, W) int64 train ids, and their weights: the share of a picture's confident pixels."""
    sure, label = teacher.whole(normalised(target)).softmax(1).max(1)
    return label, (sure >= CONFIDENT).float().mean((1, 2), keepdim=True).expand(label.shape)


def class_mix(
    source: Tensor, label: Tensor, target: Tensor, pseudo: Tensor, weight: Tensor, generator: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Half of each source's classes (rounded up) over its target: picture, labels, weights."""
    pasted = torch.zeros_like(label, dtype=torch.bool)
    for mask, own in zip(pasted, label, strict=True):
        classes = own[own != IGNORE].unique()
        order = torch.randperm(len(classes), generator=generator)
        mask |= torch.isin(own, classes[order[: (len(classes) + 1) // 2]])
    picture = torch.where(pasted[:, None], source, target)
    return picture, torch.where(pasted, label, pseudo), torch.where(pasted, 1.0, weight)


def block_mask(side_px: int, generator: torch.Generator) -> Tensor:
    """(side, side) float32: 0 on blocks that are hidden, each with the chance `HIDDEN`."""
    kept = torch.rand(BLOCKS_ACROSS, BLOCKS_ACROSS, generator=generator) >= HIDDEN
    return kept.float().kron(torch.ones(2 * [side_px // BLOCKS_ACROSS]))


def entropy(scores: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Weighted cross entropy, mean over the labelled pixels; 0 if there are none."""
    each = functional.cross_entropy(scores, label, ignore_index=IGNORE, reduction="none")
    return (each * weight).sum() / (label != IGNORE).sum().clamp(min=1)


def normalised(pictures: Tensor) -> Tensor:
    """(B, 3, H, W) uint8 sRGB → float32 with ImageNet's mean and deviation."""
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])
    return (pictures / 255 - mean.view(3, 1, 1)) / deviation.view(3, 1, 1)
