"""HRDA and MIC in small: a network of two scales, its averaged teacher, and a step of training.

DACS (Tranheden, 2021) mixes by class what a teacher labelled, HRDA (Hoyer, 2022) joins context and
detail, MIC (Hoyer, 2023) masks. The distance to ImageNet's features needs weights and is left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from transformers import SegformerConfig, SegformerForSemanticSegmentation
from transformers.models.segformer.modeling_segformer import SegformerDecodeHead
from uda.frames import augmented

from weather_aug._keys import key_of
from weather_aug.taxonomy import CLASSES, IGNORE

Box, Told = tuple[slice, ...], dict[str, float]
MEAN = torch.tensor([123.675, 116.28, 103.53]).view(3, 1, 1)  # Of ImageNet's sRGB in 0 to 255.
DEVIATION = torch.tensor([58.395, 57.12, 57.375]).view(3, 1, 1)
resized = partial(nn.functional.interpolate, mode="bilinear")
DETAIL_WEIGHT, HIDDEN = 0.1, 0.7  # HRDA: of a detail's loss. MIC: of the blocks of a picture.


@dataclass(frozen=True)
class Method:  # noqa: D101 (comments are the help)
    iterations: int = 200  # Steps of each training.
    alone: int = 100  # First steps, on the source alone. Trainers: 0, as their nets know ImageNet.
    confident: float = 0.8  # From here on the teacher is sure. Trainers: 0.968, of better nets.
    average: float = 0.95  # Of the teacher, at most. Trainers: 0.999, 1,000 of their 40,000 steps.
    rate: float = 3e-3  # Of AdamW. Trainers: 6e-5, for weights that have seen ImageNet.
    spread: float = 0.1  # Of the first weights; usual is 0.02, from which it takes more steps.
    batch: int = 4  # Source pictures of a step, and as many target pictures.
    crop_px: int = 192  # Side of a crop, a multiple of 32, at least 64; a detail has half of it.
    block_px: int = 16  # Side of what is masked. Trainers: 64, in pictures four times as large.
    widths: tuple[int, ...] = (16, 32, 80, 128)  # Of the encoder's stages.
    head: int = 64  # Channels of the decoders.


class Network(nn.Module):
    """A SegFormer that sees all at half resolution and boxes in full, fused class by class."""

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        shape = dict(hidden_sizes=[*method.widths], depths=[1] * len(method.widths))
        shape |= dict(decoder_hidden_size=method.head, initializer_range=method.spread)
        shape |= dict(hidden_dropout_prob=0.0, classifier_dropout_prob=0.0, drop_path_rate=0.0)
        shape |= dict(num_labels=len(CLASSES), output_hidden_states=True)
        config = SegformerConfig(**shape)  # Dropout would draw from the global generator.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(key_of("uda network", seed) % 2**63)
            segmenter = SegformerForSemanticSegmentation(config)
            self.encoder, self.head = segmenter.segformer, segmenter.decode_head
            self.attention = SegformerDecodeHead(config)
        for head in (self.head, self.attention):
            head.batch_norm = nn.GroupNorm(8, method.head)  # Batches of two mix clear and masked.

    def forward(self, pictures: Tensor, boxes: Sequence[Box]) -> tuple[Tensor, Sequence[Tensor]]:
        """Fused scores and those of boxes of one size, on each fourth pixel: there HRDA fuses."""
        pictures = (pictures - MEAN) / DEVIATION
        far = self.encoder(nn.functional.avg_pool2d(pictures, 2)).hidden_states
        near = self.encoder(torch.cat([pictures[..., *box] for box in boxes])).hidden_states
        grid, details = [n // 4 for n in pictures.shape[-2:]], self.head(near).chunk(len(boxes))
        context, trust = (resized(head(far), grid) for head in (self.head, self.attention))
        total, times = torch.zeros_like(context), torch.zeros_like(context[:1, :1])
        for box, detail in zip(boxes, details, strict=True):
            place = tuple(slice(side.start // 4, side.stop // 4) for side in box)
            total[..., *place] += detail
            times[..., *place] += 1
        trust = trust.sigmoid() * (times > 0)
        return (1 - trust) * context + trust * total / times.clamp(min=1), details

    def whole(self, pictures: Tensor) -> Tensor:
        """(B, 19, side, side) scores with details everywhere."""
        sides = pictures.shape[-2:]
        return resized(self(pictures, windows(sides, sides[0] // 2))[0], sides)


class Learner(nn.Module):
    """Student, teacher and optimiser; what a step draws hangs on (seed, step) alone."""

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        self.method, self.seed, self.student = method, seed, Network(method, seed)
        self.teacher = AveragedModel(
            self.student, avg_fn=lambda a, b, n: a.lerp(b, max(1 / (n + 1), 1 - method.average))
        )
        self.optimiser = torch.optim.AdamW(self.student.parameters(), weight_decay=0.01)

    def step(self, done: int, source: Tensor, label: Tensor, target: Tensor, truth: Tensor) -> Told:
        """Learn from (B, 3, H, W) uint8 and (B, H, W) train ids; `truth` only rates the teacher."""
        key, method, told = key_of("uda step", self.seed, done), self.method, {}
        generator = torch.Generator().manual_seed(key % 2**63)
        self.teacher.update_parameters(self.student)
        views = {"source": (source, label, torch.ones(label.shape))}
        if done >= method.alone:
            with torch.no_grad():
                sure, pseudo = self.teacher.module.whole(target).softmax(1).max(1)
            # Of a picture the share of pixels that the teacher is sure of; pasted ones count full.
            weight = (sure >= method.confident).float().mean((1, 2), True).expand_as(pseudo)
            pasted = torch.stack([class_mask(one, generator) for one in label])
            mixed = augmented("photometric", torch.where(pasted[:, None], source, target), key)
            kept = [block_mask(method.crop_px, method.block_px, generator) for _ in target]
            masked = torch.where(torch.stack(kept)[:, None], target, MEAN)
            both, counts = torch.where(pasted, label, pseudo), torch.where(pasted, 1.0, weight)
            views |= {"mixed": (mixed, both, counts), "masked": (masked, pseudo, weight)}
            right = (pseudo == truth)[truth != IGNORE].float().mean().item()
            told = {"sure": weight.mean().item(), "right": right}
        rise, fall = (done + 1) / method.iterations / 0.0375, 1 - done / method.iterations
        self.optimiser.param_groups[0]["lr"] = method.rate * min(1, rise) * fall
        self.optimiser.zero_grad()
        half = method.crop_px // 2
        for name, (pictures, labels, counts) in views.items():
            places = 8 * torch.randint(half // 8 + 1, (2,), generator=generator)
            box = tuple(slice(place, place + half) for place in places.tolist())
            fused, (detail,) = self.student(pictures, [box])
            fine = entropy(detail, labels[..., *box], counts[..., *box])
            loss = (1 - DETAIL_WEIGHT) * entropy(fused, labels, counts) + DETAIL_WEIGHT * fine
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
        self.load_state_dict({name: tensors[name] for name in self.state_dict()})
        state = self.optimiser.state_dict()
        for _, index, slot in (n.split(".") for n in tensors if n.startswith("adamw.")):
            state["state"].setdefault(int(index), {})[slot] = tensors[f"adamw.{index}.{slot}"]
        self.optimiser.load_state_dict(state)


def windows(size: Sequence[int], side_px: int) -> list[Box]:
    """Boxes (rows, columns) that cover a picture, half over each other, as trainers' slide."""
    starts = [(*range(0, length - side_px, side_px // 2), length - side_px) for length in size]
    return [*itertools.product(*[[slice(at, at + side_px) for at in line] for line in starts])]


def class_mask(label: Tensor, generator: torch.Generator) -> Tensor:
    """(H, W) bool: the pixels of half of a label's classes, drawn at random, rounded up."""
    classes = label[label != IGNORE].unique()
    order = torch.randperm(len(classes), generator=generator)
    return torch.isin(label, classes[order[: (len(classes) + 1) // 2]])


def block_mask(side_px: int, block_px: int, generator: torch.Generator) -> Tensor:
    """(side, side) bool: False on blocks that are hidden, each with the chance `HIDDEN`."""
    kept = torch.rand(2 * [-(-side_px // block_px)], generator=generator) >= HIDDEN
    return kept.repeat_interleave(block_px, 0).repeat_interleave(block_px, 1)[:side_px, :side_px]


def entropy(scores: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Weighted cross entropy, mean over the labelled pixels; 0 if there are none."""
    scores = resized(scores, label.shape[-2:])
    each = nn.functional.cross_entropy(scores, label, ignore_index=IGNORE, reduction="none")
    return (each * weight).sum() / (label != IGNORE).sum().clamp(min=1)
