"""What may be chosen about a render besides the weather."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError, printable
from weather_aug.particles.field import MAX_PARTICLES

Alignment = Literal["world", "camera"]
FallSpeed = Literal["brandes", "atlas"]
Preset = Literal["physical", "weatheredit", "weatheredit-nuscenes"]
Ablation = Literal["none", "attributes", "dynamics", "alignment"]
LabelPolicy = Literal["ignore_unseen", "keep", "acdc"]

EFFECTS = (
    *("relight", "sky", "film", "mirror", "puddles", "ripples", "snow_cover", "tracks"),
    *("lamps", "spray", "drops", "wipers", "lens_veil", "exposure", "noise", "glare"),
    *("compression",),
)
"""What weather does to a picture besides its particles and its air; each can be left out."""


@dataclass(frozen=True)
class RenderOptions:
    """How a frame is rendered; the default is what the physics says, at a bounded cost.

    Raises:
        ArgumentError: If a value is none of those listed.
    """

    max_particles: int = 20_000
    """Expected number of resolved particles in a whole picture; the rest becomes extinction.
    WeatherEdit's presets have counts of their own."""
    alignment: Alignment = "world"
    """"camera" carries the particles along with the clip's first camera, as the paper's equations
    do: they then fall as if the car were parked, while their streaks still tell of its motion."""
    rain_fall_speed: FallSpeed = "brandes"
    """Law of the drops' speed: Brandes et al. (2002) or Atlas et al. (1973)."""
    multiple_scattering: bool = False
    """Blur what lies behind thick air, as light that is scattered forward does."""
    preset: Preset = "physical"
    """"weatheredit" draws the particles of WeatherEdit's release instead, with its settings for
    Waymo and PandaSet ("weatheredit-nuscenes": for nuScenes), blended in sRGB and without a
    medium, to compare with. They know no severity."""
    ablation: Ablation = "none"
    """What of that release is left out; only with its presets."""
    without: tuple[str, ...] = ()
    """Effects that are left out, names from `EFFECTS`."""
    labels: LabelPolicy = "ignore_unseen"
    """What becomes of a label whose surface cannot be seen: "ignore_unseen" turns it into 255,
    "keep" leaves it, "acdc" leaves what a picture of the same place in clear weather would tell
    (what does not move) and turns the rest into 255, as ACDC's annotators did."""

    def __post_init__(self) -> None:
        count = finite("max_particles", self.max_particles, 0, MAX_PARTICLES // 2)
        if count != int(count):
            raise ArgumentError(f"max_particles must be whole, got {self.max_particles!r}")
        object.__setattr__(self, "max_particles", int(count))
        for name, allowed in _ALLOWED.items():
            value = getattr(self, name)
            if value not in allowed:
                known = ", ".join(repr(choice) for choice in allowed)
                raise ArgumentError(f"{name} must be one of {known}, got {printable(value)!r}")
        object.__setattr__(self, "multiple_scattering", bool(self.multiple_scattering))
        object.__setattr__(self, "without", _effects(self.without))
        if self.preset == "physical":
            if self.ablation != "none":
                raise ArgumentError(
                    f"ablation={self.ablation!r} leaves out a part of WeatherEdit's release; give "
                    "preset='weatheredit' too"
                )
        else:
            self._check_nothing_ignored()

    def _check_nothing_ignored(self) -> None:
        for name in ("alignment", "rain_fall_speed", "multiple_scattering"):
            if getattr(self, name) != RenderOptions.__dataclass_fields__[name].default:
                raise ArgumentError(
                    f"{name}={getattr(self, name)!r} means nothing with preset={self.preset!r}; "
                    "leave it out (the release is aligned with the camera; see ablation)"
                )

    def has(self, effect: str) -> bool:
        """Whether an effect is drawn."""
        return effect not in self.without

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON values; `RenderOptions(**fields)` is equal to these options."""
        return asdict(self) | {"without": list(self.without)}

    @property
    def needs_rig(self) -> bool:
        """Whether the particles depend on where the rig has been."""
        return self.preset != "physical" or self.alignment == "camera"


_ALLOWED = {
    "alignment": get_args(Alignment),
    "rain_fall_speed": get_args(FallSpeed),
    "multiple_scattering": (False, True),
    "preset": get_args(Preset),
    "ablation": get_args(Ablation),
    "labels": get_args(LabelPolicy),
}


def _effects(names: Any) -> tuple[str, ...]:
    """Names of effects, each once, in the order of `EFFECTS`; refuse what is none."""
    if isinstance(names, str):
        raise ArgumentError(f'without must be a sequence of names; write without=("{names}",)')
    chosen = set(names)
    unknown = sorted(chosen - set(EFFECTS), key=str)
    if unknown:
        raise ArgumentError(
            f"without: {printable(unknown[0])!r} is no effect; there are {', '.join(EFFECTS)}"
        )
    return tuple(name for name in EFFECTS if name in chosen)


DEFAULT_OPTIONS = RenderOptions()
