"""Networks that tell real pictures of a style from edited ones, and what they cost both sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from weather_aug._extras import require
from weather_aug._keys import key_of
from weather_aug.edit.diffusion.adapted import SET
from weather_aug.edit.weights import located, readable
from weather_aug.errors import ArgumentError, printable

DiscriminatorKind = Literal["patch", "clip"]
Logits = tuple[torch.Tensor, ...]
"""(B, 1, h, w) of each level: above 0 where it takes the picture for real."""

CLIP = "openai/clip-vit-base-patch32"
"""The backbone of the release's discriminators."""
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
"""Of the pictures in [0, 1] that CLIP was trained on."""
HEAD_CHANNELS = 256
"""Of a head between its two convolutions; the release's."""
SLOPE = 0.2
"""Of the leaky rectifiers."""
TO = "train with the CLIP discriminator"


def make_discriminators(
    kind: DiscriminatorKind,
    styles: Sequence[str],
    *,
    clip: str | Path = CLIP,
    seed: int = 0,
) -> Discriminators:
    """A new one for each style.

    Args:
        kind: "patch" for `PatchDiscriminator`, "clip" for `ClipDiscriminator`.
        styles: Their names.
        clip: Folder of a CLIP model in the layout of transformers, or an id that is in the local
            cache; read for "clip" only.
        seed: Of the first weights, which depend on it and the place in `styles` alone.

    Raises:
        ArgumentError: If the kind is none, or there are no styles.
        MissingExtraError: If "clip" needs transformers and it is not installed.
        DataError: If the CLIP model is not on this machine, or cannot be read.
    """
    if kind not in get_args(DiscriminatorKind):
        kinds = ", ".join(get_args(DiscriminatorKind))
        raise ArgumentError(f"discriminator {printable(kind)!r} is not one of {kinds}")
    if not styles or len(set(styles)) < len(styles):
        raise ArgumentError("styles must name at least one style, and each only once")
    backbone = load_clip(clip) if kind == "clip" else None
    made: dict[str, nn.Module] = {}
    for index, style in enumerate(styles):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(key_of("discriminator", seed, index) % 2**63)
            made[style] = PatchDiscriminator() if backbone is None else ClipDiscriminator(backbone)
    return Discriminators(made)


class Discriminators(nn.Module):
    """One discriminator for each style, by its name."""

    def __init__(self, made: dict[str, nn.Module]) -> None:
        super().__init__()
        self.styles = tuple(made)
        self.of = nn.ModuleDict({SET.format(style): net for style, net in made.items()})

    def __getitem__(self, style: str) -> nn.Module:
        """A style's."""
        return self.of[SET.format(style)]


class PatchDiscriminator(nn.Module):
    """Whether patches of pixels are real, at several scales (PatchGAN; Isola et al., 2017).

    At every scale three convolutions of stride 2 and one of stride 1, then the logits; spectral
    norms (Miyato et al., 2018) and no batch norms, so pictures of a batch do not see each other.

    Args:
        width: Channels after the first convolution, doubled by each of the next two.
        scales: How many: the picture, its half, ...
    """

    def __init__(self, width: int = 64, scales: int = 2) -> None:
        super().__init__()
        self.least_px = 8 * 2 ** (scales - 1)
        self.scales = nn.ModuleList(_patches(width) for _ in range(scales))

    def forward(self, image: torch.Tensor) -> Logits:
        """Logits of (B, 3, H, W) pictures in [-1, 1], from the finest scale on.

        Raises:
            ArgumentError: If a side is shorter than `least_px`.
        """
        if min(image.shape[2:]) < self.least_px:
            raise ArgumentError(
                f"pictures of {tuple(image.shape[2:])} pixels are too small for the discriminator; "
                f"sides must be at least {self.least_px}"
            )
        found = []
        for net in self.scales:
            found.append(net(image))
            image = functional.avg_pool2d(image, 2, ceil_mode=True, count_include_pad=False)
        return tuple(found)


