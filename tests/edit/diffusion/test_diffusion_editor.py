"""The editor: pure, of the picture's own size, aware of labels and neighbours only where asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_base import adapted, perturbed

from weather_aug.clip.images import resized_label
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.background import BackgroundEditor, Moment, RecordedEditor
from weather_aug.edit.diffusion.adapter_files import save_adapter
from weather_aug.edit.diffusion.editor import (
    DiffusionEditor,
    SingleStyleEditors,
    effective_weights,
)
from weather_aug.edit.diffusion.leakage import TrainedOn
from weather_aug.edit.diffusion.options import (
    RELEASE_WEIGHTS,
    SELF_ONLY,
    AttentionWeights,
    DiffusionOptions,
    paper_weights,
)
from weather_aug.edit.diffusion.skips import Encoded
from weather_aug.edit.diffusion.spec import PROMPTS, AdapterSpec
from weather_aug.errors import ArgumentError, DataError

WIDTH, HEIGHT = 43, 29
RECORD = TrainedOn(frozenset(["0" * 64]))


def frame(time: int, camera: str = "front", yaw: float = 0.0, height: int = HEIGHT) -> Frame:
    """A picture of noise whose cameras stand in a fan."""
    rng = np.random.default_rng([time, *camera.encode()])
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(yaw), 0, np.sin(yaw)],
        [0, 1, 0],
        [-np.sin(yaw), 0, np.cos(yaw)],
    ]
    intrinsics = [[WIDTH, 0, WIDTH / 2], [0, WIDTH, height / 2], [0, 0, 1]]
    return Frame(
        FrameKey(time, camera),
        0.1 * time,
        Camera(intrinsics, pose, WIDTH, height),
        rng.integers(0, 256, (height, WIDTH, 3), dtype=np.uint8),
        rng.integers(0, 19, (height, WIDTH), dtype=np.uint8),
    )


def rig(time: int) -> tuple[Frame, ...]:
    return frame(time), frame(time, "left", -0.9), frame(time, "right", 0.9)


MOMENT = Moment(rig(1), rig(0), rig(2))


@pytest.fixture(scope="module")
def folders(small_base: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    adapter = tmp_path_factory.mktemp("adapter") / "all"
    save_adapter(perturbed(adapted(small_base), seed=6), adapter)
    return small_base, adapter


@pytest.fixture(scope="module")
def editor(folders: tuple[Path, Path]) -> DiffusionEditor:
    loaded = DiffusionEditor.load(DiffusionOptions(str(folders[0]), folders[1]))
    assert isinstance(loaded, DiffusionEditor)
    return loaded


def with_options(editor: DiffusionEditor, **changes: object) -> DiffusionEditor:
    return DiffusionEditor(editor.model, replace(editor.options, **changes), editor._card)


def differ(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> list[bool]:
    return [not np.array_equal(one, other) for one, other in zip(a, b, strict=True)]


def test_it_is_a_background_editor(editor: DiffusionEditor) -> None:
    assert isinstance(editor, BackgroundEditor)
    assert editor.name == "diffusion" and editor.styles == ("rain", "snow", "fog")


def test_pictures_keep_their_size_and_inputs_stay(editor: DiffusionEditor) -> None:
    before = [one.image.copy() for one in (*MOMENT.before, *MOMENT.now, *MOMENT.after)]
    edited = editor.edit(MOMENT, "snow")
    assert [one.shape for one in edited] == [(HEIGHT, WIDTH, 3)] * 3
    assert all(one.dtype == np.uint8 for one in edited)
    frames = (*MOMENT.before, *MOMENT.now, *MOMENT.after)
    assert all(np.array_equal(one.image, old) for one, old in zip(frames, before, strict=True))


def test_two_runs_are_equal_whatever_came_between(
    editor: DiffusionEditor, folders: tuple[Path, Path]
) -> None:
    first = editor.edit(MOMENT, "snow")
    assert all(differ(editor.edit(MOMENT, "rain"), first))
    assert not any(differ(editor.edit(MOMENT, "snow"), first))
    again = DiffusionEditor.load(DiffusionOptions(str(folders[0]), folders[1]))
    assert not any(differ(again.edit(MOMENT, "snow"), first))
    assert again.card == editor.card


def test_neighbours_in_time_are_seen(editor: DiffusionEditor) -> None:
    alone = editor.edit(Moment(MOMENT.now), "snow")
    for moment in (
        Moment(MOMENT.now, before=MOMENT.before),
        Moment(MOMENT.now, after=MOMENT.after),
    ):
        assert all(differ(editor.edit(moment, "snow"), alone))


def test_without_a_reference_nobody_looks(editor: DiffusionEditor) -> None:
    """Side cameras look at the front; the front looks at nobody."""
    other = Moment((frame(9), *MOMENT.now[1:]), MOMENT.before, MOMENT.after)
    seen = differ(editor.edit(other, "snow"), editor.edit(MOMENT, "snow"))
    assert seen == [True, True, True]
    blind = with_options(editor, without=("view",))
    seen = differ(blind.edit(other, "snow"), blind.edit(MOMENT, "snow"))
    assert seen == [True, False, False]
    timeless = with_options(editor, without=("temporal",))
    later = Moment(MOMENT.now, MOMENT.before, rig(7))
    assert not any(differ(timeless.edit(later, "snow"), timeless.edit(MOMENT, "snow")))


def test_self_only_sees_one_picture_at_a_time(editor: DiffusionEditor) -> None:
    plain = with_options(editor, attention=SELF_ONLY)
    whole = plain.edit(MOMENT, "fog")
    each = tuple(plain.edit(Moment((one,)), "fog")[0] for one in MOMENT.now)
    assert not any(differ(whole, each))
    blind = with_options(editor, without=("view", "temporal"))
    assert not any(differ(blind.edit(MOMENT, "fog"), whole))


def test_labels_are_seen_unless_left_out(editor: DiffusionEditor) -> None:
    one = frame(1)
    relabelled = replace(one, label=np.roll(one.label, 5, axis=0))
    assert differ(editor.edit(Moment((one,)), "snow"), editor.edit(Moment((relabelled,)), "snow"))[
        0
    ]
    blind = with_options(editor, without=("labels",))
    unlabelled = replace(one, label=None)
    pictures = [blind.edit(Moment((x,)), "snow") for x in (one, relabelled)]
    pictures.append(editor.edit(Moment((unlabelled,)), "snow"))
    assert not any(differ(pictures[0], pictures[1])) and not any(differ(pictures[0], pictures[2]))


def test_at_another_height_the_aspect_is_kept(editor: DiffusionEditor) -> None:
    smaller = with_options(editor, height=16)
    assert smaller._size(MOMENT.now[0]) == (16, round(WIDTH * 16 / HEIGHT))
    assert [one.shape for one in smaller.edit(MOMENT, "rain")] == [(HEIGHT, WIDTH, 3)] * 3


def test_pictures_of_other_sizes_cannot_look_at_each_other(editor: DiffusionEditor) -> None:
    moment = Moment((frame(1), frame(1, "left", -0.9, height=61)))
    with pytest.raises(DataError, match="height"):
        editor.edit(moment, "snow")
    assert len(with_options(editor, attention=SELF_ONLY).edit(moment, "snow")) == 2


def test_a_blend_is_between_its_styles(editor: DiffusionEditor) -> None:
    moment = Moment((frame(1),))
    snow = editor.edit(moment, "snow")
    assert not any(differ(editor.edit(moment, {"snow": 1.0}), snow))
    assert all(differ(editor.edit(moment, {"snow": 0.5}), snow))
    assert not any(differ(editor.edit(moment, {"snow": 0.0}), editor.edit(moment, "clear")))


def test_a_style_that_is_none_is_refused(editor: DiffusionEditor) -> None:
    with pytest.raises(ArgumentError, match="hail"):
        editor.edit(MOMENT, "hail")


def test_single_styles_are_one_editor(small_base: Path, tmp_path: Path) -> None:
    for seed, style in enumerate(("snow", "rain")):
        spec = AdapterSpec(prompts={style: PROMPTS[style]}, unet_rank=2)
        model = perturbed(adapted(small_base, spec), seed)
        save_adapter(model, tmp_path / "singles" / style)
    RECORD.write(tmp_path / "singles" / "snow")
    options = DiffusionOptions(str(small_base), tmp_path / "singles", attention=SELF_ONLY)
    editor = DiffusionEditor.load(options)
    assert isinstance(editor, SingleStyleEditors) and isinstance(editor, BackgroundEditor)
    assert isinstance(editor, RecordedEditor)
    assert editor.trained_on("snow") == RECORD and editor.trained_on("rain") is None
    assert editor.styles == ("rain", "snow")
    moment = Moment((frame(1),))
    alone = DiffusionEditor.load(replace(options, adapter=tmp_path / "singles" / "snow"))
    assert not any(differ(editor.edit(moment, "snow"), alone.edit(moment, "snow")))
    with pytest.raises(ArgumentError, match="fog"):
        editor.edit(moment, "fog")


def test_an_adapter_is_needed(small_base: Path) -> None:
    with pytest.raises(ArgumentError, match="train-editor"):
        DiffusionEditor.load(DiffusionOptions(str(small_base)))


@pytest.mark.parametrize(
    ("attention", "without", "expected"),
    [
        (RELEASE_WEIGHTS, (), RELEASE_WEIGHTS),
        (RELEASE_WEIGHTS, ("view",), AttentionWeights(0.88, 0, 0.06, 0.06)),
        (RELEASE_WEIGHTS, ("temporal",), AttentionWeights(0.72, 0.28, 0, 0)),
        (RELEASE_WEIGHTS, ("view", "temporal"), SELF_ONLY),
        (paper_weights(0.6), ("view",), AttentionWeights(0.6, 0, 0.2, 0.2)),
        (paper_weights(0.6), ("view", "temporal"), SELF_ONLY),
    ],
)
def test_what_is_left_out_goes_to_the_picture_itself(
    attention: AttentionWeights, without: tuple[str, ...], expected: AttentionWeights
) -> None:
    got = effective_weights(DiffusionOptions(attention=attention, without=without))
    for name in ("itself", "view", "before", "after"):
        assert getattr(got, name) == pytest.approx(getattr(expected, name))


def test_the_picture_alone_has_the_weight_that_is_asked_for(editor: DiffusionEditor) -> None:
    moment = Moment((frame(1),))
    whole = with_options(editor, attention=SELF_ONLY).edit(moment, "snow")
    half = with_options(editor, attention=AttentionWeights(0.5, 0, 0, 0)).edit(moment, "snow")
    assert all(differ(whole, half))


def test_where_no_view_is_seen_nobody_asks_where_the_front_is(editor: DiffusionEditor) -> None:
    def look(_: Frame) -> Any:
        raise AssertionError("looked")

    ring = tuple(frame(1, str(place), place * np.pi / 2) for place in range(4))
    with pytest.raises(ArgumentError, match="evenly all around"):
        editor.edit(Moment(ring), "snow")
    blind = with_options(editor, without=("view",))
    assert len(blind.edit(Moment(ring, look=look), "snow")) == 4


def test_labels_are_resized_as_in_training(
    editor: DiffusionEditor, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    smaller = with_options(editor, height=16)
    encode = smaller.model.encode

    def encoded(pixels: torch.Tensor, label: torch.Tensor) -> Encoded:
        seen.append(label)
        return encode(pixels, label)

    monkeypatch.setattr(smaller.model, "encode", encoded)
    one = frame(1)
    smaller.edit(Moment((one,)), "snow")
    width = round(WIDTH * 16 / HEIGHT)
    assert np.array_equal(seen[0][0, :16, :width], resized_label(one.label, width, 16))


def test_a_device_that_is_not_there_is_one_sentence(
    editor: DiffusionEditor, folders: tuple[Path, Path]
) -> None:
    for device in ("gpu", "cuda:99"):
        options = DiffusionOptions(str(folders[0]), folders[1], device=device)
        with pytest.raises(ArgumentError, match=device):
            DiffusionEditor.load(options)
