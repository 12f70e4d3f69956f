"""Pairs as tensors: crops that both share, labels whose ids survive, batches by the key."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pair_trees import list_of, pair_of, save, save_label, smooth
from torch.utils.data import DataLoader

from weather_aug.edit.diffusion import pair_data as module
from weather_aug.edit.diffusion.pair_data import (
    Draw,
    PairImages,
    StyleBatches,
    _covering,
    resized_picture,
)
from weather_aug.edit.diffusion.pairs import PairList
from weather_aug.errors import ArgumentError, DataError, IntegrityError

SIZE = (72, 120)
"""Small enough that torch works on one thread: threads wait for each other on a busy machine."""
CROP = (32, 48)
DRAWS = [Draw(step, slot, 0) for step in range(6) for slot in range(2)]


def quarters(size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W) ids that tell in which sixteenth of the picture a pixel lies."""
    rows, columns = np.indices(size)
    return (4 * (4 * rows // size[0]) + 4 * columns // size[1]).astype(np.uint8)


@pytest.fixture
def street(tmp_path: Path) -> PairList:
    """One aligned pair; red tells the row, green the column, ids the sixteenth."""
    source, target = smooth(SIZE), smooth(SIZE)
    target[..., 2] = 200
    save(tmp_path / "clear.png", source)
    save(tmp_path / "rain.png", target)
    save_label(tmp_path / "label.png", quarters())
    labels = {"source_label": "label.png", "target_label": "label.png"}
    return list_of(tmp_path, pair_of(tmp_path, "clear.png", "rain.png", **labels))


def unaligned(listed: PairList) -> PairList:
    return replace(listed, pairs=tuple(replace(pair, aligned=False) for pair in listed.pairs))


def assert_one_view(items: Iterable[dict[str, Any]]) -> None:
    for item in items:
        torch.testing.assert_close(item["source"][:2], item["target"][:2], rtol=0, atol=0)
        torch.testing.assert_close(item["source_label"], item["target_label"], rtol=0, atol=0)


def assert_labels_lie_on_their_picture(items: Iterable[dict[str, Any]]) -> None:
    """Where red and green say the sixteenth beyond doubt, the id is that one."""
    for item in items:
        for name in ("source", "target"):
            place = (item[name][:2] + 1) / 2 * 4
            sure = ((place - place.round()).abs() > 0.08).all(dim=0)
            expected = 4 * place[0].floor() + place[1].floor()
            assert sure.float().mean() > 0.5
            assert torch.equal(item[f"{name}_label"][sure], expected[sure].long())


def assert_no_id_is_invented(items: Iterable[dict[str, Any]], known: set[int]) -> None:
    for item in items:
        for name in ("source_label", "target_label"):
            assert set(item[name].unique().tolist()) <= known


def test_an_item_is_what_its_docstring_says(street: PairList) -> None:
    for key in (0, Draw(3, 1, 0)):
        item = PairImages(street, CROP)[key]
        assert sorted(item) == [
            "aligned",
            "source",
            "source_label",
            "style",
            "target",
            "target_label",
        ]
        for name in ("source", "target"):
            assert item[name].shape == (3, *CROP)
            assert item[name].dtype == torch.float32
            assert item[f"{name}_label"].shape == CROP
            assert item[f"{name}_label"].dtype == torch.int64
        assert (item["style"], item["aligned"]) == ("rain", True)


def test_the_whole_picture_fills_minus_one_to_one(street: PairList) -> None:
    item = PairImages(street, SIZE)[0]
    expected = torch.from_numpy(smooth(SIZE)).permute(2, 0, 1) / 255 * 2 - 1
    torch.testing.assert_close(item["source"], expected, rtol=0, atol=1e-6)
    assert (item["source"].min(), item["source"].max()) == (-1, 1)
    assert torch.equal(item["source_label"], torch.from_numpy(quarters()).long())


def test_what_nobody_labelled_is_ignored(street: PairList) -> None:
    bare = replace(street, pairs=(replace(street.pairs[0], source_label=None),))
    item = PairImages(bare, CROP)[DRAWS[0]]
    assert (item["source_label"] == 255).all()
    assert (item["target_label"] < 16).all()


@pytest.mark.parametrize("short_side", [None, 40, 72, 100])
def test_aligned_pictures_and_labels_share_their_view(
    street: PairList, short_side: int | None
) -> None:
    images = PairImages(street, CROP, short_side=short_side)
    items = [images[draw] for draw in DRAWS]
    assert_one_view(items)
    assert_labels_lie_on_their_picture(items)
    if short_side is not None:
        assert len({tuple(item["source"].flatten().tolist()) for item in items}) == len(items)


def test_pictures_of_two_places_have_each_their_view(street: PairList) -> None:
    """Also the planted fault: crops that are not shared turn the check above red."""
    images = PairImages(unaligned(street), CROP, short_side=72)
    items = [images[draw] for draw in DRAWS]
    assert_labels_lie_on_their_picture(items)
    with pytest.raises(AssertionError):
        assert_one_view(items)
    sources = [PairImages(street, CROP, short_side=72)[draw]["source"] for draw in DRAWS]
    for item, source in zip(items, sources, strict=True):
        assert torch.equal(item["source"], source)


def test_a_label_that_is_not_cropped_with_its_picture_is_caught(
    street: PairList, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = PairImages._shown

    def shifted(self, picture, view, resized):  # type: ignore[no-untyped-def]
        if picture.ndim == 2:
            view = view._replace(mirrored=not view.mirrored)
        return real(self, picture, view, resized)

    monkeypatch.setattr(PairImages, "_shown", shifted)
    images = PairImages(street, CROP, short_side=64)
    with pytest.raises(AssertionError):
        assert_labels_lie_on_their_picture(images[draw] for draw in DRAWS)


def stripes(street: PairList) -> PairList:
    """Labels of the least and the greatest id in stripes, which smooth filters mix."""
    label = np.where(np.indices(SIZE).sum(axis=0) % 3 == 0, 18, 0)
    save_label(street.root / "label.png", label)
    return street


@pytest.mark.parametrize("short_side", [33, 64, 90, 200])
def test_no_id_is_invented_by_resizing(street: PairList, short_side: int) -> None:
    images = PairImages(stripes(street), CROP, short_side=short_side)
    assert_no_id_is_invented((images[draw] for draw in DRAWS), {0, 18})


@pytest.mark.parametrize("filter", [cv2.INTER_LANCZOS4, cv2.INTER_AREA, cv2.INTER_LINEAR])
def test_labels_resized_by_a_smooth_filter_are_caught(
    street: PairList, monkeypatch: pytest.MonkeyPatch, filter: int
) -> None:
    """The planted fault is the release's: label maps resized as if they were pictures."""

    def smoothed(label: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
        return np.asarray(cv2.resize(label, (width, height), interpolation=filter), np.uint8)

    monkeypatch.setattr(module, "resized_label", smoothed)
    images = PairImages(stripes(street), CROP, short_side=64)
    with pytest.raises(AssertionError):
        assert_no_id_is_invented((images[draw] for draw in DRAWS), {0, 18})


def test_mirroring_is_a_share_and_mirrors_all(street: PairList) -> None:
    plain = PairImages(street, CROP, short_side=64, mirrored=0)
    always = PairImages(street, CROP, short_side=64, mirrored=1)
    half = PairImages(street, CROP, short_side=64)
    seen = set()
    for draw in DRAWS[:8]:
        one, other, item = plain[draw], always[draw], half[draw]
        for name in ("source", "target", "source_label", "target_label"):
            assert torch.equal(other[name], one[name].flip(-1))
        mirrored = half._views(draw)[0].mirrored
        assert torch.equal(item["source"], (other if mirrored else one)["source"])
        seen.add(mirrored)
    assert seen == {False, True}
    share = sum(half._views(Draw(step, 0, 0))[0].mirrored for step in range(400))
    # Four standard deviations of 400 throws of a coin.
    assert abs(share - 200) < 4 * 10
    assert torch.equal(always[0]["source"], plain[0]["source"])


def test_crops_reach_every_edge(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        save(tmp_path / name, smooth((18, 26)))
    listed = list_of(tmp_path, pair_of(tmp_path, "a.png", "b.png"))
    images = PairImages(listed, (16, 24), mirrored=0, short_side=18)
    corners = {tuple(images[Draw(step, 0, 0)]["source"][:2, 0, 0].tolist()) for step in range(80)}
    # 18 - 16 + 1 rows and 26 - 24 + 1 columns to begin at.
    assert len(corners) == 3 * 3


def test_an_item_hangs_on_seed_step_and_slot(street: PairList) -> None:
    images = PairImages(street, CROP, short_side=72)
    draw = Draw(5, 1, 0)
    again = PairImages(street, CROP, short_side=72)
    again[Draw(9, 0, 0)]
    assert torch.equal(images[draw]["source"], again[draw]["source"])
    others = [
        PairImages(street, CROP, short_side=96, seed=1)[draw],
        images[draw._replace(step=6)],
        images[draw._replace(slot=0)],
    ]
    for other in others:
        assert not torch.equal(images[draw]["source"], other["source"])


def test_workers_give_the_same_batches(street: PairList) -> None:
    pairs = tuple(
        replace(street.pairs[0], style=style) for style in ("rain", "snow") for _ in range(3)
    )
    listed = replace(street, pairs=pairs)
    images = PairImages(listed, CROP, short_side=64, seed=3)
    batches = StyleBatches(listed, 2, seed=3, first_step=2, steps=7)
    loader = DataLoader(images, batch_sampler=batches, num_workers=2)
    assert len(loader) == 5
    for step, batch in enumerate(loader, 2):
        expected = [images[draw] for draw in batches.batch(step)]
        assert torch.equal(batch["source"], torch.stack([item["source"] for item in expected]))
        assert torch.equal(
            batch["target_label"], torch.stack([item["target_label"] for item in expected])
        )
        assert batch["style"] == [batches.style(step)] * 2
        assert batch["aligned"].tolist() == [True, True]
    copy = pickle.loads(pickle.dumps(images))
    assert torch.equal(copy[DRAWS[0]]["source"], images[DRAWS[0]]["source"])


@given(
    st.integers(8, 400),
    st.integers(8, 400),
    st.sampled_from(range(8, 129, 8)),
    st.sampled_from(range(8, 129, 8)),
    st.none() | st.integers(1, 300),
)
def test_pictures_cover_the_crop_and_keep_their_aspect(
    rows: int, columns: int, height: int, width: int, short_side: int | None
) -> None:
    new = _covering(rows, columns, (height, width), short_side)
    assert new[0] >= height
    assert new[1] >= width
    scale = max(height / rows, width / columns, (short_side or 0) / min(rows, columns))
    # Half a pixel of rounding.
    assert abs(new[0] - rows * scale) <= 0.5 + 1e-9
    assert abs(new[1] - columns * scale) <= 0.5 + 1e-9


@pytest.mark.parametrize("size", [(30, 50), (90, 150), (72, 120), (73, 121)])
def test_pictures_are_resized_up_and_down_in_place(size: tuple[int, int]) -> None:
    """Pixel centres: what a row and a column tell stays where it is, up to a filter's width."""
    resized = resized_picture(smooth(SIZE), size[1], size[0]).astype(np.float64)
    rows, columns = np.indices(size)
    for channel, index, side, whole in ((0, rows, 0, SIZE[0]), (1, columns, 1, SIZE[1])):
        expected = 255 * ((index + 0.5) * whole / size[side] - 0.5) / (whole - 1)
        inner = (slice(2, -2), slice(2, -2))
        assert np.abs(resized[..., channel] - expected)[inner].max() < 1.1


def test_a_picture_that_was_changed_is_refused(street: PairList) -> None:
    images = PairImages(street, CROP)
    images[0]
    save(street.root / "rain.png", smooth(SIZE) // 2)
    with pytest.raises(IntegrityError, match=r"rain.png is not the picture that was listed"):
        images[0]
    (street.root / "rain.png").unlink()
    with pytest.raises(DataError, match=r"rain.png is missing"):
        images[0]


def test_labels_that_cannot_be_trusted_are_refused(street: PairList) -> None:
    images = PairImages(street, CROP)
    label = street.root / "label.png"
    save_label(label, quarters()[1:])
    with pytest.raises(DataError, match=r"label.png has 120x71 pixels, its picture 120x72"):
        images[0]
    save_label(label, np.full(SIZE, 33))
    with pytest.raises(DataError, match=r"label.png.*33"):
        images[0]
    save(street.root / "label.jpg", quarters()).rename(label)
    with pytest.raises(DataError, match="is a JPEG, which changes label ids"):
        images[0]
    label.unlink()
    with pytest.raises(DataError, match=r"label.png is missing"):
        images[0]


def test_pictures_of_two_sizes_are_not_aligned(tmp_path: Path) -> None:
    save(tmp_path / "a.png", smooth((40, 64)))
    save(tmp_path / "b.png", smooth((48, 64)))
    listed = list_of(tmp_path, pair_of(tmp_path, "a.png", "b.png"))
    with pytest.raises(DataError, match=r"64x40 pixels and b.png 64x48.*aligned"):
        PairImages(listed, CROP)[0]
    assert PairImages(unaligned(listed), CROP)[0]["target"].shape == (3, *CROP)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size": (32, 50)}, "multiples of 8"),
        ({"size": (0, 48)}, "multiples of 8"),
        ({"size": (32,)}, "multiples of 8"),
        ({"size": (32.0, 48)}, "multiples of 8"),
        ({"short_side": 0}, "short_side"),
        ({"mirrored": 1.5}, "mirrored"),
        ({"seed": 0.5}, "seed"),
        ({"split": "dev"}, "split"),
        ({"split": "val"}, "no pair of val"),
        ({"style": "snow"}, "no pair of train and snow"),
    ],
)
def test_choices_are_checked(street: PairList, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        PairImages(street, **{"size": CROP} | changes)


def test_draws_are_of_all_styles(street: PairList) -> None:
    images = PairImages(street, CROP, style="rain")
    assert images[0]["style"] == "rain"
    with pytest.raises(ArgumentError, match="draws count the pairs of all styles"):
        images[Draw(0, 0, 0)]


def styled(street: PairList, **counts: int) -> PairList:
    """So many pairs of each style, and one to validate between each two."""
    pairs = []
    for style, count in counts.items():
        for _ in range(count):
            pairs.append(replace(street.pairs[0], style=style))
            pairs.append(replace(street.pairs[0], style="clear", split="val"))
    return replace(street, pairs=tuple(pairs))


def test_each_batch_has_one_style_and_each_round_every_style(street: PairList) -> None:
    listed = styled(street, rain=7, snow=2, fog=1)
    chosen = listed.selected("train").pairs
    batches = StyleBatches(listed, 3, seed=5)
    for first in range(0, 60, 3):
        assert {batches.style(step) for step in range(first, first + 3)} == {"rain", "snow", "fog"}
    orders = {tuple(batches.style(first + i) for i in range(3)) for first in range(0, 60, 3)}
    assert len(orders) == 6
    for step in range(60):
        draws = batches.batch(step)
        assert [draw.slot for draw in draws] == [0, 1, 2]
        assert {chosen[draw.pair].style for draw in draws} == {batches.style(step)}
        assert {draw.step for draw in draws} == {step}


@given(st.integers(1, 9), st.integers(1, 5), st.integers(1, 12), st.integers(0, 2**63))
def test_no_pair_comes_again_before_all_others(
    count: int, other: int, batch_size: int, seed: int
) -> None:
    pair = pair_like()
    pairs = (*[replace(pair, style="snow")] * other, *[pair] * count)
    batches = StyleBatches(PairList("drawn", Path("/"), pairs), batch_size, seed)
    drawn = [
        draw.pair
        for step in range(2 * (2 * count + 1))
        if batches.style(step) == "rain"
        for draw in batches.batch(step)
    ]
    for first in range(0, len(drawn) - count + 1, count):
        assert sorted(drawn[first : first + count]) == list(range(other, other + count))
    times = Counter(drawn)
    assert max(times.values()) - min(times.values()) <= 1


def pair_like() -> Any:
    from weather_aug.edit.diffusion.pairs import Pair

    return Pair("a.png", "b.png", None, None, "rain", "train", True, *["0" * 64] * 4)


def test_training_goes_on_where_it_stopped(street: PairList) -> None:
    listed = styled(street, rain=5, snow=3)
    whole = list(StyleBatches(listed, 2, seed=1, steps=20))
    assert len(whole) == len(StyleBatches(listed, 2, seed=1, steps=20)) == 20
    for stop in (0, 1, 7, 20):
        rest = StyleBatches(listed, 2, seed=1, first_step=stop, steps=20)
        assert list(rest) == whole[stop:]
        assert len(rest) == 20 - stop
    endless = StyleBatches(listed, 2, seed=1, first_step=7)
    assert list(islice(endless, 13)) == whole[7:]
    with pytest.raises(TypeError, match="never end"):
        len(endless)
    assert list(StyleBatches(listed, 2, seed=2, steps=20)) != whole


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"batch_size": 0}, "batch_size must be an integer, at least 1"),
        ({"batch_size": 2.0}, "batch_size"),
        ({"seed": "1"}, "seed"),
        ({"first_step": -1}, "first_step"),
        ({"first_step": 5, "steps": 4}, "steps must be an integer, at least 5"),
        ({"split": "test"}, "no pair of test"),
    ],
)
def test_choices_of_batches_are_checked(
    street: PairList, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(ArgumentError, match=said):
        StyleBatches(street, **{"batch_size": 2} | changes)
    with pytest.raises(ArgumentError, match="step"):
        StyleBatches(street, 2).batch(-1)


def test_batches_drawn_from_a_running_stream_are_caught(
    street: PairList, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planted fault: an order from a generator that the process owns; resuming tells."""
    stream = np.random.default_rng(0)
    monkeypatch.setattr(module, "_order", lambda count, *key: stream.permutation(count))
    listed = styled(street, rain=9, snow=9)
    whole = list(StyleBatches(listed, 4, seed=1, steps=12))
    assert list(StyleBatches(listed, 4, seed=1, first_step=5, steps=12)) != whole[5:]
