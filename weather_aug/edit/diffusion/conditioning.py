"""How the label map enters the VAE's encoder: z0 = E(x, M).

The first convolution of the encoder over picture and label channels together is the sum of the
base's own over the picture and another over the label; the other is zero at first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from weather_aug.edit.diffusion.spec import Conditioning
from weather_aug.taxonomy import CLASSES, IGNORE, TRAIN_ID

GROUPS = (
    ("road",),
    ("sidewalk",),
    ("building", "wall", "fence"),
    ("pole", "traffic light", "traffic sign"),
    ("vegetation",),
    ("terrain",),
    ("sky",),
    ("person", "rider"),
    ("car", "truck", "bus", "train", "motorcycle", "bicycle"),
)
"""Classes that weather treats alike, one channel each; what is not labelled is in none."""
CITYSCAPES_IDS = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)
"""Label id of each train id: the gray channel of the paper's code is the id over 255."""
EMBEDDED = 8
"""Channels of the learnt embedding."""


class LabelStem(nn.Module):
    """The label's share of the encoder's first activation.

    Args:
        kind: "groups" (one-hot `GROUPS`), "embedding" (learnt, `EMBEDDED` channels a class) or
            "gray" (the paper's single channel).
        conv_in: The encoder's first convolution, whose geometry this one has.
    """

    def __init__(self, kind: Conditioning, conv_in: Any) -> None:
        super().__init__()
        self.kind = kind
        channels = {"groups": len(GROUPS), "embedding": EMBEDDED, "gray": 1}[kind]
        self.conv = nn.Conv2d(
            channels,
            conv_in.out_channels,
            kernel_size=conv_in.kernel_size,
            stride=conv_in.stride,
            padding=conv_in.padding,
            bias=False,
        )
        nn.init.zeros_(self.conv.weight)
        if kind == "embedding":
            # What is unknown adds nothing, as no label at all does.
            unknown = len(CLASSES)
            self.embedding = nn.Embedding(unknown + 1, EMBEDDED, padding_idx=unknown)
        else:
            self.register_buffer("table", _table(kind), persistent=False)

    def forward(self, label: torch.Tensor) -> torch.Tensor:
        """From (B, H, W) train ids, 255 where unknown, to (B, C, H, W)."""
        planes: torch.Tensor = self.planes(label)
        return self.conv(planes)

    def planes(self, label: torch.Tensor) -> torch.Tensor:
        """(B, channels, H, W) that stand beside the picture's."""
        index = torch.where(label == IGNORE, len(CLASSES), label.long())
        if self.kind == "embedding":
            values = self.embedding(index)
        else:
            values = functional.embedding(index, self.get_buffer("table"))
        return values.permute(0, 3, 1, 2).to(self.conv.weight.dtype)


def _table(kind: Conditioning) -> torch.Tensor:
    """(classes + 1, channels): a row for each train id, and a last one for what is unknown."""
    if kind == "gray":
        return torch.tensor([*CITYSCAPES_IDS, 0])[:, None] / 255.0
    table = torch.zeros(len(CLASSES) + 1, len(GROUPS))
    for channel, names in enumerate(GROUPS):
        table[[TRAIN_ID[name] for name in names], channel] = 1.0
    return table
