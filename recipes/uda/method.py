"""HRDA and MIC in small: a network of two scales, its averaged teacher, and one step of training.

DACS (Tranheden, 2021) mixes by class what a teacher labelled, HRDA (Hoyer, 2022) joins context and
detail, MIC (Hoyer, 2023) masks. The distance to ImageNet's features needs weights and is left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from transformers import SegformerConfig, SegformerForSemanticSegmentation
from transformers.models.segformer.modeling_segformer import SegformerDecodeHead
from uda.frames import augmented

from weather_aug._keys import key_of
from weather_aug.taxonomy import CLASSES, IGNORE

AVERAGE, CONFIDENT, DETAIL_WEIGHT = 0.999, 0.968, 0.1
HIDDEN, BLOCKS_ACROSS = 0.7, 16  # MIC: 70 % of the blocks of 64 pixels in crops of 1024.


@dataclass(frozen=True)
class Method:
    """What changes from a quick look to a long training."""

    iterations: int = 200
    batch: int = 2  # Source pictures of a step, and as many target pictures.
    crop_px: int = 256  # Side of a crop, a multiple of 32, at least 64; a detail has half of it.
    rate: float = 1e-3  # Of AdamW. The trainers' 6e-5 is for weights that have seen ImageNet.
    widths: tuple[int, ...] = (16, 32, 80, 128)
    head: int = 64


class Network(nn.Module):
    """A SegFormer that sees all at half resolution and boxes in full, fused class by class.

    Pictures are (B, 3, H, W) float32, normalised, scores (B, 19, H, W). Equal seeds, equal weights.
    """

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        depths, sizes = [1] * len(method.widths), list(method.widths)
        shape = dict(depths=depths, hidden_sizes=sizes, decoder_hidden_size=method.head)
        # Dropout would draw from the global generator.
        shape |= dict(hidden_dropout_prob=0.0, classifier_dropout_prob=0.0, drop_path_rate=0.0)
        config = SegformerConfig(num_labels=len(CLASSES), **shape)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(key_of("uda network", seed) % 2**63)
            segmenter = SegformerForSemanticSegmentation(config)
            self.encoder, self.head = segmenter.segformer, segmenter.decode_head
            self.attention = SegformerDecodeHead(config)
        for head in (self.head, self.attention):
            head.batch_norm = nn.GroupNorm(8, method.head)  # Batches of two mix clear and masked.

    def forward(
        self, pictures: Tensor, boxes: Sequence[tuple[slice, ...]]
    ) -> tuple[Tensor, list[Tensor]]:
        """Fused scores, and those of each box (rows, columns: slices) alone."""
        size = pictures.shape[-2:]
        half = nn.functional.avg_pool2d(pictures, 2, ceil_mode=True)
        context, trust = self._scores(half, size, self.head, self.attention)
        details, total, times = [], torch.zeros_like(context), context.new_zeros(1, 1, *size)
        for rows, columns in boxes:
            part = pictures[..., rows, columns]
            details += self._scores(part, part.shape[-2:], self.head)
            around = (columns.start, size[1] - columns.stop, rows.start, size[0] - rows.stop)
            total = total + nn.functional.pad(details[-1], around)
            times[..., rows, columns] += 1
        trust = trust.sigmoid() * (times > 0)
        return (1 - trust) * context + trust * total / times.clamp(min=1), details

    def whole(self, pictures: Tensor) -> Tensor:
        """Scores with details everywhere: nine boxes of half the sides, half over each other."""
        sides = pictures.shape[-2:]
        parts = [[slice(at, at + (n + 1) // 2) for at in (0, n // 4, n // 2)] for n in sides]
        return self(pictures, [*itertools.product(*parts)])[0]

    def _scores(self, pictures: Tensor, size: Sequence[int], *heads: nn.Module) -> list[Tensor]:
        features = self.encoder(pictures, output_hidden_states=True).hidden_states
        return [nn.functional.interpolate(head(features), size, mode="bilinear") for head in heads]


class Learner(nn.Module):
    """Student, teacher and optimiser; what a step draws hangs on (seed, step) alone."""

    def __init__(self, method: Method, seed: int) -> None:
        super().__init__()
        self.method, self.seed, self.student = method, seed, Network(method, seed)
        self.teacher = AveragedModel(
            self.student, avg_fn=lambda old, new, n: old.lerp(new, max(1 / (n + 1), 1 - AVERAGE))
        )
        self.optimiser = torch.optim.AdamW(self.student.parameters(), weight_decay=0.01)

    def step(self, done: int, source: Tensor, label: Tensor, target: Tensor) -> dict[str, float]:
        """Lower, after `done` steps, the losses of (B, 3, H, W) uint8 and (B, H, W) train ids."""
        key, half = key_of("uda step", self.seed, done), self.method.crop_px // 2
        generator = torch.Generator().manual_seed(key % 2**63)
        self.teacher.update_parameters(self.student)
        with torch.no_grad():
            sure, pseudo = self.teacher.module.whole(normalised(target)).softmax(1).max(1)
        # Of a picture the share of pixels that the teacher is sure of; pasted ones count in full.
        weight = (sure >= CONFIDENT).float().mean((1, 2), keepdim=True).expand(pseudo.shape)
        pasted = torch.stack([class_mask(one, generator) for one in label])
        mixed = augmented("photometric", torch.where(pasted[:, None], source, target), key)
        truth, counts = torch.where(pasted, label, pseudo), torch.where(pasted, 1.0, weight)
        kept = torch.stack([block_mask(2 * half, generator) for _ in target])
        views = {
            "source": (normalised(source), label, torch.ones_like(weight)),
            "mixed": (normalised(mixed), truth, counts),
            "masked": (normalised(target) * kept[:, None], pseudo, weight),
        }
        rise, fall = (done + 1) / self.method.iterations / 0.0375, 1 - done / self.method.iterations
        self.optimiser.param_groups[0]["lr"] = self.method.rate * min(1, rise) * fall
        self.optimiser.zero_grad()
        told = {"q": weight.mean().item()}  # How much pseudo-labels count.
        for name, (pictures, truth, counts) in views.items():
            places = 8 * torch.randint(half // 8 + 1, (2,), generator=generator)
            box = tuple(slice(place, place + half) for place in places.tolist())
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
        self.load_state_dict({name: tensors[name] for name in self.state_dict()})
        state = self.optimiser.state_dict()
        for _, index, slot in (n.split(".") for n in tensors if n.startswith("adamw.")):
            state["state"].setdefault(int(index), {})[slot] = tensors[f"adamw.{index}.{slot}"]
        self.optimiser.load_state_dict(state)


def class_mask(label: Tensor, generator: torch.Generator) -> Tensor:
    """(H, W) bool: the pixels of half of a label's classes, drawn at random, rounded up."""
    classes = label[label != IGNORE].unique()
    order = torch.randperm(len(classes), generator=generator)
    return torch.isin(label, classes[order[: (len(classes) + 1) // 2]])


def block_mask(side_px: int, generator: torch.Generator) -> Tensor:
    """(side, side) float32: 0 on blocks that are hidden, each with the chance `HIDDEN`."""
    kept = torch.rand(BLOCKS_ACROSS, BLOCKS_ACROSS, generator=generator) >= HIDDEN
    return kept.float().kron(torch.ones(2 * [side_px // BLOCKS_ACROSS]))


def entropy(scores: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Weighted cross entropy, mean over the labelled pixels; 0 if there are none."""
    each = nn.functional.cross_entropy(scores, label, ignore_index=IGNORE, reduction="none")
    return (each * weight).sum() / (label != IGNORE).sum().clamp(min=1)


def normalised(pictures: Tensor) -> Tensor:
    """(B, 3, H, W) uint8 sRGB → float32 with ImageNet's mean and deviation."""
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]]).view(2, 3, 1, 1)
    return (pictures / 255 - mean) / deviation
