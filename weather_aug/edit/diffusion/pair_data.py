"""Pairs of pictures as tensors, and which of them make up which batch.

Convention:
    What an item is depends on (seed, step, slot) alone and the batch of a step on (seed, step):
    neither on workers nor on what was drawn before. A training that goes on at step n draws what it
    would have drawn. Pictures are resized and cropped, never squeezed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, Sampler

from weather_aug import _files
from weather_aug._checks import finite
from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.clip.images import read_image, read_label, resized_image, resized_label
from weather_aug.edit.diffusion.pairs import PAIR_STYLES, Pair, PairList
from weather_aug.errors import ArgumentError, DataError, IntegrityError, printable
from weather_aug.taxonomy import IGNORE, taxonomy

SIDE_MULTIPLE_PX = 8
"""The networks halve pictures three times."""

UInt8 = NDArray[np.uint8]


class Draw(NamedTuple):
    """One place of one step's batch, and the pair that stands there."""

    step: int
    slot: int
    pair: int
    """Its place among the pairs of the split."""


class View(NamedTuple):
    """What part of a resized picture is shown; shares in [0, 1)."""

    down: float = 0.5
    """How far down the crop lies, of the room there is."""
    right: float = 0.5
    mirrored: bool = False


class PairImages(Dataset[dict[str, Any]]):
    """Pairs of a split as tensors.

    An item is a dict: `source` and `target` (3, height, width) float32 sRGB in [-1, 1];
    `source_label` and `target_label` (height, width) int64 train ids, 255 where nothing is known;
    `style`, text; `aligned`, whether pixels of both pictures can be compared. `item[Draw]` is a
    crop anywhere, maybe mirrored: the same of both pictures if they are aligned, else each its own.
    `item[int]` is the middle of the pictures, for judging.

    Args:
        pair_list: The pairs.
        size: (height, width) of the items, multiples of 8 pixels.
        split: "train", "val" or "test".
        style: Only this one, for judging; None for all, as `StyleBatches` counts them.
        short_side: Pixels of the pictures' short side before the crop; None, or less than the crop
            needs, for as few as cover it.
        mirrored: Share of drawn items that are mirrored, in [0, 1].
        seed: Of the draws.

    Raises:
        ArgumentError: If a choice is none, or there is no pair of that split and style.
    """

    def __init__(
        self,
        pair_list: PairList,
        size: tuple[int, int],
        *,
        split: str = "train",
        style: str | None = None,
        short_side: int | None = None,
        mirrored: float = 0.5,
        seed: int = 0,
    ) -> None:
        self.pair_list = pair_list.selected(split, style)
        self.style = style
        self.size = checked_size(size)
        if short_side is not None and not 1 <= short_side <= 2**14:
            raise ArgumentError(f"short_side must be in 1..{2**14} pixels, got {short_side!r}")
        self.short_side = short_side
        self.mirrored = finite("mirrored", mirrored, 0, 1)
        self.seed = check_seed("seed", seed)

    def __len__(self) -> int:
        return len(self.pair_list.pairs)

    def __getitem__(self, key: Draw | int) -> dict[str, Any]:
        """One item; see the class.

        Raises:
            ArgumentError: If it is a draw and the items are those of one style.
            DataError: If a file is missing or damaged, a label has not its picture's size or holds
                what is no train id, or aligned pictures differ in size.
            IntegrityError: If a picture is not the one that was listed.
        """
        if isinstance(key, Draw):
            if self.style is not None:
                raise ArgumentError("draws count the pairs of all styles; leave out style")
            return self._item(self.pair_list.pairs[key.pair], *self._views(key))
        return self._item(self.pair_list.pairs[key], View(), View())

    def _views(self, draw: Draw) -> tuple[View, View]:
        """Of the source, and of a target that is not aligned."""
        key = key_of("pairs.view", self.seed, draw.step, draw.slot)
        numbers = uniforms(key, 6).reshape(2, 3).tolist()
        views = [View(down, right, mirror < self.mirrored) for down, right, mirror in numbers]
        return views[0], views[1]

    def _item(self, pair: Pair, view: View, other_view: View) -> dict[str, Any]:
        source, source_label = self._read(pair.source, pair.source_sha256, pair.source_label)
        target, target_label = self._read(pair.target, pair.target_sha256, pair.target_label)
        if pair.aligned and source.shape != target.shape:
            names = printable(pair.source, 200), printable(pair.target, 200)
            raise DataError(
                f"{names[0]} has {_px(source)} and {names[1]} {_px(target)}, but they are listed "
                "as aligned; list the pairs again"
            )
        target_view = view if pair.aligned else other_view
        return {
            "source": _tensor(self._shown(source, view, resized_picture)),
            "target": _tensor(self._shown(target, target_view, resized_picture)),
            "source_label": _ids(self._shown(source_label, view, resized_label)),
            "target_label": _ids(self._shown(target_label, target_view, resized_label)),
            "style": pair.style,
            "aligned": pair.aligned,
        }

    def _read(self, picture: str, sha256: str, label: str | None) -> tuple[UInt8, UInt8]:
        """Picture (H, W, 3) and train ids (H, W)."""
        path = self.pair_list.file(picture)
        image = read_image(path)
        # The leakage check knows the listed bytes; training on others would make it a lie.
        if _files.sha256_of_file(path) != sha256:
            raise IntegrityError(
                f"{printable(path, 200)} is not the picture that was listed; list the pairs again"
            )
        if label is None:
            return image, np.full(image.shape[:2], IGNORE, np.uint8)
        label_path = self.pair_list.file(label)
        ids = read_label(label_path)
        if ids.shape != image.shape[:2]:
            raise DataError(
                f"{printable(label_path, 200)} has {_px(ids)}, its picture {_px(image)}; a label "
                "must have its picture's size"
            )
        return image, taxonomy("train_ids").train_ids(ids, where=str(label_path))

    def _shown(self, picture: UInt8, view: View, resized: Any) -> UInt8:
        """The part of a picture or label that a view shows, (height, width, …)."""
        height, width = self.size
        rows, columns = _covering(picture.shape[0], picture.shape[1], self.size, self.short_side)
        whole = resized(picture, columns, rows)
        top = math.floor(view.down * (rows - height + 1))
        left = math.floor(view.right * (columns - width + 1))
        part = whole[top : top + height, left : left + width]
        return part[:, ::-1] if view.mirrored else part


