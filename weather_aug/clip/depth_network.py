"""Depth from a network of transformers: metres as they are, relative depth set on the ground.

Convention:
    A relative network gives inverse depth up to a scale and a shift. Both follow from the ground,
    whose depth the camera's height and horizon tell: a robust line through the pixels that the
    label, or without one the picture, shows as ground. Where too little ground is seen, or
    the line would turn near into far, median and quartiles of inverse depth are made those of the
    geometric prior. Sky is at `inf`. Nothing is downloaded, and nothing is unpickled.

Source: scale and shift of inverse depth are those of Ranftl et al. 2022, "Towards Robust Monocular
Depth Estimation"; the line of median slope is that of Theil 1950 and Sen 1968.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8, like_image
from weather_aug._extras import require
from weather_aug.clip.alone import Surfaces, surfaces_of
from weather_aug.clip.horizon import pitch_from_picture
from weather_aug.clip.prior import MAX_DEPTH_M, MIN_DEPTH_M, geometric_prior_depth
from weather_aug.clip.sky import sky_mask
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError, DataError, MissingExtraError, printable
from weather_aug.taxonomy import GROUND, IGNORE, SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

KINDS = ("auto", "metric", "relative")
LEAST_SIDE_PX, MOST_ASPECT = 8, 16
LEAST_GROUND_PIXELS = 100
GROUPS = 48
ROUNDS = 10
TUKEY = 4.685
SKY_BEYOND_M, SKY_SHARE = 30.0, 0.5
MOST_FIT_PIXELS = 20_000

_TO = "estimate depth with a network"
_KIND_BY_TYPE = {"dpt": "relative", "glpn": "metric", "zoedepth": "metric"}
# The first fusion layer adds nothing to what comes in, and published DPT models lack its weights.
_UNUSED = re.compile(r"fusion_stage\.layers\.0\.residual_layer1\.")
_ZOE_PAD = 3


@dataclass(frozen=True)
class DepthNetwork:
    """A network that estimates depth; pickles as its name, and is read once in a process.

    Raises:
        ArgumentError: If `kind` is none of the three.
    """

    model: str
    """A folder with a `depth-estimation` model of transformers (Depth Anything, DPT, GLPN or
    ZoeDepth), or the id of one in the local cache of huggingface_hub."""
    device: str = "cpu"
    kind: str = "auto"
    """"metric" (metres), "relative" (inverse depth up to scale and shift), or "auto" by the
    model's config."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ArgumentError(f"kind must be {', '.join(KINDS)}, got {printable(self.kind)!r}")

    def depth_m(
        self, image: UInt8, label: UInt8 | None, camera: Camera, camera_height_m: float
    ) -> Float32:
        """(H, W) float32 z-depth in metres in [0.5, 200], `inf` in the sky.

        Args:
            image: (H, W, 3) uint8 RGB.
            label: (H, W) uint8 train ids, 255 ignored; None where nobody labelled.
            camera: Of the picture's size.
            camera_height_m: Height of the camera over the ground, metres.

        Raises:
            ArgumentError: If the picture is too small or narrow, or the device is not there.
            DataError: If the model is not on this machine or cannot be used, or sees nothing.
            MissingExtraError: If transformers are not installed.
        """
        image = image_uint8("image", image)
        short, long = sorted(image.shape[:2])
        if short < LEAST_SIDE_PX or long > MOST_ASPECT * short:
            raise ArgumentError(
                f"a picture of {image.shape[1]}x{image.shape[0]} is too small or narrow for a "
                "depth network; leave depth_network out"
            )
        loaded = _loaded(self.model, self.device)
        found = _predicted(loaded, image)
        if not np.isfinite(found).all():
            raise DataError(f"{printable(self.model, 200)} gives NaN or infinity as depth")
        known = label if label is not None and (label != IGNORE).any() else None
        kind = loaded.kind if self.kind == "auto" else self.kind
        if kind == "relative":
            focal_px, principal_px = camera.focal_px[1], camera.principal_px
            if known is None:
                shown = surfaces_of(image, focal_px=focal_px, principal_px=principal_px)
            else:
                pitch_rad = pitch_from_picture(image, focal_px=focal_px, principal_px=principal_px)
                shown = Surfaces(known, pitch_rad)
            found = metres_from_relative(found, shown, camera, camera_height_m)
        depth = np.clip(found, MIN_DEPTH_M, MAX_DEPTH_M).astype(np.float32)
        depth[_far_sky(image, depth) if known is None else known == SKY] = np.inf
        return depth


