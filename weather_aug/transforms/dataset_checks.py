"""What a WeatherDataset refuses before anything is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

from weather_aug._keys import check_seed
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.viewpoint import ViewpointJitter
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.items import Output
from weather_aug.transforms.sampling import Sampling
from weather_aug.transforms.sources import Known, SceneSource, Source

MOST_ITEMS = 2**31
KnownFrames = Sequence[tuple[Source, Known]]


def checked_policy(policy: Any) -> WeatherPolicy:
    """A policy; the default one of None."""
    if policy is None:
        return WeatherPolicy()
    if not isinstance(policy, WeatherPolicy):
        raise ArgumentError(
            f"policy must be a WeatherPolicy, got {type(policy).__name__}; write "
            'WeatherPolicy(types={"rain": 1, …}), or WeatherPolicy.from_dict(…) of a to_dict form'
        )
    return policy


def checked_length(length: Any) -> int:
    """A number of items."""
    number = check_seed("length", length)
    if not 0 < number <= MOST_ITEMS:
        raise ArgumentError(f"length must be in 1..{MOST_ITEMS} items, got {number}")
    return number


def all_labelled(known: KnownFrames) -> bool:
    """Whether all frames have labels; False if none has.

    Raises:
        ArgumentError: Of a mixture: its items differ in their keys, and no batch could hold two.
    """
    without = [(source, frame.key) for source, frame in known if not frame.has_label]
    if without and len(without) < len(known):
        raise mixed(*without[0], has_label=False)
    return not without


def mixed(source: Source, key: FrameKey, *, has_label: bool) -> ArgumentError:
    """The error for a frame that has a label where others have none, or has none."""
    own, others = ("a", "no") if has_label else ("no", "a")
    return ArgumentError(
        f"frame {key} of {source} has {own} label, but other frames have {others} label: make one "
        "WeatherDataset of labelled frames and another of those without labels"
    )


def check_crop(crop: Any, known: KnownFrames) -> None:
    """Refuse what is no (height, width) that fits into all frames."""
    if crop is None:
        return
    pair = isinstance(crop, tuple | list) and len(crop) == 2
    if not pair or not all(isinstance(side, int) for side in crop):
        raise ArgumentError(f"crop must be (height, width) in pixels, got {crop!r}")
    for source, frame in known:
        check_fits(tuple(crop), source, frame.key, frame.size)


def check_fits(crop: tuple[int, ...], source: Source, key: FrameKey, size: tuple[int, int]) -> None:
    """Refuse a crop that is larger than a frame."""
    if not (0 < crop[0] <= size[0] and 0 < crop[1] <= size[1]):
        raise ArgumentError(
            f"crop {tuple(crop)} does not fit frame {key} of {source} ({size[0]}x{size[1]} pixels)"
        )


def check_viewpoints(jitter: Any, sources: Sequence[Source]) -> None:
    """Refuse viewpoints that are none, or that a source cannot show."""
    if jitter is None:
        return
    if not isinstance(jitter, ViewpointJitter):
        raise ArgumentError(
            "viewpoint_jitter must be a ViewpointJitter, got "
            f"{type(jitter).__name__}; write ViewpointJitter(lateral_m=1.0)"
        )
    for source in sources:
        if not isinstance(source, SceneSource):
            raise ArgumentError(
                f"{source} can be seen from its cameras only; build a scene of it with "
                "reconstruct=True, or leave viewpoint_jitter out"
            )
        if source.given.manifest.reconstruction is None:
            raise ArgumentError(
                f"{source} has no Gaussians to be seen from elsewhere; build it "
                "again with reconstruct=True, or leave viewpoint_jitter out"
            )


def check_strategies(sampling: Any, curriculum: Any, *, is_labelled: bool) -> None:
    """Refuse what is no sampling or curriculum, and one that needs labels where there are none."""
    if not isinstance(sampling, Sampling):
        raise ArgumentError(
            f"sampling must be Uniform() or RareClass(), got {type(sampling).__name__}"
        )
    if sampling.reads_labels and not is_labelled:
        raise ArgumentError("sampling counts classes, but the frames have no labels: use Uniform()")
    if curriculum is not None and not isinstance(curriculum, SeverityCurriculum):
        raise ArgumentError(
            f"curriculum must be a SeverityCurriculum, got {type(curriculum).__name__}"
        )


def check_output(output: Any, *, is_labelled: bool, has_transform: bool) -> None:
    """Refuse what is no form of an item, and tuples where there is no label or a transform."""
    if output not in get_args(Output):
        raise ArgumentError(f"output must be one of {', '.join(get_args(Output))}, got {output!r}")
    if output == "tuple" and has_transform:
        raise ArgumentError("output='tuple' and transform exclude each other: return the tuple")
    if output == "tuple" and not is_labelled:
        raise ArgumentError("output='tuple' is (image, label), but the frames have no labels")
