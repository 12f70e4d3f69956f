"""The diffusion editor: a rig's pictures at one time, edited with their neighbours in sight."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from weather_aug.clip.images import resized_label
from weather_aug.clip.types import Frame
from weather_aug.edit.background import STYLES, Moment
from weather_aug.edit.devices import device_of
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.adapter_files import (
    CARD,
    Card,
    load_adapter,
    read_card,
    read_trained_on,
)
from weather_aug.edit.diffusion.attention import temporal_view
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.leakage import TrainedOn
from weather_aug.edit.diffusion.options import AttentionWeights, DiffusionOptions
from weather_aug.edit.diffusion.references import Links, view_references, window_links
from weather_aug.edit.diffusion.skips import Encoded
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.taxonomy import IGNORE

UInt8 = NDArray[np.uint8]

LATENTS_KEPT = 32
"""By their pixels: more than three times of six cameras, a few MB."""


class DiffusionEditor:
    """A `BackgroundEditor` on a one-step diffusion model and an adapter for all weathers.

    Convention:
        As `BackgroundEditor`: pictures depend on the card and the moment alone; nothing is drawn at
        random. Bits may differ between devices and versions of torch. Networks are held once;
        memory is that of one moment's window, three times the rig, whatever the clip's length.
        Labels are seen where frames have them.

    Args:
        model: Base and adapter.
        options: How it is run.
        card: Of the adapter.
        trained_on: What the adapter was trained on, None where nobody recorded it.
    """

    name = "diffusion"

    def __init__(
        self,
        model: AdaptedModel,
        options: DiffusionOptions,
        card: Card,
        trained_on: TrainedOn | None = None,
    ) -> None:
        self.options, self._card, self._trained_on = options, card, trained_on
        dtype = torch.float16 if options.half else torch.float32
        self.model = model.to(device_of(options.device), dtype)
        self.attention = effective_weights(options)
        self._latents: OrderedDict[bytes, torch.Tensor] = OrderedDict()

    @classmethod
    def load(cls, options: DiffusionOptions) -> DiffusionEditor | SingleStyleEditors:
        """Read base and adapter from disk.

        Args:
            options: Whose `adapter` is a folder of one adapter, or one with an adapter of a single
                style in each subfolder of a style's name.

        Raises:
            ArgumentError: If no adapter is given, or the device is not there.
            DataError: If base or adapter cannot be read or do not belong together, or the record
                of what the adapter was trained on is missing or none.
            IntegrityError: If the adapter's weights, or that record, are not those that it was
                saved with.
            MissingExtraError: If diffusers or peft are not installed.
        """
        if options.adapter is None:
            raise ArgumentError(
                "the diffusion editor needs adapter=FOLDER (--adapter), as `weather-aug "
                "train-editor` writes it"
            )
        # Before minutes of reading.
        device_of(options.device)
        folder = Path(options.adapter)
        singles = [style for style in STYLES if (folder / style / CARD).is_file()]
        if singles and not (folder / CARD).is_file():
            editors = {style: cls._of(folder / style, options) for style in singles}
            return SingleStyleEditors(editors)
        return cls._of(folder, options)

    @classmethod
    def _of(cls, folder: Path, options: DiffusionOptions) -> DiffusionEditor:
        card = read_card(folder)
        trained_on = read_trained_on(folder, card)
        model = load_adapter(folder, load_base(options.base), other_base=options.other_base)
        return cls(model, options, card, trained_on)

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that the adapter knows."""
        return tuple(style for style in STYLES if style in self._card.spec.styles)

    @property
    def card(self) -> Mapping[str, Any]:
        """Digests of base and adapter, and the options that pictures depend on."""
        return {
            "editor": self.name,
            "base": self.model.base.name,
            "base_revision": self.model.base.revision,
            "base_digest": self.model.base.digest,
            "adapter_sha256": self._card.sha256,
            "conditioning": self._card.spec.conditioning,
            "licence": self._card.licence,
            "training": dict(self._card.training),
            "attention": asdict(self.attention),
            "without": sorted(self.options.without),
            "height": self.options.height,
            "half": self.options.half,
            "torch": torch.__version__,
        }

    def trained_on(self, style: str) -> TrainedOn | None:
        """What the adapter was trained on; its styles share parts, so it is one for all."""
        return self._trained_on

    def edit(self, moment: Moment, style: str | Mapping[str, float]) -> tuple[UInt8, ...]:
        """The frames of now in a style, or in a blend of the adapter's styles.

        Args:
            moment: Pictures around a time; those before and after are seen by the attention only.
            style: Name of a style, or weights that sum to at most 1, the rest being clear.

        Returns:
            For each frame of now (H, W, 3) sRGB of its size.

        Raises:
            ArgumentError: If the style is none of the adapter's.
            DataError: If the cameras' pictures have different sizes and are to look at each other.
        """
        window = self._window(moment)
        with torch.inference_mode(), self.model.styled(style) as prompt:
            latents = [self._latent(frame) for frames in window for frame in frames]
            first = len(window[0])
            noises = self._noises(latents, prompt, window, self._reference_of(moment))[first:]
            edited = []
            for frame, noise in zip(moment.now, noises, strict=False):
                # Again, since the skips of a whole rig would take gigabytes.
                one = self._encoded(frame)
                latent = self.model.latent_of(one.latent, noise)
                edited.append(self._picture(self.model.decode(latent, one.skips), frame))
        return tuple(edited)

    def _window(self, moment: Moment) -> tuple[Sequence[Frame], Sequence[Frame], Sequence[Frame]]:
        """Frames before, now and after that the attention sees."""
        names = {frame.key.camera for frame in moment.now}
        before = moment.before if self.attention.before or self.attention.after else ()
        after = moment.after if self.attention.before or self.attention.after else ()
        seen = [[f for f in frames if f.key.camera in names] for frames in (before, after)]
        return seen[0], moment.now, seen[1]

    def _reference_of(self, moment: Moment) -> dict[str, str]:
        """For each camera the one whose picture of the same time it sees; itself if none."""
        cameras = [frame.key.camera for frame in moment.now]
        if not self.attention.view:
            return dict(zip(cameras, cameras, strict=True))
        ahead = None if moment.look is None else moment.look(moment.now[0])[1].axes_world[0]
        references = view_references([frame.camera for frame in moment.now], ahead)
        return {camera: cameras[at] for camera, at in zip(cameras, references, strict=True)}

    def _noises(
        self,
        latents: Sequence[torch.Tensor],
        prompt: torch.Tensor,
        window: Sequence[Sequence[Frame]],
        reference_of: Mapping[str, str],
    ) -> Sequence[torch.Tensor]:
        """Predictions for the (1, 4, h, w) latents of all frames of a window."""
        if not (self.attention.view or self.attention.before or self.attention.after):
            # One at a time: pictures that do not see each other need no common memory.
            with temporal_view(self.model.unet, Links((0,), (0,), (0,)), self.attention):
                return [self.model.noise(latent, prompt) for latent in latents]
        links = window_links([[f.key.camera for f in frames] for frames in window], reference_of)
        batch = _stacked(latents, [frame for frames in window for frame in frames])
        with temporal_view(self.model.unet, links, self.attention):
            return self.model.noise(batch, prompt).split(1)

    def _latent(self, frame: Frame) -> torch.Tensor:
        """Kept for a while: it is asked for again in every style and at the next time."""
        key = _digest_of(frame)
        if key not in self._latents:
            self._latents[key] = self._encoded(frame).latent
        self._latents.move_to_end(key)
        while len(self._latents) > LATENTS_KEPT:
            self._latents.popitem(last=False)
        return self._latents[key]

    def _encoded(self, frame: Frame) -> Encoded:
        height, width = self._size(frame)
        interpolation = cv2.INTER_AREA if height < frame.image.shape[0] else cv2.INTER_CUBIC
        image = cv2.resize(frame.image, (width, height), interpolation=interpolation)
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].to(self.model.device)
        pixels = self._padded(pixels.to(self.model.dtype) / 127.5 - 1)
        label = None
        if frame.label is not None and "labels" not in self.options.without:
            # As in training: another rounding would shift it against the picture.
            ids = resized_label(frame.label, width, height)
            label = torch.tensor(ids, device=self.model.device).long()[None]
            bottom, right = pixels.shape[2] - height, pixels.shape[3] - width
            label = functional.pad(label, (0, right, 0, bottom), value=IGNORE)
        return self.model.encode(pixels, label)

    def _padded(self, pixels: torch.Tensor) -> torch.Tensor:
        """Up to multiples of the VAE's factor by the border's own pixels; nothing is squeezed."""
        factor = self.model.base.factor
        bottom, right = -pixels.shape[2] % factor, -pixels.shape[3] % factor
        return functional.pad(pixels, (0, right, 0, bottom), mode="replicate")

    def _size(self, frame: Frame) -> tuple[int, int]:
        """(height, width) at which a frame is edited."""
        height, width = frame.image.shape[:2]
        rows = self.options.height
        return (height, width) if rows is None else (rows, max(1, round(width * rows / height)))

    def _picture(self, out: torch.Tensor, frame: Frame) -> UInt8:
        height, width = self._size(frame)
        pixels = (out[0, :, :height, :width].float().clamp(-1, 1) + 1) * 127.5
        if not torch.isfinite(pixels).all():
            raise DataError(
                f"frame {frame.key}: the editor's picture holds NaN; use the base in float32"
            )
        image = pixels.round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
        if image.shape != frame.image.shape:
            size = frame.image.shape[1::-1]
            image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
        return np.ascontiguousarray(image)


