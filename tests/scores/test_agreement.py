"""Agreement of labels: identities, a slow count beside the fast one, and faults that are seen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from weather_aug.errors import ArgumentError
from weather_aug.scores.agreement import Agreement, agreement
from weather_aug.taxonomy import IGNORE

IDS = st.sampled_from([*range(19), IGNORE])
SHAPE = (6, 7)
LABEL = hnp.arrays(np.uint8, SHAPE, elements=IDS)
MASK = hnp.arrays(np.bool_, SHAPE)


def check_against_loops(a: Any, b: Any, mask: Any, agree: Any = agreement) -> None:
    """Every number by its definition, pixel by pixel and class by class."""
    found = agree(a, b, mask=mask)
    pairs = [
        (int(p), int(q))
        for p, q, m in zip(a.flat, b.flat, mask.flat, strict=True)
        if m and p != IGNORE and q != IGNORE
    ]
    assert found.count == len(pairs)
    for p in range(19):
        for q in range(19):
            assert found.confusion[p, q] == pairs.count((p, q))
    ious = []
    for index in range(19):
        both = sum(p == q == index for p, q in pairs)
        either = sum(index in pair for pair in pairs)
        if either:
            ious.append(both / either)
            assert found.iou[index] == pytest.approx(both / either)
        else:
            assert np.isnan(found.iou[index])
    if not pairs:
        assert np.isnan([found.pixel_agreement, found.flipped, found.miou]).all()
        return
    same = sum(p == q for p, q in pairs) / len(pairs)
    assert found.pixel_agreement == pytest.approx(same)
    assert found.flipped == pytest.approx(1 - same)
    assert found.miou == pytest.approx(np.mean(ious))


@given(a=LABEL, b=LABEL, mask=MASK)
def test_all_numbers_are_those_of_a_slow_count(a, b, mask):
    check_against_loops(a, b, mask)


def transposed(a: Any, b: Any, mask: Any) -> Agreement:
    return Agreement(agreement(a, b, mask=mask).confusion.T)


def ignore_is_a_class(a: Any, b: Any, mask: Any) -> Agreement:
    return agreement(np.where(a == IGNORE, 0, a).astype(np.uint8), b, mask=mask)


def without_mask(a: Any, b: Any, mask: Any) -> Agreement:
    return agreement(a, b)


class _Recall(Agreement):
    @property
    def iou(self) -> Any:
        either = self.confusion.sum(axis=1)
        unknown = np.full(19, np.nan)
        return np.divide(np.diag(self.confusion), either, out=unknown, where=either > 0)


class _AbsentIsZero(Agreement):
    @property
    def miou(self) -> float:
        return float(np.nan_to_num(self.iou).mean())


def recall_for_iou(a: Any, b: Any, mask: Any) -> Agreement:
    return _Recall(agreement(a, b, mask=mask).confusion)


def absent_is_zero(a: Any, b: Any, mask: Any) -> Agreement:
    return _AbsentIsZero(agreement(a, b, mask=mask).confusion)


@pytest.mark.parametrize(
    "fault", [transposed, ignore_is_a_class, without_mask, recall_for_iou, absent_is_zero]
)
def test_a_fault_is_found_out(fault):
    rng = np.random.default_rng(0)
    ids = np.array([0, 2, 10, IGNORE], np.uint8)
    a, b = ids[rng.integers(0, 4, (2, *SHAPE))]
    mask = rng.random(SHAPE) < 0.7
    check_against_loops(a, b, mask)
    with pytest.raises(AssertionError):
        check_against_loops(a, b, mask, fault)


@given(label=LABEL)
def test_a_label_agrees_with_itself(label):
    found = agreement(label, label)
    if found.count:
        assert (found.pixel_agreement, found.flipped, found.miou) == (1.0, 0.0, 1.0)


@given(a=LABEL, b=LABEL)
def test_order_matters_to_the_confusion_alone(a, b):
    one, other = agreement(a, b), agreement(b, a)
    assert (one.confusion == other.confusion.T).all()
    assert np.array_equal(one.iou, other.iou, equal_nan=True)
    assert np.array_equal(one.miou, other.miou, equal_nan=True)


@given(a=LABEL, b=LABEL, mask=MASK)
def test_parts_add_up_to_the_whole(a, b, mask):
    parts = agreement(a, b, mask=mask) + agreement(a, b, mask=~mask)
    assert (parts.confusion == agreement(a, b).confusion).all()


@given(a=LABEL, b=LABEL, order=st.permutations(range(19)))
def test_names_of_classes_do_not_matter(a, b, order):
    table = np.full(256, IGNORE, np.uint8)
    table[:19] = order
    one, other = agreement(a, b), agreement(table[a], table[b])
    assert np.array_equal(one.iou, other.iou[np.array(order)], equal_nan=True)
    assert one.count == other.count


def test_the_confusion_cannot_be_changed():
    label = np.zeros(SHAPE, np.uint8)
    found = agreement(label, label)
    with pytest.raises(ValueError, match="read-only"):
        found.confusion[0, 0] = 1


GOOD = np.zeros(SHAPE, np.uint8)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((GOOD, np.zeros((7, 6), np.uint8)), "label_b must have"),
        ((GOOD.astype(int), GOOD), "label_a must be a uint8"),
        ((GOOD, GOOD[0]), "label_b must be a uint8"),
        ((GOOD, None), "label_b must be a uint8"),
        ((GOOD + np.uint8(19), GOOD), "label_a holds 19"),
        ((GOOD, GOOD, GOOD), "mask must be a bool"),
        ((GOOD, GOOD, np.ones((2, 2), bool)), "mask must have"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, says):
    a, b, *mask = arguments
    with pytest.raises(ArgumentError, match=says):
        agreement(a, b, mask=mask[0] if mask else None)


@pytest.mark.parametrize(
    "confusion", [np.zeros((18, 18), int), np.zeros((19, 19)), -np.ones((19, 19), int), [1]]
)
def test_a_confusion_is_counts(confusion):
    with pytest.raises(ArgumentError, match="confusion must"):
        Agreement(confusion)


def test_agreements_add_to_agreements_only():
    with pytest.raises(TypeError):
        agreement(GOOD, GOOD) + 1
