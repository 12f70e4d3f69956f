"""Choices of a training: how long, on what, with which losses, how much memory it may take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.edit.diffusion.discriminator import CLIP, DiscriminatorKind
from weather_aug.edit.diffusion.objectives import CycleWeights, EpsilonWeights, PairedWeights
from weather_aug.edit.diffusion.pair_data import checked_size
from weather_aug.edit.diffusion.pairs import PAIR_STYLES
from weather_aug.edit.diffusion.perceptual import Perceptual
from weather_aug.edit.diffusion.spec import PROMPTS, AdapterSpec, Conditioning
from weather_aug.errors import ArgumentError, printable

Objective = Literal["paired", "epsilon", "cycle"]
Precision = Literal["no", "fp16", "bf16"]
Optimiser = Literal["adamw", "adamw8bit"]

BETAS = (0.9, 0.999)
"""Of AdamW, as in the release."""
WEIGHT_DECAY = 1e-2
"""Of AdamW, as in the release."""
MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class TrainOptions:
    """How an adapter is trained.

    "Release" below is the training of CycleGAN-Turbo and of the scripts that WeatherEdit's was made
    with; they agree where nothing else is said.

    Raises:
        ArgumentError: If a choice is none; the message names it.
    """

    steps: int = 25_000
    """Updates of the adapter, by as many batches; 25 000 as in the documentation of
    CycleGAN-Turbo."""
    batch_size: int = 4
    """Pairs of one step, all of one style; the release of WeatherEdit's scripts has 4."""
    accumulate: int = 1
    """Equal parts of a batch that are computed one after the other: memory is that of a part, the
    gradient that of the batch."""
    objective: Objective = "paired"
    """"paired" compares with the target of an aligned pair, "epsilon" is the objective that the
    paper states, "cycle" is the release's, for pictures of other places; see `objectives`."""
    paired: PairedWeights = field(default_factory=PairedWeights)
    """Weights of "paired"."""
    epsilon: EpsilonWeights = field(default_factory=EpsilonWeights)
    """Weights of "epsilon"."""
    cycle: CycleWeights = field(default_factory=CycleWeights)
    """Weights of "cycle"; the release's."""
    perceptual: Perceptual = "vae"
    """Distance of pictures as networks see them: "vae" needs no other weights, "lpips" is the
    release's, "none" goes with weights of 0; see `perceptual`."""
    discriminator: DiscriminatorKind = "patch"
    """Of "cycle", one for each style: "patch" needs no other weights, "clip" is the release's; see
    `discriminator`."""
    clip_model: str = CLIP
    """For discriminator "clip": a folder, or the id of a model in the local cache."""
    learning_rate: float = 5e-6
    """Of AdamW; the release's scripts have 5e-6, its documentation 1e-5. Small models want more."""
    discriminator_learning_rate: float = 5e-6
    """Of the discriminators' AdamW; the release's is the adapter's."""
    warm_up: int = 500
    """Steps over which the learning rate rises to its own value, where it stays; the release's."""
    cool_down: int = 0
    """Steps at the end over which the learning rate falls to 0; the release has none. Without, a
    short training with a high rate ends where its last batches pushed it."""
    clip: float = 10.0
    """Largest norm of a gradient; larger ones are scaled down to it. The release's."""
    size: tuple[int, int] = (512, 512)
    """(height, width) of the crops, pixels, multiples of 8; the release squeezes pictures to 512 x
    512, here they keep their aspect."""
    short_side: int | None = None
    """Pixels of the pictures' short side before the crop; None for as few as cover it."""
    mirrored: float = 0.5
    """Share of drawn pairs that are mirrored, in [0, 1]; 0.5 as in the release."""
    label_dropout: float = 0.1
    """Share of drawn pictures whose label is withheld, in [0, 1], so that the adapter can do
    without; our choice."""
    styles: tuple[str, ...] | None = None
    """Styles that the adapter learns; None for all that the list trains. One makes a single-style
    adapter."""
    conditioning: Conditioning = "groups"
    """How the label enters; see `AdapterSpec`."""
    unet_rank: int = 128
    """Of the low-rank set of each style; the release's."""
    vae_rank: int = 4
    """Of the VAE's low-rank set; the release's."""
    skips: bool = True
    """Whether the decoder sees the encoder's activations; as in the release."""
    optimiser: Optimiser = "adamw"
    """"adamw8bit" keeps moments in a byte each and needs the package bitsandbytes and CUDA."""
    mixed_precision: Precision = "no"
    """Of activations: "bf16" on a CPU or a GPU, "fp16" on a GPU only. The release trains in
    float32; half precision there often learnt nothing (GaParmar/img2img-turbo issue 84)."""
    gradient_checkpointing: bool = False
    """Compute activations again for the gradient instead of keeping them: less memory, a third more
    time, the same gradients."""
    save_every: int = 500
    """Steps between two states on disk: what a kill costs at the most."""
    sample_every: int = 500
    """Steps between two sample grids; 0 for one at the end only."""
    validate_every: int = 500
    """Steps between two validations on the split "val"; 0 for one at the end only."""
    validate_count: int = 16
    """Pairs of each style that a validation looks at, the first of the list."""
    seed: int = 0
    """Of everything that is drawn."""
    threads: int | None = None
    """Of torch on a CPU; None for its own choice. The adapter's last bits depend on it."""
    workers: int = 0
    """Processes that read pictures; nothing depends on it."""
    device: str = "cpu"
    """"cpu" or "cuda"; choose one of several GPUs by CUDA_VISIBLE_DEVICES."""

    def __post_init__(self) -> None:
        self._check_counts()
        self._check_choices()
        for name in ("learning_rate", "discriminator_learning_rate"):
            if not finite(name, getattr(self, name), 0, 1) > 0:
                raise ArgumentError(f"{name} must be above 0")
        if not finite("clip", self.clip, 0) > 0:
            raise ArgumentError("clip must be above 0")
        finite("mirrored", self.mirrored, 0, 1)
        finite("label_dropout", self.label_dropout, 0, 1)
        check_seed("seed", self.seed)
        object.__setattr__(self, "size", checked_size(self.size))
        # Ranks and conditioning have one place where they are checked.
        self.spec(self.styles or PAIR_STYLES)

    def _check_counts(self) -> None:
        least = {
            "steps": 1,
            "batch_size": 1,
            "accumulate": 1,
            "warm_up": 0,
            "cool_down": 0,
            "save_every": 1,
            "sample_every": 0,
            "validate_every": 0,
            "validate_count": 1,
            "workers": 0,
        }
        for name, low in least.items():
            _count(name, getattr(self, name), low)
        for name in ("threads", "short_side"):
            if getattr(self, name) is not None:
                _count(name, getattr(self, name), 1)
        if self.batch_size % self.accumulate:
            raise ArgumentError(
                f"accumulate must divide batch_size into equal parts; {self.accumulate} does not "
                f"divide {self.batch_size}"
            )

    def _check_choices(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise ArgumentError(
                    f"{name} {printable(value)!r} is not one of {', '.join(choices)}"
                )
        if self.styles is not None:
            styles = tuple(self.styles)
            if not styles or len(set(styles)) < len(styles):
                raise ArgumentError("styles must name at least one style, and each only once")
            for style in styles:
                if style not in PAIR_STYLES:
                    raise ArgumentError(
                        f"style {printable(style)!r} is not one of {', '.join(PAIR_STYLES)}"
                    )
            object.__setattr__(self, "styles", styles)
        if self.perceptual == "none":
            for name, weight in asdict(getattr(self, self.objective)).items():
                if "perceptual" in name and weight > 0:
                    raise ArgumentError(
                        f'perceptual "none" does not go with a weight of {name} of {weight:g}; set '
                        f"it to 0 (--weights {name}=0)"
                    )
        if self.device == "cpu" and self.mixed_precision == "fp16":
            raise ArgumentError('mixed_precision "fp16" needs a GPU; on a CPU take "no" or "bf16"')
        if self.device == "cpu" and self.optimiser == "adamw8bit":
            raise ArgumentError('optimiser "adamw8bit" needs a GPU; on a CPU take "adamw"')

    def spec(self, styles: tuple[str, ...]) -> AdapterSpec:
        """What an adapter of these styles consists of."""
        return AdapterSpec(
            prompts={style: PROMPTS[style] for style in styles},
            unet_rank=self.unet_rank,
            vae_rank=self.vae_rank,
            conditioning=self.conditioning,
            skips=self.skips,
        )

    def learning_rate_share(self, step: int) -> float:
        """Of the learning rates at a step, from 0 on: a linear rise, then 1, then a linear fall."""
        rise = (step + 1) / max(1, self.warm_up)
        return min(1.0, rise, (self.steps - step) / (self.cool_down + 1))

    def as_json(self) -> dict[str, Any]:
        """JSON values; the weights are those of the objective alone."""
        values = asdict(self)
        others = set(get_args(Objective)) - {self.objective}
        kept = {name: value for name, value in values.items() if name not in others}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in kept.items()}

    def with_weights(self, weights: Mapping[str, float]) -> TrainOptions:
        """The same with other weights of the objective's losses, by name.

        Raises:
            ArgumentError: If the objective has no such loss.
        """
        old = getattr(self, self.objective)
        known = asdict(old)
        for name in weights:
            if name not in known:
                raise ArgumentError(
                    f"the objective {self.objective} has no weight {printable(name)!r}; it has "
                    f"{', '.join(known)}"
                )
        changed: dict[str, Any] = {self.objective: replace(old, **weights)}
        return replace(self, **changed)


_CHOICES: dict[str, tuple[str, ...]] = {
    "objective": get_args(Objective),
    "perceptual": get_args(Perceptual),
    "discriminator": get_args(DiscriminatorKind),
    "optimiser": get_args(Optimiser),
    "mixed_precision": get_args(Precision),
    "device": ("cpu", "cuda"),
}


def _count(name: str, value: Any, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= MOST_STEPS:
        raise ArgumentError(
            f"{name} must be an integer in {least}..{MOST_STEPS}, got {printable(value)}"
        )
