"""WeatherDataset: a torch Dataset that draws the weather of each sample on the fly."""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, get_worker_info

from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.clip.types import Window
from weather_aug.errors import ArgumentError
from weather_aug.render.compose import RenderedFrame, warm_up
from weather_aug.render.label_weight import loss_weight_of
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint, ViewpointJitter
from weather_aug.taxonomy import SKY

Sample = dict[str, Any]


class WeatherDataset(Dataset[Any]):
    """Frames of scenes, each in a weather drawn for (seed, epoch, index).

    Convention:
        Item i of epoch e is the same bytes in any process, on any number of workers, in any order,
        and another weather in another epoch. Call `set_epoch` between epochs; it reaches persistent
        workers too. Without `transform` an item is a dict of tensors: `image` (3, H, W) uint8 RGB,
        `label` (H, W) int64 train ids with 255 where the surface cannot be seen, `label_full`
        (H, W) int64 train ids of the clear frame, `invalid` (H, W) uint8, 1 where the surface
        cannot be made out (see `RenderedFrame`), `transmittance` in [0, 1] and `depth` in metres
        (H, W) float32, and `recipe`, a JSON text from which the item can be rendered again. Scenes
        without labels give items without `label` and `label_full`; all frames have labels, or none.
        `loss_weight(item)` gives weights for a loss, of a batch as well. With `viewpoint_jitter`
        image, label and depth are drawn from the scenes' Gaussians, each item from beside its
        recorded camera, and what was never recorded is 255 in both labels, and invalid; the
        weathers drawn are the same as without.

    Args:
        scenes: One or more scenes.
        policy: Which weather how often; the default `WeatherPolicy()` if None.
        seed: Of all draws.
        transform: Called with the sample as numpy arrays (`image` (H, W, 3), `label` and
            `label_full` (H, W) uint8, …); what it returns is the item.
        crop: (height, width) of a random part to render; only that part is rendered.
        options: Budget of the renderer.
        viewpoint_jitter: How far beside the recorded cameras pictures are taken; None takes the
            recorded pictures.

    Raises:
        ArgumentError: If there are no scenes, some of their frames have labels and some have none,
            the policy is none, a frame is smaller than the crop, or viewpoints are asked for and a
            scene has no Gaussians.
    """

    def __init__(
        self,
        scenes: Sequence[WeatherScene],
        policy: WeatherPolicy | None = None,
        *,
        seed: int = 0,
        transform: Callable[[Sample], Any] | None = None,
        crop: tuple[int, int] | None = None,
        options: RenderOptions = DEFAULT_OPTIONS,
        viewpoint_jitter: ViewpointJitter | None = None,
    ) -> None:
        if isinstance(scenes, WeatherScene):
            raise ArgumentError("scenes must be a sequence; write WeatherDataset([scene], ...)")
        self.scenes = tuple(scenes)
        if not self.scenes or not all(isinstance(scene, WeatherScene) for scene in self.scenes):
            raise ArgumentError("scenes must be one or more of WeatherScene.load(folder)")
        self.policy = _checked_policy(policy)
        self.seed = check_seed("seed", seed)
        self.transform = transform
        self.crop = crop
        self.options = options
        self.viewpoint_jitter = viewpoint_jitter
        self._ends = np.cumsum([len(scene.keys) for scene in self.scenes])
        # Shared memory, because persistent workers hold a copy of everything else.
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()
        self._check_labels()
        self._check_crop()
        self._check_viewpoints()
        if get_worker_info() is None:
            warm_up()
            if viewpoint_jitter is not None:
                # Recorded frames alone do without what draws Gaussians.
                from weather_aug.scene.novel import warm_up as warm_up_views

                warm_up_views()

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def epoch(self) -> int:
        """The epoch whose weather is drawn."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers.

        Raises:
            ArgumentError: If `epoch` is not an integer in [0, 2**63).
        """
        number = check_seed("epoch", epoch)
        if not 0 <= number < 2**63:
            raise ArgumentError(f"epoch must be in [0, 2**63), got {number}")
        self._epoch[0] = number

    def __getitem__(self, index: int) -> Any:
        index = self._checked(index)
        scene, key = self._locate(index)
        draw = self.policy.draw(self.seed, self.epoch, index)
        window = self._window(scene, key, index)
        viewpoint = self._viewpoint(index)
        shot = scene.render(
            key,
            draw.weather,
            seed=draw.seed,
            window=window,
            viewpoint=viewpoint,
            options=self.options,
        )
        sample = _sample(shot, _recipe(scene, key, draw, window, viewpoint, self.options))
        return _tensors(sample) if self.transform is None else self.transform(sample)

    def _checked(self, index: int) -> int:
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"index {number} is outside a dataset of {len(self)} frames")
        return number % len(self)

    def _locate(self, index: int) -> tuple[WeatherScene, Any]:
        which = int(np.searchsorted(self._ends, index, side="right"))
        scene = self.scenes[which]
        first = int(self._ends[which]) - len(scene.keys)
        return scene, scene.keys[index - first]

    def _window(self, scene: WeatherScene, key: Any, index: int) -> Window | None:
        if self.crop is None:
            return None
        height, width = scene.size_of(key)
        rows, columns = self.crop
        down, right = uniforms(key_of("crop", self.seed, self.epoch, index), 2)
        top = int(down * (height - rows + 1))
        left = int(right * (width - columns + 1))
        return (top, left, rows, columns)

    def _viewpoint(self, index: int) -> Viewpoint | None:
        if self.viewpoint_jitter is None:
            return None
        return self.viewpoint_jitter.draw(key_of("viewpoint", self.seed, self.epoch, index))

    def _check_viewpoints(self) -> None:
        if self.viewpoint_jitter is None:
            return
        if not isinstance(self.viewpoint_jitter, ViewpointJitter):
            raise ArgumentError(
                "viewpoint_jitter must be a ViewpointJitter, got "
                f"{type(self.viewpoint_jitter).__name__}; write ViewpointJitter(lateral_m=1.0)"
            )
        for scene in self.scenes:
            if scene.manifest.reconstruction is None:
                raise ArgumentError(
                    f"scene {scene.name} has no Gaussians to be seen from elsewhere; build it "
                    "again with reconstruct=True, or leave viewpoint_jitter out"
                )

    def _check_labels(self) -> None:
        """Refuse a mixture: its items differ in their keys, and no batch could hold two of them."""
        frames = [(scene, record) for scene in self.scenes for record in scene.manifest.frames]
        without = [frame for frame in frames if "label" not in frame[1].files]
        if without and len(without) < len(frames):
            scene, record = without[0]
            raise ArgumentError(
                f"frame {record.key} of scene {scene.name} has no label, but other frames have: "
                "make one WeatherDataset of labelled scenes and another of those without labels"
            )

    def _check_crop(self) -> None:
        if self.crop is None:
            return
        pair = isinstance(self.crop, tuple | list) and len(self.crop) == 2
        if not pair or not all(isinstance(side, int) for side in self.crop):
            raise ArgumentError(f"crop must be (height, width) in pixels, got {self.crop!r}")
        for scene in self.scenes:
            for key in scene.keys:
                height, width = scene.size_of(key)
                if not (0 < self.crop[0] <= height and 0 < self.crop[1] <= width):
                    raise ArgumentError(
                        f"crop {self.crop} does not fit frame {key} of scene {scene.name} "
                        f"({height}x{width} pixels)"
                    )


