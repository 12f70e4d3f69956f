"""The base model with an adapter: pictures in, pictures in a weather out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

from weather_aug._extras import require
from weather_aug.edit.diffusion.base import TO, Base
from weather_aug.edit.diffusion.conditioning import LabelStem
from weather_aug.edit.diffusion.one_step import LAST_STEP, latent_of_noise
from weather_aug.edit.diffusion.skips import Encoded, Skips, decode, encode
from weather_aug.edit.diffusion.spec import CLEAR, AdapterSpec
from weather_aug.errors import ArgumentError, DataError, printable

SHARED = "shared"
"""Name of the VAE's low-rank set."""
SET = "style_{}"
"""Of a style's; a bare "clear" would be a method of torch's containers."""


class FullConv(nn.Module):
    """A convolution and a learnt change of all its weights, zero at first."""

    def __init__(self, base: Any) -> None:
        super().__init__()
        self.base = base
        self.change = nn.Conv2d(
            base.in_channels,
            base.out_channels,
            kernel_size=base.kernel_size,
            stride=base.stride,
            padding=base.padding,
        )
        for parameter in self.change.parameters():
            nn.init.zeros_(parameter)

    def forward(self, hidden: torch.Tensor) -> torch.Tensor:
        """As the base's."""
        out: torch.Tensor = self.base(hidden) + self.change(hidden)
        return out


