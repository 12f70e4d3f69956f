"""What the ids of a caller's mask mean, and how pixels that weather hides are marked in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import like_image
from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.options import LabelPolicy
from weather_aug.taxonomy import IGNORE, Taxonomy, taxonomy

UInt8 = NDArray[np.uint8]
DTYPES = tuple(np.dtype(name) for name in ("uint8", "uint16", "int16", "int32", "int64"))


@dataclass(frozen=True)
class MaskIds:
    """A caller's label ids: what they are called, which one is ignored, what unknown ones do.

    Raises:
        ArgumentError: If a value is none of those listed.
    """

    taxonomy: str | Mapping[int, str | None] | None = "train_ids"
    """A name of `taxonomy.TAXONOMIES`, the train class (or None) of each id, or None where the ids
    are no classes of a street: the mask is then marked, and tells nothing about depth."""
    ignore_index: int = IGNORE
    """The id of pixels that are not trained on; hidden ones get it."""
    unknown_ids: Literal["error", "ignore"] = "error"
    """What an id is that the taxonomy does not declare: a fault, or no class."""

    def __post_init__(self) -> None:
        index = check_seed("ignore_index", self.ignore_index)
        if not -(2**31) <= index < 2**31:
            raise ArgumentError(f"ignore_index must be in [-2**31, 2**31), got {index}")
        object.__setattr__(self, "ignore_index", index)
        if self.unknown_ids not in ("error", "ignore"):
            raise ArgumentError(
                f"unknown_ids must be 'error' or 'ignore', got {printable(self.unknown_ids)!r}"
            )
        if isinstance(self.taxonomy, Mapping):
            object.__setattr__(self, "taxonomy", _by_id(self.taxonomy))
        elif self.taxonomy is not None and not isinstance(self.taxonomy, str):
            raise ArgumentError(
                "taxonomy must be a name, a mapping of ids to train classes, or None, got "
                f"{type(self.taxonomy).__name__}"
            )
        self._table  # noqa: B018 - an unknown name is refused now

    @cached_property
    def _table(self) -> Taxonomy | None:
        if self.taxonomy is None:
            return None
        if isinstance(self.taxonomy, str):
            return taxonomy(self.taxonomy)
        return Taxonomy("the given mapping", dict(self.taxonomy))

    def train_ids(self, mask: Any, shape: tuple[int, int]) -> UInt8 | None:
        """(H, W) uint8 train ids of a mask, 255 where it is ignored; None without a taxonomy.

        Args:
            mask: (H, W) integers of `DTYPES`, any layout; it is not changed.
            shape: (H, W) of the picture.

        Raises:
            ArgumentError: If it is no such array.
            DataError: If it holds an id that the taxonomy does not declare.
        """
        self.check(mask, shape)
        if self._table is None:
            return None
        table = self._table
        ignored = mask == self.ignore_index
        if self.unknown_ids == "ignore":
            ignored |= ~np.isin(mask, [*table.class_by_id])
        elif IGNORE not in table.class_by_id:
            ignored |= mask == IGNORE
        # 255 may be a class of the caller's, so no id can stand for what is ignored.
        first = next(iter(table.class_by_id))
        ids = table.train_ids(np.where(ignored, first, mask), where="mask")
        ids[ignored] = IGNORE
        return ids

    def check(self, mask: Any, shape: tuple[int, int]) -> None:
        """Refuse a mask of another type or size than the picture's, or too narrow for the index.

        Raises:
            ArgumentError: If it is.
        """
        if not isinstance(mask, np.ndarray):
            raise ArgumentError(f"mask must be a numpy array, got {type(mask).__name__}")
        if mask.shape == (*shape, 3):
            raise ArgumentError(
                f"mask must have the image's shape {shape} and hold ids, got colours {mask.shape}; "
                "taxonomy(name).train_ids_of_colours of weather_aug.taxonomy reads them"
            )
        like_image("mask", mask, shape)
        if mask.dtype.newbyteorder("=") not in DTYPES:
            names = ", ".join(dtype.name for dtype in DTYPES)
            raise ArgumentError(
                f"mask must be an integer array ({names}), got {mask.dtype}; it holds class ids: "
                "mask.astype(np.uint8)"
            )
        limits = np.iinfo(mask.dtype)
        if not limits.min <= self.ignore_index <= limits.max:
            raise ArgumentError(
                f"mask is {mask.dtype}, which cannot hold ignore_index {self.ignore_index}; "
                "choose another ignore_index or convert the mask"
            )

    def marked(self, mask: NDArray[Any], hidden: NDArray[np.bool_]) -> NDArray[Any]:
        """A C-contiguous copy of the mask with `ignore_index` where it is hidden."""
        done = np.array(mask, dtype=mask.dtype.newbyteorder("="), order="C")
        done[hidden] = self.ignore_index
        return done

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON values; `MaskIds(**fields)` is equal to this."""
        names = self.taxonomy
        if isinstance(names, Mapping):
            names = {str(index): name for index, name in names.items()}  # type: ignore[misc]
        return {
            "taxonomy": names,
            "ignore_index": self.ignore_index,
            "unknown_ids": self.unknown_ids,
        }


def hidden_in(label: Any, full: Any, invalid: Any, policy: LabelPolicy) -> Any:
    """Where a mask is marked: bool, of the shape of numpy arrays or tensors of any one kind.

    Pixels of no train class count as hidden where they cannot be made out: the caller may train on
    their ids.

    Args:
        label: Train ids in the weather; None where there is no label.
        full: Train ids of the clear picture, or None.
        invalid: 1 where the surface cannot be made out.
        policy: See `RenderOptions.labels`.
    """
    told = (invalid != 0) & (policy != "keep")
    if label is None or full is None:
        return told
    classless = full == IGNORE
    return ((label == IGNORE) & ~classless) | (told & classless & (policy == "ignore_unseen"))


def _by_id(names: Mapping[Any, Any]) -> dict[int, str | None]:
    """A mapping by integer id; JSON has made strings of its keys."""
    if not names:
        raise ArgumentError("taxonomy must map at least one id; None says that ids are no classes")
    try:
        return {int(index): name for index, name in names.items()}
    except (TypeError, ValueError):
        raise ArgumentError("taxonomy must map integer ids to train classes or None") from None