def _far_sky(image: UInt8, depth_m: Float32) -> NDArray[np.bool_]:
    """What looks like sky to a heuristic and far to the network: bright facades are near."""
    sky = sky_mask(image)
    if sky.any():
        least_m = SKY_SHARE * float(np.percentile(depth_m[sky], 75))
        sky &= depth_m > min(SKY_BEYOND_M, least_m)
    return sky


def metres_from_relative(
    relative: Float32, surfaces: Surfaces, camera: Camera, camera_height_m: float
) -> Float32:
    """Relative inverse depth as z-depth in metres; see the module's Convention.

    Args:
        relative: (H, W) inverse depth up to scale and shift, finite, greater is nearer.
        surfaces: What the picture shows, and the camera's pitch.
        camera: Of the picture's size.
        camera_height_m: Height of the camera over the ground, metres.

    Returns:
        (H, W) float32 metres, at most 200.

    Raises:
        DataError: If `relative` is the same everywhere outside the sky.
    """
    like_image("relative", relative, surfaces.label.shape)
    prior = geometric_prior_depth(
        surfaces.label,
        focal_px=camera.focal_px[1],
        principal_px=camera.principal_px,
        camera_height_m=camera_height_m,
        pitch_rad=surfaces.pitch_rad,
    )
    inverse = (1 / prior).astype(np.float64)
    # At the cap the plane's depth is no longer the plane's.
    ground = np.isin(surfaces.label, GROUND) & (prior < MAX_DEPTH_M) & (prior > MIN_DEPTH_M)
    line = None
    if np.count_nonzero(ground) >= LEAST_GROUND_PIXELS:
        line = _robust_line(*_thinned(relative[ground], inverse[ground]))
    if line is None:
        surface = surfaces.label != SKY
        line = _same_spread(relative[surface], inverse[surface])
    scale, shift = line
    fitted = scale * relative.astype(np.float64) + shift
    return (1 / np.maximum(fitted, 1 / MAX_DEPTH_M)).astype(np.float32)


