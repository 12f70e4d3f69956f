"""Choices of the peers, one list for all of them; each takes those that it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.edit.background import STYLES
from weather_aug.errors import ArgumentError, printable

CONDITIONS = ("ade20k", "cityscapes", "canny", "depth")
"""What a ControlNet is shown; see `conditions`."""
EVERYWHERE = ("height", "device", "half", "seed")
"""Options that no peer refuses; one that has no use for them does without."""
MOST_STEPS = 1000


@dataclass(frozen=True)
class PeerOptions:
    """How a peer is loaded and run; None is the peer's own default, which its class states.

    Raises:
        ArgumentError: If a choice is none.
    """

    base: str | None = None
    """Folder of a model in the diffusers layout, or the id of one that is in the local cache."""
    control: str | None = None
    """The same of a ControlNet."""
    weights: Path | None = None
    """Folder of the style networks' files."""
    pictures: Path | None = None
    """Folder with a picture of each weather: rain, snow, fog, each .png or .jpg."""
    height: int | None = None
    """Rows at which pictures are edited, their aspect kept; None for their own."""
    steps: int | None = None
    """Of the sampler, at least 1."""
    guidance: float | None = None
    """How strongly the text is followed; TurboEdit's pseudo-guidance weight."""
    image_guidance: float | None = None
    """How strongly InstructPix2Pix keeps the picture."""
    strength: float | None = None
    """Share of the noise that ControlNet starts from, in (0, 1]; 1 forgets the picture."""
    condition: str | None = None
    """What ControlNet is shown, of `CONDITIONS`."""
    conditioning: float | None = None
    """Weight of what ControlNet is shown."""
    prompts: Mapping[str, str] | None = field(default=None, hash=False)
    """By style, what the text says; a style without one cannot be edited to."""
    source_prompt: str | None = None
    """What the text says of the recorded picture."""
    severity: float | None = None
    """Of the snow that covers, in [0, 1]."""
    device: str = "cpu"
    """Of torch."""
    half: bool = False
    """float16 for the networks, on CUDA only."""
    seed: int = 0
    """Of all that is drawn at random, with the frame's key and the style."""

    def __post_init__(self) -> None:
        check_seed("seed", self.seed)
        if self.height is not None and not 8 <= self.height <= 8192:
            raise ArgumentError(f"height must be in 8..8192 pixels or None, got {self.height!r}")
        if self.steps is not None and not 1 <= self.steps <= MOST_STEPS:
            raise ArgumentError(f"steps must be in 1..{MOST_STEPS} or None, got {self.steps!r}")
        for name, low, high in (
            ("guidance", 0.0, 100.0),
            ("image_guidance", 0.0, 100.0),
            ("strength", 0.01, 1.0),
            ("conditioning", 0.0, 2.0),
            ("severity", 0.0, 1.0),
        ):
            if getattr(self, name) is not None:
                finite(name, getattr(self, name), low, high)
        if self.condition is not None and self.condition not in CONDITIONS:
            raise ArgumentError(
                f"condition: {printable(self.condition)!r} is not one of {', '.join(CONDITIONS)}"
            )
        for style in self.prompts or ():
            if style not in STYLES:
                raise ArgumentError(
                    f"prompts: {printable(style)!r} is not one of {', '.join(STYLES)}"
                )
        if self.half and not self.device.startswith("cuda"):
            raise ArgumentError("half=True needs a CUDA device; leave it out on a CPU")

    def of(self, peer: str, **defaults: Any) -> PeerOptions:
        """The options of one peer: its defaults where nothing was chosen.

        Args:
            peer: Its name.
            **defaults: Every option that it has, but those of `EVERYWHERE`.

        Raises:
            ArgumentError: If something was chosen that the peer does not have.
        """
        for option in fields(self):
            known = option.name in EVERYWHERE or option.name in defaults
            if not known and getattr(self, option.name) is not None:
                raise ArgumentError(
                    f"{peer} has no option {option.name}; it has "
                    f"{', '.join([*defaults, *EVERYWHERE])}"
                )
        unset = {name: value for name, value in defaults.items() if getattr(self, name) is None}
        return replace(self, **unset)

    def card(self, *names: str) -> dict[str, Any]:
        """The named options, as JSON values."""
        return {name: _plain(getattr(self, name)) for name in names}


def styles_of(prompts: Mapping[str, str] | None) -> tuple[str, ...]:
    """The styles that there is a text for, in the order of `STYLES`."""
    return tuple(style for style in STYLES if style in (prompts or {}))


def check_style(style: str, styles: tuple[str, ...]) -> str:
    """Return a style, or refuse one that is none of the editor's."""
    if style not in styles:
        raise ArgumentError(f"style {printable(style)!r} is not one of {', '.join(styles)}")
    return style


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else value
