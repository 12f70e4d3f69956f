"""ControlNet: Stable Diffusion led by a picture of the street's classes, edges or depth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._extras import require
from weather_aug.clip.types import Frame
from weather_aug.edit.background import Moment
from weather_aug.edit.loading import read_network
from weather_aug.edit.peers.conditions import PUBLISHED, condition_of
from weather_aug.edit.peers.draws import generator_of
from weather_aug.edit.peers.instruct import unit_tensor
from weather_aug.edit.peers.options import PeerOptions, check_style, styles_of
from weather_aug.edit.peers.pictures import fitted, restored
from weather_aug.edit.peers.pipelines import (
    load_pipeline,
    needs_of,
    pipeline_card,
    precision_of,
    quiet,
)
from weather_aug.edit.weights import digest_of, located
from weather_aug.errors import ArgumentError, DataError, printable

UInt8 = NDArray[np.uint8]

STABLE_DIFFUSION = "stable-diffusion-v1-5/stable-diffusion-v1-5"
PROMPTS = {
    "rain": "a photo of a street in heavy rain, wet road, overcast sky",
    "snow": "a photo of a street in winter, covered with snow",
    "fog": "a photo of a street in dense fog",
}
STEPS, GUIDANCE, STRENGTH, CONDITIONING = 50, 7.5, 0.8, 0.8
"""Defaults of diffusers' pipeline; WeatherEdit does not state what it compares with."""
CONDITION = "ade20k"
_TO = "edit backgrounds with ControlNet"


class ControlNet:
    """A `BackgroundEditor` that paints the picture anew under a text, led by a condition picture.

    Options: `base` (Stable Diffusion 1.5), `control` (the published ControlNet of the condition),
    `condition` ("ade20k"; see `conditions`), `conditioning` (0.8), `strength` (0.8), `steps` (50,
    of which `strength` is the share that runs), `guidance` (7.5), `prompts`.

    Convention:
        As `BackgroundEditor`. Noise is keyed by seed, frame and style. Frames do not see each
        other.

    Source:
        Zhang, Rao and Agrawala, "Adding Conditional Control to Text-to-Image Diffusion Models",
        ICCV 2023; diffusers' StableDiffusionControlNetImg2ImgPipeline.
    """

    name = "controlnet"

    def __init__(self, pipeline: Any, options: PeerOptions, card: Mapping[str, Any]) -> None:
        self._pipeline, self.options, self._card = pipeline, options, dict(card)

    @classmethod
    def load(cls, options: PeerOptions) -> ControlNet:
        """Read both models from disk.

        Raises:
            ArgumentError: If an option is not of this peer, no ControlNet is published for the
                condition and none is given, or no step is left to run.
            DataError: If a model is not there, which says how to fetch it, or they do not belong
                together.
            MissingExtraError: If diffusers is not installed.
        """
        condition = options.condition or CONDITION
        if options.control is None and condition not in PUBLISHED:
            raise ArgumentError(
                f"condition {condition!r} has no published ControlNet; give control=FOLDER, or "
                f"take one of {', '.join(PUBLISHED)}"
            )
        options = options.of(
            cls.name,
            base=STABLE_DIFFUSION,
            control=PUBLISHED.get(condition),
            condition=condition,
            conditioning=CONDITIONING,
            strength=STRENGTH,
            steps=STEPS,
            guidance=GUIDANCE,
            prompts=PROMPTS,
        )
        steps, strength = options.steps or STEPS, options.strength or STRENGTH
        if int(steps * strength) < 1:
            raise ArgumentError(
                f"of {steps} steps a strength of {strength:g} runs none; give more of either"
            )
        folder = located(str(options.base), to=_TO, what="the text model", needs=needs_of())
        control = located(
            str(options.control), to=_TO, what="the ControlNet", needs=("config.json",)
        )
        net = _read(control, options)
        pipeline = load_pipeline(
            "StableDiffusionControlNetImg2ImgPipeline", folder, options, to=_TO, controlnet=net
        )
        _check(pipeline.unet, net, folder, control)
        card = {
            "editor": cls.name,
            **pipeline_card(folder, options),
            "control_digest": digest_of(control),
            **options.card("condition", "conditioning", "strength", "steps", "guidance", "prompts"),
        }
        return cls(pipeline, options, card)

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is a text for."""
        return styles_of(self.options.prompts)

    @property
    def card(self) -> Mapping[str, Any]:
        """Digests of both models, options and versions."""
        return self._card

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `BackgroundEditor.edit`.

        Raises:
            ArgumentError: If the style is none of the editor's.
            DataError: If a frame lacks the label or depth that is to be shown.
        """
        check_style(style, self.styles)
        return tuple(self._edited(frame, style) for frame in moment.now)

    def _edited(self, frame: Frame, style: str) -> UInt8:
        options = self.options
        shown = condition_of(frame, str(options.condition), options.height)
        with quiet():
            out = self._pipeline(
                prompt=(options.prompts or {})[style],
                image=unit_tensor(fitted(frame.image, options.height)),
                control_image=unit_tensor(shown),
                strength=options.strength,
                num_inference_steps=options.steps,
                guidance_scale=options.guidance,
                controlnet_conditioning_scale=float(options.conditioning or 0.0),
                generator=generator_of(options.seed, frame.key, style),
                output_type="np",
            )
        return restored(out.images[0], frame, options.height)


def _read(folder: Path, options: PeerOptions) -> Any:
    diffusers = require("diffusers", extra="edit", to=_TO)
    return read_network(diffusers.ControlNetModel, folder, dtype=precision_of(options))


def _check(unet: Any, net: Any, folder: Path, control: Path) -> None:
    if unet.config.in_channels != net.config.in_channels:
        raise DataError(
            f"{printable(folder, 200)}: its UNet takes {unet.config.in_channels} channels, the "
            f"ControlNet was made for {net.config.in_channels}; give the model it was trained on"
        )
    for name in ("block_out_channels", "cross_attention_dim"):
        ours, theirs = getattr(unet.config, name), getattr(net.config, name)
        if ours != theirs:
            raise DataError(
                f"{printable(control, 200)}: the ControlNet's {name} is {printable(theirs)}, the "
                f"model's is {printable(ours)}; give the model it was trained on"
            )
