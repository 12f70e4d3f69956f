"""InstructPix2Pix: a diffusion model that was taught to follow instructions on a picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug._extras import require
from weather_aug.clip.types import Frame
from weather_aug.edit.background import Moment
from weather_aug.edit.peers.draws import generator_of
from weather_aug.edit.peers.options import PeerOptions, check_style, styles_of
from weather_aug.edit.peers.pictures import fitted, restored
from weather_aug.edit.peers.pipelines import load_pipeline, needs_of, pipeline_card, quiet
from weather_aug.edit.weights import located
from weather_aug.errors import DataError, printable

UInt8 = NDArray[np.uint8]

INSTRUCT_PIX2PIX = "timbrooks/instruct-pix2pix"
INSTRUCTIONS = {"rain": "make it rainy", "snow": "make it snowy", "fog": "make it foggy"}
TEXT_GUIDANCE, IMAGE_GUIDANCE, STEPS = 7.5, 1.5, 100
"""Defaults of the authors' program, with which WeatherEdit compares."""
CHANNELS = 8
"""Of the UNet: the noisy latent's and the picture's."""
_TO = "edit backgrounds with InstructPix2Pix"


class InstructPix2Pix:
    """A `BackgroundEditor` that follows an instruction, picture by picture.

    Options: `base` (timbrooks/instruct-pix2pix), `steps` (100), `guidance` (of the text, 7.5),
    `image_guidance` (1.5), `prompts` (instructions: "make it snowy").

    Convention:
        As `BackgroundEditor`. The sampler is Euler's ancestral one, as in the authors' program; its
        noise is keyed by seed, frame and style. Frames do not see each other.

    Source:
        Brooks, Holynski and Efros, "InstructPix2Pix: Learning to Follow Image Editing
        Instructions", CVPR 2023; diffusers' pipeline of that name.
    """

    name = "instruct-pix2pix"

    def __init__(self, pipeline: Any, options: PeerOptions, card: Mapping[str, Any]) -> None:
        self._pipeline, self.options, self._card = pipeline, options, dict(card)

    @classmethod
    def load(cls, options: PeerOptions) -> InstructPix2Pix:
        """Read the model from disk.

        Raises:
            ArgumentError: If an option is not of this peer.
            DataError: If the model is not there, which says how to fetch it, or is another.
            MissingExtraError: If diffusers is not installed.
        """
        options = options.of(
            cls.name,
            base=INSTRUCT_PIX2PIX,
            steps=STEPS,
            guidance=TEXT_GUIDANCE,
            image_guidance=IMAGE_GUIDANCE,
            prompts=INSTRUCTIONS,
        )
        folder = located(str(options.base), to=_TO, what="the instruction model", needs=needs_of())
        pipeline = load_pipeline("StableDiffusionInstructPix2PixPipeline", folder, options, to=_TO)
        channels = pipeline.unet.config.in_channels
        if channels != CHANNELS:
            raise DataError(
                f"{printable(folder, 200)}: its UNet takes {channels} channels, InstructPix2Pix's "
                f"takes {CHANNELS}; give {INSTRUCT_PIX2PIX} or one of its shape"
            )
        pipeline.scheduler = _ancestral(pipeline.scheduler.config)
        card = {
            "editor": cls.name,
            **pipeline_card(folder, options),
            **options.card("steps", "guidance", "image_guidance", "prompts"),
        }
        return cls(pipeline, options, card)

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is an instruction for."""
        return styles_of(self.options.prompts)

    @property
    def card(self) -> Mapping[str, Any]:
        """Digest of the model, options and versions."""
        return self._card

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `BackgroundEditor.edit`."""
        check_style(style, self.styles)
        return tuple(self._edited(frame, style) for frame in moment.now)

    def _edited(self, frame: Frame, style: str) -> UInt8:
        rows = self.options.height
        with quiet():
            out = self._pipeline(
                prompt=(self.options.prompts or {})[style],
                image=unit_tensor(fitted(frame.image, rows)),
                num_inference_steps=self.options.steps,
                guidance_scale=self.options.guidance,
                image_guidance_scale=self.options.image_guidance,
                generator=generator_of(self.options.seed, frame.key, style),
                output_type="np",
            )
        return restored(out.images[0], frame, rows)


def unit_tensor(image: UInt8) -> torch.Tensor:
    """(1, 3, H, W) float32 in [0, 1] of a picture, as diffusers' pipelines take it."""
    return torch.from_numpy(image.astype(np.float32) / 255.0).permute(2, 0, 1)[None]


def _ancestral(config: Any) -> Any:
    """Euler's ancestral sampler on a model's schedule."""
    diffusers = require("diffusers", extra="edit", to=_TO)
    with quiet():
        return diffusers.EulerAncestralDiscreteScheduler.from_config(config)
