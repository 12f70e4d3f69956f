"""Masks of any ids: what they tell of the street, and what is marked in them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from weather_aug.errors import ArgumentError, DataError
from weather_aug.taxonomy import IGNORE, ROAD, SKY
from weather_aug.transforms.masks import DTYPES, MaskIds

SHAPE = (2, 3)


def mask_of(*ids: int, dtype: Any = np.int64) -> np.ndarray:
    return np.array(ids, dtype).reshape(SHAPE)


def test_train_ids_are_themselves() -> None:
    mask = mask_of(0, 1, 10, 18, 255, 255)
    found = MaskIds().train_ids(mask, SHAPE)
    assert found is not None
    assert found.dtype == np.uint8
    assert (found == mask).all()


def test_a_named_table_and_a_mapping_translate() -> None:
    for ids in (MaskIds("camvid11"), MaskIds({0: "sky", 3: "road", 11: None})):
        found = ids.train_ids(mask_of(0, 3, 0, 3, 11, 11), SHAPE)
        assert found is not None
        assert found.tolist() == [[SKY, ROAD, SKY], [ROAD, IGNORE, IGNORE]]


@pytest.mark.parametrize("index", [-100, 0, 19, 254, 300])
@pytest.mark.parametrize("table", ["train_ids", "camvid11"])
def test_the_ignored_id_is_never_looked_up(index: int, table: str) -> None:
    found = MaskIds(table, index).train_ids(mask_of(1, index, 1, 1, index, 1), SHAPE)
    assert found is not None
    assert (found == IGNORE).tolist() == [[False, True, False], [False, True, False]]


@pytest.mark.parametrize("unknown_ids", ["error", "ignore"])
def test_255_may_be_a_class_of_the_callers(unknown_ids: Any) -> None:
    """As in masks of black and white; what is ignored has another id there."""
    ids = MaskIds({0: "sidewalk", 255: "road"}, 7, unknown_ids)
    found = ids.train_ids(mask_of(0, 255, 7, 7, 255, 0), SHAPE)
    assert found is not None
    assert found.tolist() == [[1, 0, IGNORE], [IGNORE, 0, 1]]


def test_unknown_ids_are_a_fault_or_no_class() -> None:
    mask = mask_of(0, 0, 0, 0, 77, 0)
    with pytest.raises(DataError, match="label id 77"):
        MaskIds().train_ids(mask, SHAPE)
    with pytest.raises(DataError, match="label id -3"):
        MaskIds().train_ids(mask_of(0, 0, -3, 0, 0, 0), SHAPE)
    found = MaskIds(unknown_ids="ignore").train_ids(mask, SHAPE)
    assert found is not None
    assert found.tolist() == [[0, 0, 0], [0, IGNORE, 0]]


def test_ids_that_are_no_street_tell_nothing_and_are_marked() -> None:
    ids = MaskIds(None, ignore_index=-1)
    mask = mask_of(5, 70000, -9, 0, 1, 2, dtype=np.int32)
    assert ids.train_ids(mask, SHAPE) is None
    hidden = np.array([[True, False, False], [False, False, True]])
    done = ids.marked(mask, hidden)
    assert done.tolist() == [[-1, 70000, -9], [0, 1, -1]]
    assert mask[0, 0] == 5


@given(
    hnp.arrays(
        st.sampled_from([np.uint8, np.uint16, np.int16, np.int32, np.int64]),
        SHAPE,
        elements=st.integers(0, 18),
    ),
    hnp.arrays(bool, SHAPE),
)
def test_marks_keep_type_and_all_else(mask: np.ndarray, hidden: np.ndarray) -> None:
    before = mask.copy()
    done = MaskIds().marked(mask, hidden)
    assert done.dtype == mask.dtype
    assert done.flags.c_contiguous
    assert (done[hidden] == IGNORE).all()
    assert (done[~hidden] == mask[~hidden]).all()
    assert (mask == before).all()
    assert not np.shares_memory(done, mask)


@pytest.mark.parametrize("dtype", [np.float32, bool, np.int8, np.uint32, np.uint64, complex, "O"])
def test_other_types_are_refused_by_name(dtype: Any) -> None:
    with pytest.raises(ArgumentError, match=r"mask must be an integer .*; it holds class ids"):
        MaskIds().train_ids(np.zeros(SHAPE, dtype), SHAPE)
    assert np.dtype(dtype) not in DTYPES


@pytest.mark.parametrize(
    ("mask", "says"),
    [
        ([[0, 0, 0]] * 2, "mask must be a numpy array, got list"),
        (np.zeros((3, 2), np.uint8), "mask must have the image's shape"),
        (np.zeros((*SHAPE, 3), np.uint8), "got colours .*; .*train_ids_of_colours"),
        (np.zeros((1, *SHAPE), np.uint8), "mask must have the image's shape"),
    ],
)
def test_other_shapes_are_refused(mask: Any, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        MaskIds().train_ids(mask, SHAPE)


def test_an_index_that_the_mask_cannot_hold_is_refused() -> None:
    with pytest.raises(ArgumentError, match="cannot hold ignore_index -1"):
        MaskIds(ignore_index=-1).train_ids(np.zeros(SHAPE, np.uint8), SHAPE)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"taxonomy": "nowhere"}, "nowhere"),
        ({"taxonomy": 3}, "taxonomy must be a name"),
        ({"taxonomy": {"road": 0}}, "taxonomy must map integer ids"),
        ({"taxonomy": {0: "lava"}}, "lava"),
        ({"taxonomy": {}}, "at least one id"),
        ({"ignore_index": 1.5}, "ignore_index"),
        ({"ignore_index": 2**31}, "ignore_index"),
        ({"unknown_ids": "guess"}, "unknown_ids"),
    ],
)
def test_bad_arguments_are_refused_at_once(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        MaskIds(**arguments)


@pytest.mark.parametrize("ids", [MaskIds(), MaskIds({0: "sky", 7: None}, -1, "ignore")])
def test_they_can_be_written_down(ids: MaskIds) -> None:
    assert MaskIds(**json.loads(json.dumps(ids.to_dict()))) == ids
