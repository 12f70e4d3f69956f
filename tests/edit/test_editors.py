"""Editors by name: each is found where it is, with its own options, and only when asked for."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_clip import TinyClip

from weather_aug.edit import editors
from weather_aug.edit.background import STYLES, BackgroundEditor, Moment
from weather_aug.edit.diffusion.options import DiffusionOptions
from weather_aug.edit.editors import EDITORS, Unedited, editor_of
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.errors import ArgumentError, DataError

MOMENT = Moment(tuple(TinyClip().frame(key) for key in TinyClip().keys[:2]))


def test_every_name_has_a_home() -> None:
    """The modules exist, load by `load`, and are called as they are asked for."""
    for name, home in editors._HOMES.items():
        module = importlib.import_module(f"weather_aug.edit.{home.module}")
        found = getattr(module, home.name)
        assert callable(found.load) and found.name == name
        options = importlib.import_module(f"weather_aug.edit.{home.options_module}")
        assert callable(getattr(options, home.options))
    assert set(EDITORS) == {*editors._HOMES, "none"}


def test_importing_the_names_loads_no_network() -> None:
    code = (
        "import sys, weather_aug.edit.editors, weather_aug.scene.backgrounds\nprint(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert not loaded & {"diffusers", "transformers", "peft", "accelerate"}
    assert "weather_aug.edit.diffusion.editor" not in loaded


def test_no_editing_gives_the_recorded_pictures() -> None:
    editor = editor_of("none")
    assert isinstance(editor, Unedited) and isinstance(editor, BackgroundEditor)
    assert editor.styles == STYLES and editor.card == {"editor": "none"}
    for style in STYLES:
        for frame, picture in zip(MOMENT.now, editor.edit(MOMENT, style), strict=True):
            assert (picture == frame.image).all() and not np.shares_memory(picture, frame.image)
    with pytest.raises(ArgumentError, match="'dusk' is not one of rain, snow, fog"):
        editor.edit(MOMENT, "dusk")


def test_an_editor_without_weights_is_loaded_with_its_options() -> None:
    light, deep = (editor_of("snow-cover", PeerOptions(severity=s)) for s in (0.2, 1.0))
    assert light.styles == ("snow",) and isinstance(light, BackgroundEditor)
    assert light.card != deep.card == editor_of("snow-cover").card


def test_missing_weights_are_named(tmp_path: Path) -> None:
    for name in ("instruct-pix2pix", "controlnet", "turboedit"):
        with pytest.raises(DataError, match="nowhere"):
            editor_of(name, PeerOptions(base=str(tmp_path / "nowhere")))
    with pytest.raises(ArgumentError, match="adapter"):
        editor_of("diffusion")


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("photoshop", None, "'photoshop' is not one of physical, diffusion, instruct-pix2pix"),
        ("", None, "'' is not one of"),
        ("none", PeerOptions(), "'none' has no options"),
        (
            "diffusion",
            PeerOptions(),
            "takes DiffusionOptions of weather_aug.edit.diffusion",
        ),
        ("controlnet", DiffusionOptions(), "takes PeerOptions of weather_aug.edit.peers.options"),
        ("snow-cover", {"severity": 1}, "got dict"),
        ("snow-cover", PeerOptions(guidance=3.0), "no option guidance"),
    ],
)
def test_what_is_none_is_refused(name: str, options: Any, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        editor_of(name, options)