class ClipDiscriminator(nn.Module):
    """Whether a frozen CLIP sees a real picture: a small head on each of three hidden layers.

    The vision-aided discriminator (Kumari et al., 2022) as the release uses it, with a third map
    of patches in the place of the pooled embedding, and without its augmentation.

    Convention:
        The backbone may be shared by many; it is neither trained nor part of the state. Pictures
        are squeezed to its square, bilinear with antialiasing.

    Args:
        backbone: Of `load_clip`.
        layers: Hidden layers with a head, 1 the first; None for a third, two thirds and all of the
            depth: 4, 8 and 12 of ViT-B.
    """

    def __init__(self, backbone: Any, layers: Sequence[int] | None = None) -> None:
        super().__init__()
        config = backbone.config
        depth, width = config.num_hidden_layers, config.hidden_size
        if layers is None:
            layers = sorted({max(1, depth * part // 3) for part in (1, 2, 3)})
        if not layers or not all(1 <= layer <= depth for layer in layers):
            raise ArgumentError(f"layers must be in 1..{depth}, got {printable(layers)}")
        self.layers, self.side_px = tuple(layers), int(config.image_size)
        self.backbone = backbone
        self.heads = nn.ModuleList(_head(width) for _ in self.layers)
        self.register_buffer("mean", torch.tensor(CLIP_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(CLIP_STD)[:, None, None], persistent=False)
        self.register_state_dict_post_hook(_forget_backbone)
        self.register_load_state_dict_pre_hook(_recall_backbone)

    def forward(self, image: torch.Tensor) -> Logits:
        """Logits of (B, 3, H, W) pictures in [-1, 1], from the first layer on."""
        states = self.backbone(self.seen(image), output_hidden_states=True).hidden_states
        return tuple(
            head(_map(states[layer])) for head, layer in zip(self.heads, self.layers, strict=True)
        )

    def seen(self, image: torch.Tensor) -> torch.Tensor:
        """The pictures as CLIP wants them."""
        square = functional.interpolate(
            image, size=(self.side_px, self.side_px), mode="bilinear", antialias=True
        )
        return (square / 2 + 0.5 - self.get_buffer("mean")) / self.get_buffer("std")

    def train(self, mode: bool = True) -> ClipDiscriminator:
        """Train the heads; the backbone stays in evaluation."""
        super().train(mode)
        self.backbone.eval()
        return self


def load_clip(source: str | Path) -> Any:
    """A frozen CLIPVisionModel from a folder or the local cache, never from the network.

    Raises:
        MissingExtraError: If transformers is not installed.
        DataError: If it is not there, or its files are none.
    """
    transformers = require("transformers", extra="edit", to=TO)
    what = "the CLIP model of the discriminators"
    folder = located(source, to=TO, what=what, needs=("config.json", "model.safetensors"))
    with readable(folder):
        model = transformers.CLIPVisionModel.from_pretrained(
            folder, local_files_only=True, use_safetensors=True
        )
    return model.eval().requires_grad_(False)


def judged(discriminator: nn.Module, image: torch.Tensor) -> Logits:
    """A discriminator's logits with gradients to the picture and none to its own weights."""
    frozen = {name: parameter.detach() for name, parameter in discriminator.named_parameters()}
    logits: Logits = torch.func.functional_call(discriminator, frozen, (image,))
    return logits


def generator_loss(logits: Logits) -> torch.Tensor:
    """What an edited picture costs the model: -log p(real), a mean per level, summed."""
    return torch.stack([functional.softplus(-level.float()).mean() for level in logits]).sum()


def discriminator_loss(real: Logits, fake: Logits) -> dict[str, torch.Tensor]:
    """What both cost the discriminator, each a mean per level, summed over the levels.

    Returns:
        "real", -log p(real) of the real pictures; "fake", -log(1 - p(real)) of the edited ones.
    """
    taken = torch.stack([functional.softplus(level.float()).mean() for level in fake]).sum()
    return {"fake": taken, "real": generator_loss(real)}


def _patches(width: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    before = 3
    for after in (width, 2 * width, 4 * width):
        layers += [spectral_norm(nn.Conv2d(before, after, 4, stride=2, padding=1))]
        layers += [nn.LeakyReLU(SLOPE)]
        before = after
    layers += [spectral_norm(nn.Conv2d(before, before, 3, padding=1)), nn.LeakyReLU(SLOPE)]
    layers += [spectral_norm(nn.Conv2d(before, 1, 3, padding=1))]
    return nn.Sequential(*layers)


def _head(width: int) -> nn.Sequential:
    return nn.Sequential(
        spectral_norm(nn.Conv2d(width, HEAD_CHANNELS, 3, padding=1)),
        nn.LeakyReLU(SLOPE),
        spectral_norm(nn.Conv2d(HEAD_CHANNELS, 1, 1)),
    )


def _map(tokens: torch.Tensor) -> torch.Tensor:
    """(B, C, n, n) of (B, 1 + n n, C): the patches without the class token."""
    patches = tokens[:, 1:].transpose(1, 2)
    side = round(patches.shape[2] ** 0.5)
    return patches.unflatten(2, (side, side))


def _forget_backbone(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for name in [name for name in state if name.startswith(prefix + "backbone.")]:
        del state[name]


def _recall_backbone(module: Any, state: dict[str, Any], prefix: str, *_: Any) -> None:
    own = module.backbone.state_dict()
    state.update({f"{prefix}backbone.{name}": tensor for name, tensor in own.items()})