class StyleBatches(Sampler[list[Draw]]):
    """Which pairs make up the batch of each step: of one style, every style equally often.

    Each round of as many steps as there are styles has one batch of each, in a new order. Of a
    style's pairs none comes again before all others came; a batch goes on in the next order where
    one ends. Made to be the `batch_sampler` of a `DataLoader` over `PairImages(pair_list, …)` of
    the same split and of all styles.

    Args:
        pair_list: The pairs.
        batch_size: Pairs a step.
        seed: Of the orders.
        split: "train", "val" or "test".
        first_step: Where iteration begins.
        steps: Where it ends, not included; None for never.

    Raises:
        ArgumentError: If a choice is none, or the split has no pairs.
    """

    def __init__(
        self,
        pair_list: PairList,
        batch_size: int,
        seed: int = 0,
        *,
        split: str = "train",
        first_step: int = 0,
        steps: int | None = None,
    ) -> None:
        chosen = pair_list.selected(split)
        self.styles = chosen.styles
        self.batch_size = _checked_count("batch_size", batch_size, 1)
        self.seed = check_seed("seed", seed)
        self.first_step = _checked_count("first_step", first_step, 0)
        self.steps = None if steps is None else _checked_count("steps", steps, first_step)
        self._indices = {
            style: np.flatnonzero([pair.style == style for pair in chosen.pairs])
            for style in self.styles
        }

    def style(self, step: int) -> str:
        """Style of a step's batch."""
        turn, place = divmod(_checked_count("step", step, 0), len(self.styles))
        return self.styles[_order(len(self.styles), "pairs.styles", self.seed, turn)[place]]

    def batch(self, step: int) -> list[Draw]:
        """What a step's batch is made of, `batch_size` draws."""
        style = self.style(step)
        indices = self._indices[style]
        first = step // len(self.styles) * self.batch_size
        rounds, places = np.divmod(np.arange(first, first + self.batch_size), len(indices))
        number = PAIR_STYLES.index(style)
        orders = {
            turn: _order(len(indices), "pairs.order", self.seed, number, turn)
            for turn in np.unique(rounds).tolist()
        }
        turns = zip(rounds.tolist(), places.tolist(), strict=True)
        return [
            Draw(step, slot, int(indices[orders[turn][place]]))
            for slot, (turn, place) in enumerate(turns)
        ]

    def __iter__(self) -> Iterator[list[Draw]]:
        step = self.first_step
        while self.steps is None or step < self.steps:
            yield self.batch(step)
            step += 1

    def __len__(self) -> int:
        if self.steps is None:
            raise TypeError("these batches never end; give steps")
        return self.steps - self.first_step


def resized_picture(image: UInt8, width: int, height: int) -> UInt8:
    """(H, W, 3) picture averaged down to `width` x `height`, or interpolated up to it."""
    if width * height <= image.shape[0] * image.shape[1]:
        return resized_image(image, width, height)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def _covering(
    rows: int, columns: int, size: tuple[int, int], short_side: int | None
) -> tuple[int, int]:
    """Rows and columns of a picture after resizing: its aspect kept, the crop covered."""
    wanted = 0 if short_side is None else short_side / min(rows, columns)
    scale = max(size[0] / rows, size[1] / columns, wanted)
    return max(size[0], round(rows * scale)), max(size[1], round(columns * scale))


def _order(count: int, domain: str, *fields: int) -> NDArray[np.intp]:
    """0..count - 1 in an order that depends on the key alone."""
    return np.argsort(uniforms(key_of(domain, *fields), count), kind="stable")


def _tensor(picture: UInt8) -> torch.Tensor:
    """(3, H, W) in [-1, 1]."""
    channels_first = np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32)
    return torch.from_numpy(channels_first / np.float32(127.5) - np.float32(1))


def _ids(label: UInt8) -> torch.Tensor:
    return torch.from_numpy(label.astype(np.int64))


def _px(array: NDArray[Any]) -> str:
    return f"{array.shape[1]}x{array.shape[0]} pixels"


def checked_size(size: Sequence[int]) -> tuple[int, int]:
    """(height, width) of crops, or a refusal of what is none.

    Raises:
        ArgumentError: If it is not two multiples of 8 pixels.
    """
    sides = tuple(size)
    good = len(sides) == 2 and all(
        isinstance(side, int) and 0 < side <= 2**14 and side % SIDE_MULTIPLE_PX == 0
        for side in sides
    )
    if not good:
        raise ArgumentError(
            f"size must be (height, width), multiples of {SIDE_MULTIPLE_PX} pixels, got "
            f"{printable(size)}"
        )
    return sides[0], sides[1]


def _checked_count(name: str, value: int, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ArgumentError(f"{name} must be an integer, at least {least}, got {printable(value)}")
    return value