def _thinned(*values: NDArray[Any]) -> tuple[Float64, ...]:
    step = -(-len(values[0]) // MOST_FIT_PIXELS)
    return tuple(value[::step].astype(np.float64) for value in values)


def _robust_line(relative: Float64, inverse: Float64) -> tuple[float, float] | None:
    """Scale and shift from relative to inverse depth; None unless near stays near.

    Relative depth is what errs, so it is fitted over inverse depth: a Theil-Sen line through the
    medians of groups, since an own bonnet lies where leverage is greatest; then Tukey's biweight.
    """
    slope, level = _median_line(relative, inverse)
    for _ in range(ROUNDS):
        off = np.abs(relative - level - slope * inverse)
        weight = np.maximum(0.0, 1 - (off / (TUKEY * 1.4826 * np.median(off) + 1e-30)) ** 2) ** 2
        total = weight.sum()
        x, y = (weight @ inverse) / total, (weight @ relative) / total
        spread = weight @ (inverse - x) ** 2
        if not spread > 1e-9 * total * x**2:
            return None
        slope = (weight @ ((inverse - x) * (relative - y))) / spread
        level = y - slope * x
    # Of what does not change with depth nothing can be said.
    if not slope * np.ptp(inverse) > 1e-6 * np.abs(relative).max():
        return None
    return float(1 / slope), float(-level / slope)


def _median_line(relative: Float64, inverse: Float64) -> tuple[float, float]:
    order = np.argsort(inverse, kind="stable")
    groups = np.array_split(order, min(GROUPS, len(order)))
    x = np.array([np.median(inverse[group]) for group in groups])
    y = np.array([np.median(relative[group]) for group in groups])
    first, second = np.triu_indices(len(groups), 1)
    apart = x[second] > x[first]
    if not apart.any():
        return 0.0, float(np.median(y))
    slope = float(np.median(((y[second] - y[first])[apart]) / (x[second] - x[first])[apart]))
    return slope, float(np.median(y - slope * x))


def _same_spread(x: NDArray[Any], y: Float64) -> tuple[float, float]:
    if x.size:
        (low, middle, high), (below, centre, above) = (
            np.percentile(values, (25, 50, 75)) for values in (x, y)
        )
        if high > low:
            scale = (above - below) / (high - low)
            return float(scale), float(centre - scale * middle)
    raise DataError(
        "the network gives the same depth everywhere; look at the picture, or leave it out"
    )


class _Loaded(NamedTuple):
    processor: Any
    network: Any
    kind: str


def _predicted(loaded: _Loaded, image: UInt8) -> Float32:
    """What the network says, (H, W), in its own unit."""
    import torch

    height, width = image.shape[:2]
    inputs = loaded.processor(images=image, return_tensors="pt", input_data_format="channels_last")
    pixels = inputs["pixel_values"].to(loaded.network.device)
    with torch.inference_mode():
        found = loaded.network(pixel_values=pixels).predicted_depth[0]
    values = found.reshape(found.shape[-2:]).float().cpu().numpy()
    pad_y = pad_x = 0
    if loaded.network.config.model_type == "zoedepth" and loaded.processor.do_pad:
        pad_y, pad_x = (int(np.sqrt(side / 2) * _ZOE_PAD) for side in (height, width))
    whole = cv2.resize(values, (width + 2 * pad_x, height + 2 * pad_y))
    return np.asarray(whole[pad_y : pad_y + height, pad_x : pad_x + width], np.float32)


@functools.cache
def _loaded(model: str, device: str) -> _Loaded:
    """Read a network and its preprocessing, once in a process."""
    import torch

    transformers = require("transformers", extra="depth", to=_TO)
    try:
        where = torch.device(device)
        torch.empty(0, device=where)
    except (RuntimeError, AssertionError) as error:
        cause = str(error).partition("\n")[0]
        raise ArgumentError(f"device {printable(device)!r}: {printable(cause, 200)}") from None
    folder = _folder_of(model)
    with _readable(folder), _quiet(), torch.random.fork_rng(devices=[]):
        config = transformers.AutoConfig.from_pretrained(folder, local_files_only=True)
        kind = _kind_of(config, folder)
        # Its other backend needs torchvision.
        processor = transformers.AutoImageProcessor.from_pretrained(
            folder, local_files_only=True, backend="pil"
        )
        network, told = transformers.AutoModelForDepthEstimation.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    missing = sorted(key for key in told["missing_keys"] if not _UNUSED.search(key))
    if missing:
        raise DataError(
            f"{printable(folder, 200)}: {len(missing)} of the weights are missing, such as "
            f"{printable(missing[0], 100)}; fetch the model again"
        )
    return _Loaded(processor, network.eval().to(where), kind)


def _kind_of(config: Any, folder: Path) -> str:
    if config.model_type == "depth_anything":
        return str(config.depth_estimation_type)
    if config.model_type not in _KIND_BY_TYPE:
        raise DataError(
            f"{printable(folder, 200)} is a {printable(config.model_type)}; of depth networks, "
            f"depth_anything, {', '.join(_KIND_BY_TYPE)} can be named; wrap another in a function "
            "from picture to metres and give that"
        )
    return _KIND_BY_TYPE[config.model_type]


def _folder_of(model: str) -> Path:
    """A folder, or the local cache's snapshot of a model id."""
    if Path(model).is_dir():
        return Path(model)
    hub = require("huggingface_hub", extra="depth", to=_TO)
    errors = require("huggingface_hub.errors", extra="depth", to=_TO)
    try:
        return Path(hub.snapshot_download(model, local_files_only=True))
    except (errors.LocalEntryNotFoundError, errors.HFValidationError):
        shown = printable(model)
        raise DataError(
            f"depth_network {shown!r} is no folder, and no model of that name is on this machine; "
            f"fetch one with `hf download {shown} --local-dir depth_model` and give that folder"
        ) from None


@contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """What the library raises on files that are not its own, as one typed sentence."""
    try:
        yield
    except (DataError, MissingExtraError):
        raise
    except Exception as error:
        raise DataError(
            f"{printable(folder, 200)} is no depth network that can be read: "
            f"{type(error).__name__} {printable(error, 300)}"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Without bars and notices of transformers; its settings come back after."""
    logging = require("transformers.utils.logging", extra="depth", to=_TO)
    level = logging.get_verbosity()
    hook = logging.set_tqdm_hook(lambda _, args, kwargs: logging.EmptyTqdm(*args, **kwargs))
    try:
        logging.set_verbosity_error()
        yield
    finally:
        logging.set_tqdm_hook(hook)
        logging.set_verbosity(level)
