"""The command that trains the diffusion editor's adapter."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from weather_aug.cli.terminal import say, to_people
from weather_aug.cli.values import numbers_by_name

if TYPE_CHECKING:
    from weather_aug.edit.diffusion.train_options import TrainOptions

_OWN = ("pairs", "base", "out", "restart", "weights")


@dataclass(frozen=True)
class TrainEditor:
    """Train an adapter for all weathers on pairs of pictures; run again to continue.

    What is not given is as `TrainOptions` has it.
    """

    pairs: Positional[Path]
    """List of pairs, one a line; see `edit.diffusion.pairs`."""
    base: str
    """Folder of a one-step diffusion model, or the id of one in the local cache
    (stabilityai/sd-turbo)."""
    out: Path
    """Folder to make for the adapter."""
    objective: str | None = None
    """paired (compare with the target; the default), epsilon (the paper's) or cycle (the release's,
    for pictures of other places)."""
    steps: int | None = None
    """Batches to learn from; 25000 if not given."""
    batch_size: int | None = None
    """Pairs of a batch; 4 if not given."""
    accumulate: int | None = None
    """Parts in which a batch is computed, to save memory; 1 if not given."""
    size: tuple[int, int] | None = None
    """Height and width of the crops, pixels, multiples of 8; 512 512 if not given."""
    short_side: int | None = None
    """Short side of the pictures before the crop, pixels; as small as covers it if not given."""
    styles: tuple[str, ...] | None = None
    """Styles to learn; all that the list trains if not given. One makes a single-style adapter."""
    weights: tuple[str, ...] = ()
    """Weights of the objective's losses, "name=value", such as l1=1 perceptual=5."""
    perceptual: str | None = None
    """Distance as a network sees it: vae (the default), lpips or none."""
    discriminator: str | None = None
    """For cycle: patch (the default) or clip."""
    clip_model: str | None = None
    """For --discriminator clip: a folder, or the id of a model in the local cache."""
    learning_rate: float | None = None
    """5e-6 if not given; small models want more."""
    discriminator_learning_rate: float | None = None
    """5e-6 if not given."""
    warm_up: int | None = None
    """Steps over which the learning rate rises; 500 if not given."""
    cool_down: int | None = None
    """Steps at the end over which the learning rate falls to 0; 0 if not given."""
    clip: float | None = None
    """Largest norm of a gradient; 10 if not given."""
    mirrored: float | None = None
    """Share of pairs that are mirrored; 0.5 if not given."""
    conditioning: str | None = None
    """How labels enter: groups (the default), embedding, gray or none."""
    label_dropout: float | None = None
    """Share of pictures whose label is withheld; 0.1 if not given."""
    unet_rank: int | None = None
    """Of each style's low-rank set; 128 if not given."""
    vae_rank: int | None = None
    """Of the VAE's low-rank set; 4 if not given."""
    skips: bool = True
    """Whether the decoder sees the encoder's activations."""
    optimiser: str | None = None
    """adamw (the default) or adamw8bit, which needs bitsandbytes and a GPU."""
    mixed_precision: str | None = None
    """no (the default), bf16, or fp16 on a GPU."""
    gradient_checkpointing: bool = False
    """Less memory for a third more time."""
    save_every: int | None = None
    """Steps between two states on disk; 500 if not given."""
    sample_every: int | None = None
    """Steps between two sample grids, 0 for one at the end only; 500 if not given."""
    validate_every: int | None = None
    """Steps between two validations, 0 for one at the end only; 500 if not given."""
    validate_count: int | None = None
    """Pairs of each style that a validation looks at; 16 if not given."""
    seed: int | None = None
    """Of everything that is drawn; 0 if not given."""
    threads: int | None = None
    """Of torch on a CPU; its own choice if not given."""
    workers: int | None = None
    """Processes that read pictures; 0 if not given."""
    device: str | None = None
    """cpu (the default) or cuda."""
    restart: bool = False
    """Drop unfinished work of another training that stands beside `out`."""

    def run(self) -> None:
        """Train, say how well it does, and name what was made."""
        # Loads torch.
        from weather_aug.edit.diffusion.train import train_editor

        report = train_editor(
            self.pairs,
            self.base,
            self.out,
            self.options(),
            restart=self.restart,
            progress=to_people(),
        )
        trained = ", ".join(f"{count} {style}" for style, count in report.pairs.items())
        resumed = f", of which {report.resumed_at} were done before" if report.resumed_at else ""
        say(f"{report.steps} steps{resumed} on pairs of {trained}")
        say(f"losses at the end: {_told(report.losses)}")
        for style, losses in report.validation.items():
            say(f"held out, {style}: {_told(losses)}")
        say(f"adapter {self.out}; look at")
        say(str(report.sample))

    def options(self) -> TrainOptions:
        """What the flags say.

        Raises:
            ArgumentError: If a flag's value is none.
        """
        from weather_aug.edit.diffusion.train_options import TrainOptions

        chosen: dict[str, Any] = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name not in _OWN and getattr(self, field.name) is not None
        }
        weights = parsed_weights(self.weights)
        if weights:
            # First of all: whether choices go together depends on them.
            named: dict[str, Any] = {"objective": self.objective} if self.objective else {}
            weighted = TrainOptions(**named).with_weights(weights)
            chosen[weighted.objective] = getattr(weighted, weighted.objective)
        return TrainOptions(**chosen)


def parsed_weights(items: tuple[str, ...]) -> dict[str, float]:
    """Weights by name of texts "name=value".

    Raises:
        ArgumentError: If a text is no name and number, or a name stands twice.
    """
    return numbers_by_name("--weights", "name=value, such as l1=1", items)


def _told(losses: Any) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in losses.items())
