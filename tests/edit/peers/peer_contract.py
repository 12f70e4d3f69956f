"""What every peer promises, asked of one that is loaded."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from weather_aug.clip.types import FrameKey
from weather_aug.edit.background import STYLES, BackgroundEditor, Moment
from weather_aug.errors import ArgumentError

MOST_CARD_BYTES = 64 * 1024


def check_is_an_editor(editor, moment, *, style="snow"):
    """Sizes, types, inputs, card, and the style that it does not have."""
    assert isinstance(editor, BackgroundEditor)
    assert set(editor.styles) <= set(STYLES)
    assert len(json.dumps(dict(editor.card))) < MOST_CARD_BYTES
    assert editor.card["editor"] == editor.name
    before = [frame.image.copy() for frame in moment.now]
    pictures = editor.edit(moment, style)
    assert isinstance(pictures, tuple)
    for frame, old, new in zip(moment.now, before, pictures, strict=True):
        assert new.dtype == np.uint8 and new.shape == frame.image.shape
        assert new.flags.c_contiguous
        assert np.array_equal(frame.image, old)
        assert not np.array_equal(new, old)
    for unknown in ("hail", ""):
        with pytest.raises(ArgumentError, match="is not one of"):
            editor.edit(moment, unknown)


def check_is_pure(editor, again, moment, *, style="snow"):
    """Equal pictures from another editor of the same card, after other work, and one by one."""
    assert editor.card == again.card
    first = editor.edit(moment, style)
    for other in set(editor.styles) - {style}:
        editor.edit(moment, other)
    assert_equal(first, editor.edit(moment, style))
    assert_equal(first, again.edit(moment, style))
    for frame, picture in zip(moment.now, first, strict=True):
        assert_equal((picture,), again.edit(replace(moment, now=(frame,)), style))


def check_noise_is_keyed(load, moment):
    """Seed, frame and style each change a picture of the same pixels; nothing else does.

    Args:
        load: From options by name to an editor whose texts are the same for all styles.
        moment: Whose first frame is edited.
    """
    frame = moment.now[0]
    editor = load()
    picture = one(editor, frame, "snow")
    assert np.array_equal(picture, one(load(seed=0), frame, "snow"))
    later = replace(frame, key=FrameKey(frame.key.time_index + 1, frame.key.camera))
    beside = replace(frame, key=FrameKey(frame.key.time_index, "elsewhere"))
    others = {
        "seed": one(load(seed=1), frame, "snow"),
        "time": one(editor, later, "snow"),
        "camera": one(editor, beside, "snow"),
        "style": one(editor, frame, "rain"),
    }
    for name, other in others.items():
        assert (picture != other).mean() > 0.5, name


def one(editor, frame, style="snow"):
    """The picture of one frame."""
    return editor.edit(Moment(now=(frame,)), style)[0]


def assert_equal(ours, theirs):
    for first, second in zip(ours, theirs, strict=True):
        assert np.array_equal(first, second)


def one_style(text):
    """The same text for all weathers."""
    return dict.fromkeys(STYLES, text)