class SingleStyleEditors:
    """One adapter for each style, each with all of its parts: the baseline of the all-in-one.

    Args:
        editors: By style.
    """

    name = "diffusion"

    def __init__(self, editors: Mapping[str, DiffusionEditor]) -> None:
        self.editors = dict(editors)
        for style, editor in self.editors.items():
            if style not in editor.styles:
                raise DataError(f"the adapter in the folder {style} does not know that style")

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is an adapter for."""
        return tuple(self.editors)

    @property
    def card(self) -> Mapping[str, Any]:
        """The card of each adapter."""
        return {"editor": self.name, "single": {k: dict(e.card) for k, e in self.editors.items()}}

    def trained_on(self, style: str) -> TrainedOn | None:
        """What the adapter of a style was trained on."""
        return self.editors[style].trained_on(style)

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `DiffusionEditor.edit`."""
        if style not in self.editors:
            raise ArgumentError(
                f"style {printable(style)!r} is not one of {', '.join(self.styles)}"
            )
        return self.editors[style].edit(moment, style)


def effective_weights(options: DiffusionOptions) -> AttentionWeights:
    """Attention with what is left out given to the picture itself, as far as the sum is below 1."""
    given = options.attention
    view = 0.0 if "view" in options.without else given.view
    before = 0.0 if "temporal" in options.without else given.before
    after = 0.0 if "temporal" in options.without else given.after
    itself = given.itself
    if (view, before, after) != (given.view, given.before, given.after):
        itself = max(itself, 1 - view - before - after)
    return AttentionWeights(itself, view, before, after)


def _digest_of(frame: Frame) -> bytes:
    digest = hashlib.blake2b(repr(frame.image.shape).encode(), digest_size=16)
    for array in (frame.image, frame.label):
        if array is not None:
            digest.update(array.tobytes())
    return digest.digest()


def _stacked(latents: Sequence[torch.Tensor], frames: Sequence[Frame]) -> torch.Tensor:
    if len({latent.shape for latent in latents}) > 1:
        sizes = sorted({f"{f.camera.width}x{f.camera.height} ({f.key.camera})" for f in frames})
        raise DataError(
            f"pictures of {', '.join(sizes)} cannot look at each other; give height=N (--edit-"
            "height) if their aspect is the same, or attention weights for the picture alone"
        )
    return torch.cat(list(latents))
