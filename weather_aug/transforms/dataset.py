"""WeatherDataset: a torch Dataset that draws the weather of each sample on the fly."""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset, get_worker_info

from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.clip.depth_sources import DepthSource
from weather_aug.clip.types import Clip, FrameKey, Window
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame, warm_up
from weather_aug.render.label_weight import loss_weight_of
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint, ViewpointJitter
from weather_aug.taxonomy import SKY
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.dataset_checks import (
    all_labelled,
    check_crop,
    check_fits,
    check_output,
    check_strategies,
    check_viewpoints,
    checked_length,
    checked_policy,
    mixed,
)
from weather_aug.transforms.draws import SharedEpoch
from weather_aug.transforms.items import (
    Asked,
    Output,
    Sample,
    clear_of,
    recipe_of,
    rendered,
    rendered_again,
    sample_of,
    tensors_of,
    tuple_of,
)
from weather_aug.transforms.permutation import dealt
from weather_aug.transforms.resume import STATE_VERSION, checked_state, fingerprint_of
from weather_aug.transforms.sampling import Choice, Sampling, Uniform
from weather_aug.transforms.sources import Opened, Source, sources_of


class WeatherDataset(Dataset[Any]):
    """Frames of scenes and clips, each in a weather drawn for (seed, epoch, item).

    Convention:
        Item i of epoch e is the same bytes in any process, on any number of workers, in any order,
        and another weather in another epoch. Call `set_epoch` between epochs; it reaches persistent
        workers too. Without `transform` an item is a dict of tensors: `image` (3, H, W) uint8 RGB,
        `label` (H, W) int64 train ids with 255 where the surface cannot be seen, `label_full`
        (H, W) int64 train ids of the clear frame, `invalid` (H, W) uint8, 1 where the surface
        cannot be made out (see `RenderedFrame`), `transmittance` in [0, 1] and `depth` in metres
        (H, W) float32, and `recipe`, a JSON text from which `render_recipe` renders the item again.
        Frames without labels give items without `label` and `label_full`; all frames have labels,
        or none. `loss_weight(item)` gives weights for a loss, of a batch as well. With
        `viewpoint_jitter` image, label and depth are drawn from the scenes' Gaussians, each item
        from beside its recorded camera, and what was never recorded is 255 in both labels, and
        invalid; the weathers drawn are the same as without.

        It pickles to a worker as the paths of its scenes; a clip pickles as its own list of paths.
        A clip's frames are looked at when they are drawn: only its first is checked before.

    Args:
        scenes: One or more scenes, or clips for which nothing was precomputed: `open_clip(address)`
            of, for example, a folder of pictures and one of labels.
        policy: Which weather how often; the default `WeatherPolicy()` if None.
        seed: Of all draws.
        transform: Called with the sample as numpy arrays (`image` (H, W, 3), `label` and
            `label_full` (H, W) uint8, …); what it returns is the item.
        crop: (height, width) of a random part to render; only that part is rendered.
        options: Budget of the renderer.
        viewpoint_jitter: How far beside the recorded cameras pictures are taken; None takes the
            recorded pictures.
        sampling: Which frame an item shows: `Uniform()` or `RareClass()`, which counts the pixels
            of all labels once, when the data set is made.
        length: Items of an epoch; as many as there are frames if None.
        balanced_weathers: Deal the policy's types out evenly: their numbers in an epoch differ from
            their exact shares by less than one.
        curriculum: Ranges of severity by epoch, in place of the policy's.
        output: "dict", or "tuple" for (image, label) tensors.
        with_clear: Add the same picture without weather, `clear` (3, H, W) uint8, for training on
            pairs; of a tuple the third.
        depth: Where depth comes from for clips whose frames have none. Folders with labels have it
            from the labels, unless there is a folder of depth.

    Raises:
        ArgumentError: If there are no scenes, some of their frames have labels and some have none,
            an argument is none of its kind, a frame is smaller than the crop, labels are needed and
            there are none, or viewpoints are asked for and a source has no Gaussians.
    """

    def __init__(
        self,
        scenes: Sequence[WeatherScene | Clip],
        policy: WeatherPolicy | None = None,
        *,
        seed: int = 0,
        transform: Callable[[Sample], Any] | None = None,
        crop: tuple[int, int] | None = None,
        options: RenderOptions = DEFAULT_OPTIONS,
        viewpoint_jitter: ViewpointJitter | None = None,
        sampling: Sampling | None = None,
        length: int | None = None,
        balanced_weathers: bool = False,
        curriculum: SeverityCurriculum | None = None,
        output: Output = "dict",
        with_clear: bool = False,
        depth: DepthSource | None = None,
    ) -> None:
        self._sources = sources_of(scenes, depth or DepthSource())
        self.policy = checked_policy(policy)
        self.seed = check_seed("seed", seed)
        self.transform = transform
        self.crop = crop
        self.options = options
        self.viewpoint_jitter = viewpoint_jitter
        self.sampling = Uniform() if sampling is None else sampling
        self.balanced_weathers = bool(balanced_weathers)
        self.curriculum = curriculum
        self.output = output
        self.with_clear = bool(with_clear)
        known = [(source, frame) for source in self._sources for frame in source.known()]
        self._is_labelled = all_labelled(known)
        check_crop(crop, known)
        check_viewpoints(viewpoint_jitter, self._sources)
        check_strategies(self.sampling, curriculum, is_labelled=self._is_labelled)
        check_output(output, is_labelled=self._is_labelled, has_transform=transform is not None)
        self._ends = np.cumsum([len(source.keys) for source in self._sources])
        frames = int(self._ends[-1])
        self._length = frames if length is None else checked_length(length)
        self._picks = self.sampling.picks(frames, self._length, self._labels())
        self._epoch = SharedEpoch()
        if get_worker_info() is None:
            warm_up()
            if viewpoint_jitter is not None:
                # Recorded frames alone do without what draws Gaussians.
                from weather_aug.scene.novel import warm_up as warm_up_views

                warm_up_views()

    def __len__(self) -> int:
        return self._length

    @property
    def scenes(self) -> tuple[WeatherScene | Clip, ...]:
        """The scenes and clips, in the order given."""
        return tuple(source.given for source in self._sources)

    @property
    def epoch(self) -> int:
        """The epoch whose weather is drawn."""
        return self._epoch.value

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers.

        Raises:
            ArgumentError: If `epoch` is not an integer in [0, 2**63).
        """
        self._epoch.value = epoch

    def policy_at(self, epoch: int) -> WeatherPolicy:
        """The policy of an epoch: the curriculum's, where there is one."""
        if self.curriculum is None:
            return self.policy
        return self.curriculum.policy_at(self.policy, epoch)

    def drawn(self, index: int) -> WeatherDraw:
        """The weather of an item of this epoch, without rendering it."""
        return self._drawn(self.epoch, self._checked(index))

    def __getitem__(self, index: int) -> Any:
        item = self._checked(index)
        # Read once: a worker may be told of the next epoch at any moment.
        epoch = self.epoch
        choice = self._picks.pick(self.seed, epoch, item)
        source, key = self._locate(choice.frame)
        opened = source.open(key)
        draw = self._drawn(epoch, item)
        if self.crop is not None:
            # Not all frames of a clip were looked at before.
            check_fits(self.crop, source, key, opened.size)
        window = self._window(opened, choice, epoch, item)
        asked = Asked(window, self._viewpoint(epoch, item), self.options)
        shot = rendered(opened, draw.weather, draw.seed, asked)
        if (shot.label is not None) != self._is_labelled:
            raise mixed(source, key, has_label=shot.label is not None)
        sample = sample_of(shot, recipe_of(source.recipe_head(), key, draw, asked))
        if self.with_clear:
            sample["clear"] = clear_of(opened, shot, asked)
        if self.transform is not None:
            return self.transform(sample)
        tensors = tensors_of(sample)
        return tensors if self.output == "dict" else tuple_of(tensors)

    def render_recipe(self, recipe: str | Mapping[str, Any]) -> RenderedFrame:
        """Render an item again.

        Args:
            recipe: Of an item of this data set, or of another one of the same scenes and clips.

        Raises:
            ArgumentError: If its scene or clip is not among them.
        """
        fields = json.loads(recipe) if isinstance(recipe, str) else recipe
        for source in self._sources:
            head = source.recipe_head()
            if head == {name: fields.get(name) for name in head}:
                key = FrameKey(fields["time_index"], fields["camera"])
                return rendered_again(source.open(key), fields)
        name = fields.get("scene", fields.get("clip"))
        raise ArgumentError(f"recipe is of {printable(name)!r}, which is not among the scenes")

    def fingerprint(self) -> dict[str, str]:
        """16 hexadecimal digits for each choice that decides what the items of an epoch are.

        Transforms cannot be told, and clips by the names of their frames only.
        """
        jitter = self.viewpoint_jitter
        choices = {
            "scenes": [source.digest() for source in self._sources],
            "policy": self.policy.to_dict(),
            "seed": self.seed,
            "crop": self.crop,
            "options": self.options.to_dict(),
            "viewpoint_jitter": None if jitter is None else jitter.to_dict(),
            "sampling": self.sampling.to_dict(),
            "length": self._length,
            "balanced_weathers": self.balanced_weathers,
            "curriculum": None if self.curriculum is None else self.curriculum.to_dict(),
        }
        return fingerprint_of(choices)

    def state_dict(self) -> dict[str, Any]:
        """The epoch, and what it is an epoch of, as JSON values."""
        return {"version": STATE_VERSION, "epoch": self.epoch, "fingerprint": self.fingerprint()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the epoch of a state.

        Raises:
            ArgumentError: If it is no state of `state_dict`.
            ConflictError: If it is of a data set that would give other items; the first choice that
                differs is named.
        """
        self.set_epoch(checked_state(state, "data set", self.fingerprint())["epoch"])

    def _drawn(self, epoch: int, item: int) -> WeatherDraw:
        which = dealt(self.seed, epoch, item, len(self)) if self.balanced_weathers else None
        return self.policy_at(epoch).draw(self.seed, epoch, item, which=which)

    def _checked(self, index: int) -> int:
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"index {number} is outside a dataset of {len(self)} items")
        return number % len(self)

    def _labels(self) -> Iterator[NDArray[np.uint8]]:
        for source in self._sources:
            for key in source.keys:
                label = source.label(key)
                if label is None:
                    raise mixed(source, key, has_label=False)
                yield label

    def _locate(self, frame: int) -> tuple[Source, FrameKey]:
        which = int(np.searchsorted(self._ends, frame, side="right"))
        source = self._sources[which]
        first = int(self._ends[which]) - len(source.keys)
        return source, source.keys[frame - first]

    def _window(self, opened: Opened, choice: Choice, epoch: int, item: int) -> Window | None:
        """The first crop that shows enough of what the frame was chosen for, or the last tried."""
        if self.crop is None:
            return None
        for tried in range(choice.tries + 1):
            again = (tried,) if tried else ()
            window = _placed(self.crop, opened.size, key_of("crop", self.seed, epoch, item, *again))
            if choice.train_id is None or _count_of(choice.train_id, opened, window) > choice.more:
                break
        return window

    def _viewpoint(self, epoch: int, item: int) -> Viewpoint | None:
        if self.viewpoint_jitter is None:
            return None
        return self.viewpoint_jitter.draw(key_of("viewpoint", self.seed, epoch, item))


def _placed(crop: tuple[int, int], size: tuple[int, int], key: int) -> Window:
    (rows, columns), (height, width) = crop, size
    down, right = uniforms(key, 2)
    return (int(down * (height - rows + 1)), int(right * (width - columns + 1)), rows, columns)


def _count_of(train_id: int, opened: Opened, window: Window) -> int:
    """Pixels of a class in a window of the clear label."""
    assert opened.label is not None
    top, left, rows, columns = window
    return int(np.count_nonzero(opened.label[top : top + rows, left : left + columns] == train_id))


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
