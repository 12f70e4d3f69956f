"""The peers by name."""

from __future__ import annotations

from importlib import import_module

from weather_aug.clip.types import Clip
from weather_aug.edit.background import BackgroundEditor
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.errors import ArgumentError, printable

PEERS = {
    "instruct-pix2pix": "instruct:InstructPix2Pix",
    "controlnet": "controlnet:ControlNet",
    "turboedit": "turboedit:TurboEdit",
    "stylisation": "stylisation:Stylisation",
    "colour-transfer": "colour_transfer:ColourTransfer",
    "snow-cover": "snow_cover:SnowCover",
}
"""Module and class of each; a class says which options it has, and its source."""


def load_peer(name: str, options: PeerOptions, clip: Clip | None = None) -> BackgroundEditor:
    """A peer, ready to edit.

    Args:
        name: One of `PEERS`.
        options: Its choices.
        clip: That will be edited; only "colour-transfer" reads it.

    Raises:
        ArgumentError: If there is no such peer, or it has no such option.
        DataError: If its weights are not on this machine, which says how to fetch them.
        MissingExtraError: If a package that it needs is not installed.
    """
    if name not in PEERS:
        raise ArgumentError(f"peer: {printable(name)!r} is not one of {', '.join(PEERS)}")
    module, kind = PEERS[name].split(":")
    peer = getattr(import_module(f"weather_aug.edit.peers.{module}"), kind)
    editor: BackgroundEditor = (
        peer.load(options, clip) if name == "colour-transfer" else peer.load(options)
    )
    return editor
