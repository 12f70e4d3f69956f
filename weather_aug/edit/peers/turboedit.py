"""TurboEdit: a few-step model edits a picture by inverting it, with the text changed."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug.clip.types import Frame
from weather_aug.edit.background import Moment
from weather_aug.edit.devices import device_of
from weather_aug.edit.diffusion.base import Base, load_base
from weather_aug.edit.diffusion.options import SD_TURBO
from weather_aug.edit.peers.draws import generator_of
from weather_aug.edit.peers.instruct import unit_tensor
from weather_aug.edit.peers.inversion import MOST_Z, draw, edited_latent, schedule
from weather_aug.edit.peers.options import PeerOptions, check_style, styles_of
from weather_aug.edit.peers.pictures import fitted, restored
from weather_aug.edit.peers.pipelines import LIBRARIES, precision_of

UInt8 = NDArray[np.uint8]

STEPS, WEIGHT = 4, 1.5
SOURCE = "Picture of a normal weather scene"
PROMPTS = {
    "rain": "Picture of a rainy weather scene",
    "snow": "Picture of a snowy weather scene",
    "fog": "Picture of a foggy weather scene",
}
"""The texts of WeatherEdit's own editor."""


class TurboEdit:
    """A `BackgroundEditor` by edit-friendly inversion in a few steps; see `inversion`.

    Options: `base` (stabilityai/sd-turbo), `steps` (4), `guidance` (weight of the pseudo-guidance,
    1.5), `prompts` and `source_prompt` (the texts of WeatherEdit's editor).

    Convention:
        As `BackgroundEditor`. Noise is keyed by seed, frame and style. Frames do not see each
        other. The authors run SDXL-Turbo; this takes models of SD-Turbo's shape, with one text
        encoder and a VAE of SD 2.1, which has the same schedule of noise.

    Source:
        As `inversion`.
    """

    name = "turboedit"

    def __init__(self, base: Base, options: PeerOptions) -> None:
        self.base, self.options = base, options
        self._device, self._dtype = device_of(options.device), precision_of(options)
        self._plan = schedule(int(options.steps or STEPS))
        texts = [str(options.source_prompt), *dict(options.prompts or {}).values()]
        embedded = base.embed(texts).to(self._device, self._dtype).split(1)
        self._source = embedded[0]
        self._target = dict(zip(options.prompts or {}, embedded[1:], strict=True))
        self._unet, self._vae = (self._placed(net) for net in (base.unet, base.vae))

    def _placed(self, net: Any) -> Any:
        net = net.to(self._device)
        return net.half() if self.options.half else net

    @classmethod
    def load(cls, options: PeerOptions) -> TurboEdit:
        """Read the model from disk.

        Raises:
            ArgumentError: If an option is not of this peer.
            DataError: If the model is not there, which says how to fetch it, or is another.
            MissingExtraError: If diffusers is not installed.
        """
        options = options.of(
            cls.name,
            base=SD_TURBO,
            steps=STEPS,
            guidance=WEIGHT,
            prompts=PROMPTS,
            source_prompt=SOURCE,
        )
        return cls(load_base(str(options.base)), options)

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is a text for."""
        return styles_of(self.options.prompts)

    @property
    def card(self) -> Mapping[str, Any]:
        """Digest of the model, options and versions."""
        return {
            "editor": self.name,
            "base_digest": self.base.digest,
            "timesteps": list(self._plan.steps),
            "noise_timesteps": list(self._plan.noise_steps),
            "most_z": MOST_Z,
            "versions": {name: version(name) for name in LIBRARIES},
            **self.options.card("guidance", "prompts", "source_prompt", "height", "half", "seed"),
        }

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `BackgroundEditor.edit`."""
        check_style(style, self.styles)
        return tuple(self._edited(frame, style) for frame in moment.now)

    def _edited(self, frame: Frame, style: str) -> UInt8:
        image = fitted(frame.image, self.options.height, self.base.factor)
        pixels = (2 * unit_tensor(image) - 1).to(self._device, self._dtype)
        scale = self._vae.config.scaling_factor
        with torch.inference_mode():
            latent = scale * self._vae.encode(pixels).latent_dist.mode()
            generator = generator_of(self.options.seed, frame.key, style)
            noise = draw(self._plan.steps, latent.shape[1:], generator)
            edit = edited_latent(
                latent,
                noise.to(latent),
                self._predict,
                (self._source, self._target[style]),
                self._plan,
                self.base.alpha_bars,
                weight=float(self.options.guidance or 0.0),
            )
            out = self._vae.decode(edit / scale).sample
        unit = ((out[0].float() + 1) / 2).permute(1, 2, 0).cpu().numpy()
        return restored(unit, frame, self.options.height)

    def _predict(self, samples: torch.Tensor, step: int, embeddings: torch.Tensor) -> torch.Tensor:
        noise: torch.Tensor = self._unet(samples, step, encoder_hidden_states=embeddings).sample
        return noise
