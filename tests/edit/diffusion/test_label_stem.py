"""How labels enter the encoder: by channels of their own, which count for nothing at first."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
from torch.nn import functional

from weather_aug.edit.diffusion.conditioning import CITYSCAPES_IDS, GROUPS, LabelStem
from weather_aug.edit.diffusion.spec import Conditioning
from weather_aug.taxonomy import CLASSES, IGNORE

KINDS = [kind for kind in get_args(Conditioning) if kind != "none"]


def conv() -> torch.nn.Conv2d:
    return torch.nn.Conv2d(3, 6, 3, padding=1)


def all_ids() -> torch.Tensor:
    """(1, 4, 5): every train id once, and what is unknown."""
    return torch.tensor([*range(len(CLASSES)), IGNORE]).view(1, 4, 5)


@pytest.mark.parametrize("kind", KINDS)
def test_untrained_it_adds_nothing_and_still_learns(kind: Conditioning) -> None:
    stem = LabelStem(kind, conv())
    out = stem(all_ids())
    assert out.shape == (1, 6, 4, 5) and not out.any()
    out.sum().backward()
    assert stem.conv.weight.grad is not None and stem.conv.weight.grad.abs().sum() > 0


def test_every_class_is_in_one_group() -> None:
    names = [name for group in GROUPS for name in group]
    assert sorted(names) == sorted(CLASSES)


def test_groups_are_one_hot_and_the_unknown_is_in_none() -> None:
    planes = LabelStem("groups", conv()).planes(all_ids())
    assert set(planes.unique().tolist()) == {0.0, 1.0}
    counts = planes.sum(1).flatten()
    assert counts[:-1].eq(1).all() and counts[-1] == 0
    for index, name in enumerate(CLASSES):
        channel = int(planes[0, :, index // 5, index % 5].argmax())
        assert name in GROUPS[channel]


def test_gray_is_the_papers_channel() -> None:
    planes = LabelStem("gray", conv()).planes(all_ids()).flatten()
    expected = torch.tensor([*CITYSCAPES_IDS, 0]) / 255
    assert torch.allclose(planes, expected)
    assert planes.max() < 0.13


def test_embedding_tells_all_classes_apart() -> None:
    stem = LabelStem("embedding", conv())
    vectors = stem.planes(all_ids())[0].flatten(1).T
    assert torch.cdist(vectors, vectors).fill_diagonal_(1).min() > 0


@pytest.mark.parametrize("kind", KINDS)
def test_it_equals_one_convolution_over_picture_and_label(kind: Conditioning) -> None:
    """E(x, M): extra input channels, as a single kernel over all of them would see them."""
    base = conv().double()
    stem = LabelStem(kind, base).double()
    torch.nn.init.normal_(stem.conv.weight, generator=torch.Generator().manual_seed(2))
    image = torch.rand(2, 3, 9, 7, generator=torch.Generator().manual_seed(3)).double()
    label = torch.randint(0, 19, (2, 9, 7), generator=torch.Generator().manual_seed(4))
    kernel = torch.cat([base.weight, stem.conv.weight], dim=1)
    both = torch.cat([image, stem.planes(label)], dim=1)
    expected = functional.conv2d(both, kernel, base.bias, padding=1)
    assert torch.allclose(base(image) + stem(label), expected, atol=1e-12)