def loss_weight(sample: Mapping[str, Any]) -> Any:
    """How much a loss should count each pixel of a sample, or of a collated batch of them.

    Computed only where it is wanted, from planes that an item has anyway.

    Args:
        sample: With `transmittance`, `invalid`, and `label` and `label_full`, or `depth` where
            nobody labelled; numpy arrays or torch tensors of (..., H, W).

    Returns:
        (..., H, W) float32 in [0, 1], 0 where the weather turned the label into 255; see
        `RenderedFrame.loss_weight`.

    Raises:
        ArgumentError: If a plane is missing.
    """
    labelled = "label" in sample
    planes = ("transmittance", "invalid", *(("label", "label_full") if labelled else ("depth",)))
    for name in planes:
        if name not in sample:
            raise ArgumentError(
                f"sample has no {name!r}; call loss_weight with an item of a WeatherDataset before "
                "a transform drops its planes"
            )
    through, invalid = sample["transmittance"], sample["invalid"]
    if not labelled:
        return loss_weight_of(through, invalid, sample["depth"] == math.inf, None)
    full = sample["label_full"]
    return loss_weight_of(through, invalid, full == SKY, sample["label"] != full)


def _checked_policy(policy: Any) -> WeatherPolicy:
    if policy is None:
        return WeatherPolicy()
    if not isinstance(policy, WeatherPolicy):
        raise ArgumentError(
            f"policy must be a WeatherPolicy, got {type(policy).__name__}; write "
            'WeatherPolicy(types={"rain": 1, …}), or WeatherPolicy.from_dict(…) of a to_dict form'
        )
    return policy


def _sample(shot: RenderedFrame, recipe: str) -> Sample:
    sample: Sample = {
        "image": shot.image,
        "invalid": shot.invalid,
        "transmittance": shot.transmittance,
        "depth": shot.depth,
        "recipe": recipe,
    }
    if shot.label is not None:
        sample |= {"label": shot.label, "label_full": shot.label_full}
    return sample


def _tensors(sample: Sample) -> Sample:
    tensors = {
        name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in sample.items()
    }
    tensors["image"] = tensors["image"].permute(2, 0, 1).contiguous()
    for name in ("label", "label_full"):
        if name in tensors:
            tensors[name] = tensors[name].long()
    return tensors


def _recipe(
    scene: WeatherScene,
    key: Any,
    draw: WeatherDraw,
    window: Window | None,
    viewpoint: Viewpoint | None,
    options: RenderOptions,
) -> str:
    recipe = {
        "scene": scene.name,
        "scene_digest": scene.digest,
        "time_index": key.time_index,
        "camera": key.camera,
        "weather": draw.weather.to_dict(),
        "seed": draw.seed,
        "window": window,
        "options": options.to_dict(),
    }
    if viewpoint is not None:
        recipe["viewpoint"] = viewpoint.to_dict()
    return json.dumps(recipe)