class AdaptedModel(nn.Module):
    """A base with one low-rank set per style; see `AdapterSpec`.

    Convention:
        Owns the base it is given and adds layers to its networks; the base's own weights stay as
        they are, frozen. Which styles act is chosen by `styled` around a call. Trainable, unless it
        is `frozen`, is all that the adapter consists of; gradients reach the sets that acted.

    Args:
        base: Used up: load another for another adapter.
        spec: What to add.
        seed: Of the low-rank sets' first factors; the second are zero.

    Raises:
        ArgumentError: If a target names no layer of the base.
    """

    def __init__(self, base: Base, spec: AdapterSpec, *, seed: int = 0) -> None:
        super().__init__()
        self.base, self.spec = base, spec
        self.unet, self.vae = base.unet, base.vae
        self.checkpointing = False
        self.learns = True
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            for style in spec.styles:
                rank = spec.unet_rank
                _add_low_rank(self.unet, SET.format(style), spec.unet_targets, rank, rank)
            self.skips = Skips(self.vae) if spec.skips else None
            self.stem = None
            if spec.conditioning != "none":
                self.stem = LabelStem(spec.conditioning, self.vae.encoder.conv_in)
            alpha = spec.vae_scale * spec.vae_rank
            _add_low_rank(self.vae, SHARED, spec.vae_targets, spec.vae_rank, alpha)
            self.unet.conv_in = FullConv(self.unet.conv_in)
        embedded = base.embed([spec.prompts[style] for style in spec.styles])
        self.register_buffer("prompts", embedded, persistent=False)
        self._sets = [p for name, p in self.unet.named_parameters() if ".lora_" in name]
        self._open: list[dict[str, float]] = []
        self._active: dict[str, float] = {}
        for parameter in self.trained().values():
            parameter.requires_grad_(True)

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self.get_buffer("prompts").device

    @property
    def dtype(self) -> torch.dtype:
        """Of its activations."""
        return self.get_buffer("prompts").dtype

    @property
    def acting(self) -> dict[str, float]:
        """Weights by style of the sets that act now."""
        return dict(self._active)

    def forward(
        self, image: torch.Tensor, label: torch.Tensor | None, style: str | Mapping[str, float]
    ) -> torch.Tensor:
        """Pictures in a style.

        Args:
            image: (B, 3, H, W) in [-1, 1]; sides are multiples of `base.factor`.
            label: (B, H, W) train ids, or None.
            style: Its name, or weights of several.

        Returns:
            (B, 3, H, W), not cut to [-1, 1].
        """
        encoded = self.encode(image, label)
        with self.styled(style) as prompt:
            noise = self.noise(encoded.latent, prompt)
        return self.decode(self.latent_of(encoded.latent, noise), encoded.skips)

    def encode(self, image: torch.Tensor, label: torch.Tensor | None) -> Encoded:
        """Latent and skips of (B, 3, H, W) pictures in [-1, 1] and (B, H, W) labels."""
        return encode(self.vae, image, label, self.stem, checkpointing=self.checkpointing)

    def noise(
        self, latent: torch.Tensor, prompt: torch.Tensor, time: torch.Tensor | int = LAST_STEP
    ) -> torch.Tensor:
        """The noise that the UNet sees in (B, 4, h, w) latents, under a (tokens, width) prompt."""
        states = prompt.expand(latent.shape[0], -1, -1).to(latent.dtype)
        out: torch.Tensor = self.unet(latent, time, encoder_hidden_states=states).sample
        return out

    def latent_of(self, latent: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Where one step from the last time leads."""
        return latent_of_noise(latent, noise, self.base.alpha_bar)

    def decode(self, latent: torch.Tensor, skips: Sequence[torch.Tensor]) -> torch.Tensor:
        """(B, 3, H, W) of latents and the skips of the pictures that they come from."""
        convs = () if self.skips is None else tuple(self.skips)
        return decode(self.vae, latent, skips, convs, checkpointing=self.checkpointing)

    @contextmanager
    def styled(self, style: str | Mapping[str, float]) -> Iterator[torch.Tensor]:
        """Let styles act inside the block; those of a block around it act again after it.

        Args:
            style: Its name, or weights by name that sum to at most 1; what is missing to 1 is the
                clear style's, where the adapter has one.

        Yields:
            (tokens, width) of their prompts, blended alike.

        Raises:
            ArgumentError: If a style is none of the adapter's, or weights are none.
        """
        weights = self.weights_of(style)
        self._open.append(weights)
        try:
            self._activate(weights)
            rows = [self.spec.styles.index(name) for name in weights]
            shares = torch.tensor(list(weights.values()), device=self.device)
            shares = (shares / shares.sum())[:, None, None]
            prompts = self.get_buffer("prompts")[rows]
            yield (shares.to(prompts.dtype) * prompts).sum(0)
        finally:
            self._open.pop()
            if self._open:
                self._activate(self._open[-1])

    def weights_of(self, style: str | Mapping[str, float]) -> dict[str, float]:
        """Weights by style, of a name or a blend; see `styled`.

        Raises:
            ArgumentError: If there is none.
        """
        weights = {style: 1.0} if isinstance(style, str) else dict(style)
        for name, weight in weights.items():
            if name not in self.spec.styles:
                raise ArgumentError(
                    f"style {printable(name)!r} is not one of {', '.join(self.spec.styles)}"
                )
            if not (math.isfinite(weight) and 0 <= weight <= 1):
                raise ArgumentError(f"the weight of {name} must be in [0, 1], got {weight!r}")
        total = math.fsum(weights.values())
        if total > 1 + 1e-6:
            raise ArgumentError(f"weights of styles sum to {total:g}; at most 1 can be given")
        if CLEAR in self.spec.styles and total < 1 - 1e-6:
            weights[CLEAR] = weights.get(CLEAR, 0.0) + 1 - total
        # In one order: sums of sets and prompts depend on it in their last bits.
        weights = {name: weights[name] for name in self.spec.styles if weights.get(name, 0) > 0}
        if not weights:
            raise ArgumentError("a blend needs a style with a weight above 0")
        return weights

    def trained(self) -> dict[str, nn.Parameter]:
        """All that an adapter consists of, by the names that its file has."""
        found = {
            name: parameter
            for name, parameter in self.named_parameters()
            if ".lora_" in name or name.startswith(("skips.", "stem.", "unet.conv_in.change."))
        }
        return dict(sorted(found.items()))

    def load_trained(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Take an adapter's tensors.

        Raises:
            DataError: If one is missing, unknown, of another shape or not finite: they belong to
                another base or another spec. Nothing is taken then.
        """
        own = self.trained()
        missing = sorted(set(own) - set(tensors)) or sorted(set(tensors) - set(own))
        if missing:
            raise DataError(
                f"the adapter's file and {self.base.name} differ in {printable(missing[0])}; it "
                "was made for a base of another shape"
            )
        for name, parameter in own.items():
            tensor = tensors[name]
            if tensor.shape != parameter.shape:
                raise DataError(
                    f"the adapter's {printable(name)} has shape {tuple(tensor.shape)}, "
                    f"{self.base.name} needs {tuple(parameter.shape)}; it was made for a base of "
                    "another shape"
                )
            if not torch.isfinite(tensor).all():
                raise DataError(f"the adapter's {printable(name)} holds NaN or infinity")
        with torch.no_grad():
            for name, parameter in own.items():
                parameter.copy_(tensors[name])

    def frozen(self) -> AdaptedModel:
        """The same model, which from now on only draws."""
        self.learns = False
        for parameter in self.trained().values():
            parameter.requires_grad_(False)
        return self.eval()

    def _activate(self, weights: Mapping[str, float]) -> None:
        if weights == self._active:
            return
        self._active = dict(weights)
        self.unet.set_adapters([SET.format(style) for style in weights], list(weights.values()))
        # The library freezes the sets that do not act, and gradients of those that acted with them.
        for parameter in self._sets:
            parameter.requires_grad_(self.learns)


def _add_low_rank(network: Any, name: str, targets: Sequence[str], rank: int, alpha: float) -> None:
    peft = require("peft", extra="edit", to=TO)
    layers = [
        path.removesuffix(".base_layer")
        for path, module in network.named_modules()
        if isinstance(module, nn.Linear | nn.Conv2d) and ".lora_" not in path
    ]
    chosen = [path for path in layers if any(_ends(path, target) for target in targets)]
    if not chosen:
        raise ArgumentError(f"the base has none of the layers {', '.join(targets)}")
    config = peft.LoraConfig(
        r=rank, lora_alpha=alpha, target_modules=chosen, init_lora_weights="gaussian"
    )
    with warnings.catch_warnings():
        # Several sets in one model are what this is about.
        warnings.filterwarnings("ignore", message="Already found a `peft_config`")
        network.add_adapter(config, adapter_name=name)


def _ends(path: str, target: str) -> bool:
    return path == target or path.endswith("." + target)
