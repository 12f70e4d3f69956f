"""Editors of backgrounds by name, each loaded when it is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Clip
from weather_aug.edit.background import STYLES, BackgroundEditor, Moment
from weather_aug.errors import ArgumentError, printable


class _Home(NamedTuple):
    """Where an editor is, and its options; modules below `weather_aug.edit`."""

    module: str
    name: str
    options_module: str
    options: str


_PEER = ("peers.options", "PeerOptions")
_HOMES = {
    "diffusion": _Home(
        "diffusion.editor", "DiffusionEditor", "diffusion.options", "DiffusionOptions"
    ),
    "instruct-pix2pix": _Home("peers.instruct", "InstructPix2Pix", *_PEER),
    "controlnet": _Home("peers.controlnet", "ControlNet", *_PEER),
    "turboedit": _Home("peers.turboedit", "TurboEdit", *_PEER),
    "stylisation": _Home("peers.stylisation", "Stylisation", *_PEER),
    "colour-transfer": _Home("peers.colour_transfer", "ColourTransfer", *_PEER),
    "snow-cover": _Home("peers.snow_cover", "SnowCover", *_PEER),
}
_MEASURE = ("colour-transfer",)
"""Editors that look at the clip before they edit it."""
EDITORS = (*_HOMES, "none")
"""Names of editors that store backgrounds; the physical editor needs none."""
UNTRAINED = ("none", "snow-cover")
"""Of them, those that learnt nothing from any picture."""


class Unedited:
    """A `BackgroundEditor` that changes nothing: to see what editing is worth.

    With its backgrounds a scene renders particles and air over the recorded pictures.
    """

    name = "none"
    styles = STYLES

    @property
    def card(self) -> Mapping[str, Any]:
        """There is nothing that its pictures depend on."""
        return {"editor": self.name}

    def edit(self, moment: Moment, style: str) -> tuple[NDArray[np.uint8], ...]:
        """The recorded pictures of now, (H, W, 3) sRGB each.

        Raises:
            ArgumentError: If the style is none.
        """
        if style not in STYLES:
            raise ArgumentError(f"style {printable(style)!r} is not one of {', '.join(STYLES)}")
        return tuple(frame.image.copy() for frame in moment.now)


def editor_of(name: str, options: Any = None, clip: Clip | None = None) -> BackgroundEditor:
    """Load an editor.

    Args:
        name: One of `EDITORS`.
        options: `edit.diffusion.options.DiffusionOptions` of "diffusion", nothing of "none",
            `edit.peers.options.PeerOptions` of all others; the defaults if None.
        clip: That will be edited; needed by "colour-transfer", which measures it.

    Raises:
        ArgumentError: If there is no such editor, or it has other options.
        DataError: If its weights are not there or cannot be read.
        MissingExtraError: If a package that it needs is not installed.
    """
    if name not in EDITORS:
        raise ArgumentError(
            f"editor {printable(name)!r} is not one of physical, {', '.join(EDITORS)}"
        )
    if name == "none":
        if options is not None:
            raise ArgumentError("editor 'none' has no options; leave them out")
        return Unedited()
    home = _HOMES[name]
    takes = getattr(_module(home.options_module), home.options)
    if options is not None and not isinstance(options, takes):
        raise ArgumentError(
            f"editor {name!r} takes {home.options} of weather_aug.edit.{home.options_module}, got "
            f"{type(options).__name__}"
        )
    editor = getattr(_module(home.module), home.name)
    given = (takes() if options is None else options,)
    loaded: BackgroundEditor = editor.load(*given, *((clip,) if name in _MEASURE else ()))
    return loaded


def _module(name: str) -> Any:
    return importlib.import_module(f"weather_aug.edit.{name}")
