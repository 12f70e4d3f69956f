"""The rows of the comparison of editors: which editor each is, and how it is loaded."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.edit.background import STYLES, BackgroundEditor, Moment
from weather_aug.edit.diffusion.options import (
    RELEASE_WEIGHTS,
    SD_TURBO,
    SELF_ONLY,
    AttentionWeights,
    DiffusionOptions,
    paper_weights,
)
from weather_aug.edit.editors import editor_of
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.edit.physical.edit import edited
from weather_aug.errors import ArgumentError
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.styles import style_weather

UInt8 = NDArray[np.uint8]

NONE, PHYSICAL, DIFFUSION = "none", "physical", "diffusion"
ATTENTION: Mapping[str, tuple[AttentionWeights, tuple[str, ...]]] = {
    "self": (SELF_ONLY, ()),
    "view": (RELEASE_WEIGHTS, ("temporal",)),
    "temporal": (RELEASE_WEIGHTS, ("view",)),
    "release": (RELEASE_WEIGHTS, ()),
    "paper": (paper_weights(), ()),
}
"""Weights, and what is left out, of each attention in the table."""
PEER_VALUES: Mapping[str, Callable[[str], Any]] = {
    **dict.fromkeys(("base", "control", "condition", "source_prompt"), str),
    **dict.fromkeys(("weights", "pictures"), Path),
    **dict.fromkeys(("steps", "seed"), int),
    **dict.fromkeys(("guidance", "image_guidance", "strength", "conditioning", "severity"), float),
}
"""Options of peers that the command line can set, and their types; see `PeerOptions`."""
FOR_PEERS = {"weights": ("stylisation",), "pictures": ("stylisation", "colour-transfer")}
"""Options with a flag of their own, and the peers that take them."""


class Physical:
    """The physical editor at the severity of the styles, with nothing in the air."""

    name = PHYSICAL
    styles = STYLES
    card: Mapping[str, Any] = {"editor": PHYSICAL}

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style's weather."""
        weather = style_weather(style)
        if weather is None or moment.look is None:
            raise ArgumentError(f"the physical editor needs a style of {STYLES} and layers")
        pictures = []
        for frame in moment.now:
            layers, ambience = moment.look(frame)
            window = (0, 0, *frame.image.shape[:2])
            pictures.append(edited(frame, layers, weather, ambience, window))
        return tuple(pictures)


@dataclass(frozen=True)
class Row:
    """An editor in the table, loaded for a clip when its turn comes."""

    name: str
    load: Callable[[WeatherScene], BackgroundEditor]


def rows_of(given: argparse.Namespace) -> list[Row]:
    """The rows that the command line asks for: diffusion has one for each adapter and ablation."""
    rows = []
    for name in given.editor:
        if name == DIFFUSION:
            rows += diffusion_rows(given)
        else:
            rows.append(Row(name, partial(loaded, name, given)))
    return rows


def diffusion_rows(given: argparse.Namespace) -> list[Row]:
    """For each adapter each attention, then the first attention without each ablation."""
    rows = []
    for adapter in given.adapter or [None]:
        of = f"{DIFFUSION} {adapter.name}" if len(given.adapter or []) > 1 else DIFFUSION
        first = given.attention[0]
        chosen = [(attention, ()) for attention in given.attention]
        chosen += [(first, (what,)) for what in given.without]
        for attention, without in chosen:
            weights, left_out = ATTENTION[attention]
            name = " ".join([f"{of}, {attention}", *(f"w/o {what}" for what in without)])
            options = partial(
                DiffusionOptions,
                base=given.base or SD_TURBO,
                adapter=adapter,
                attention=weights,
                without=tuple(dict.fromkeys((*left_out, *without))),
                height=given.height,
                device=given.device,
            )
            rows.append(Row(name, partial(diffusion, options)))
    return rows


def diffusion(options: Callable[[], DiffusionOptions], _: WeatherScene) -> BackgroundEditor:
    """The diffusion editor; loads torch and diffusers."""
    return editor_of(DIFFUSION, options())


def loaded(name: str, given: argparse.Namespace, scene: WeatherScene) -> BackgroundEditor:
    """An editor that is no diffusion editor, by name; a peer loads its own networks."""
    if name == PHYSICAL:
        return Physical()
    return editor_of(name, None if name == NONE else peer_options(name, given), scene)


def peer_options(name: str, given: argparse.Namespace) -> PeerOptions:
    """Options of a peer: --height, --device, --weights, --pictures, and its own of --peer.

    Raises:
        ArgumentError: If an option of --peer is none, is of an editor that has no row, or its value
            is of another type.
    """
    chosen: dict[str, Any] = {"height": given.height, "device": given.device}
    chosen |= {flag: getattr(given, flag) for flag, peers in FOR_PEERS.items() if name in peers}
    for text in given.peer:
        peer, _, rest = text.partition(".")
        option, equals, value = rest.partition("=")
        convert = PEER_VALUES.get(option)
        if not equals or convert is None:
            raise ArgumentError(
                f"--peer takes NAME.OPTION=VALUE, OPTION of {', '.join(PEER_VALUES)}; got {text!r}"
            )
        if peer not in given.editor:
            raise ArgumentError(f"--peer {text}: {peer!r} is not among --editor")
        if peer == name:
            chosen[option] = _converted(text, value, convert)
    return PeerOptions(**chosen)


def _converted(text: str, value: str, convert: Callable[[str], Any]) -> Any:
    try:
        return convert(value)
    except ValueError:
        raise ArgumentError(f"--peer {text}: the value must be of {convert.__name__}") from None
