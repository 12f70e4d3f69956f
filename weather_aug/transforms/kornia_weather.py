"""RandomWeather for kornia: batches of tensors in weather, on their device, with gradients."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug._checks import finite
from weather_aug._extras import require
from weather_aug._keys import uniforms
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.render.batch import RenderedBatch, render_batch
from weather_aug.render.batch_checks import BATCH_OPTIONS, check_options, one_each
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms.draws import Draws
from weather_aug.transforms.given import rgb_uint8
from weather_aug.transforms.kornia_params import (
    Params,
    camera_of,
    camera_rows,
    check_params,
    drawn_of,
    drawn_rows,
)
from weather_aug.transforms.kornia_tensors import (
    check_pictures,
    marked,
    metres,
    picture,
    planes,
    unit_range,
    whole_ids,
)
from weather_aug.transforms.masks import hidden_in
from weather_aug.transforms.picture import CAMERA, Weathering, default_camera, light_of

# Without it the import below would fail with no word on which extra to install.
require("kornia", extra="kornia", to="use RandomWeather on batches")

import kornia  # noqa: E402
import kornia.augmentation as K  # noqa: E402


def check_version(version: str) -> None:
    """Refuse a kornia that copies parameters on their way to a transform.

    Raises:
        MissingExtraError: If it is older than 0.9.
    """
    if tuple(int(part) for part in version.split(".")[:2]) < (0, 9):
        raise MissingExtraError(
            f"kornia 0.9 is needed to use RandomWeather on batches, and {version} is installed; "
            "install it with: pip install 'weather-aug[kornia]'"
        )


check_version(kornia.__version__)


class RandomWeather(K.IntensityAugmentationBase2D):
    """Rain, snow or fog drawn from a policy, over a batch of pictures and their label masks.

    Convention:
        Pictures are (B, 3, H, W) sRGB in [0, 1], of any floating type, on a CPU or CUDA device;
        the result has their type and device. (3, H, W) is a batch of one. Gradients flow to the
        pictures and nowhere else. Masks are (B, 1, H, W) or (B, H, W) ids, integers or floats that
        hold integers, and come back with `ignore_index` where the surface cannot be seen. Boxes,
        points and classes pass through: weather moves nothing.

        Depth is what the caller gives (z-depth in metres, of the whole picture, so weather comes
        before crops and flips), then what `depth_cache` or `depth_network` hold, then the geometric
        prior of the mask, then the picture alone. In kornia's own AugmentationSequential a
        transform sees the picture before the mask, so that neither depth nor ground comes from the
        mask there: use `AugmentationSequential` of this module, which differs in that alone.

        Each picture of a batch has weather of its own, unless `same_on_batch`. No global generator
        is read or moved, kornia's gate for `p` included: a draw hangs on (seed, epoch, sample key)
        where samples are named, else on (seed, epoch, worker, rank, number of the draw).

        `_params` holds all that a call used, as tensors with one row a picture, so that
        `forward(pictures, params=_params)` repeats it: `batch_prob` (B,), `weather`, `seed`,
        `speed_m_per_s` (see `kornia_params`), and once a picture was seen `depth` (B, 1, H, W)
        float32 metres, `label` (B, 1, H, W) uint8 train ids where a mask was seen, `camera` where
        one was given, `hidden` (B, 1, H, W) bool and `transmittance` (B, 1, H, W) in [0, 1].

    Args:
        policy: Which weather how often, or its `to_dict` form.
        p: Probability that a picture gets what is drawn for it.
        same_on_batch: One weather, one seed and one decision by `p` for all pictures of a batch.
        keepdim: Whether (3, H, W) stays (3, H, W).
        seed: Of all draws, in [-2**63, 2**64).
        how: As of `Weathering.of`; `options` are `BATCH_OPTIONS` if not given.

    Raises:
        MissingExtraError: At import, if kornia is not installed.
        ArgumentError: If an argument is out of range, or the options ask for what a batch does not
            draw; at a call, if an input is not as stated above.
        TypeError: Of kornia's own, at a call, if pictures are integers.
    """

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        *,
        p: float = 0.5,
        same_on_batch: bool = False,
        keepdim: bool = False,
        seed: int = 0,
        **how: Any,
    ) -> None:
        super().__init__(p=finite("p", p, 0, 1), same_on_batch=same_on_batch, keepdim=keepdim)
        options = how.pop("options", None)
        self.weathering = Weathering.of(
            policy, options=BATCH_OPTIONS if options is None else options, **how
        )
        check_options(self.weathering.options)
        self.draws = Draws("kornia", seed)
        self._told = False

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.weathering.policy}, p={self.p}, "
            f"same_on_batch={self.same_on_batch}, keepdim={self.keepdim}, seed={self.draws.seed}, "
            f"epoch={self.draws.epoch})"
        )

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers."""
        self.draws.set_epoch(epoch)

    def forward_parameters(
        self, batch_shape: Sequence[int], sample_keys: Sequence[Any] | None = None
    ) -> Params:
        """Draw weather for a batch.

        Args:
            batch_shape: (B, 3, H, W).
            sample_keys: What the caller calls each sample (an integer, a string or a tuple of
                these), or None. With `same_on_batch` the first counts.

        Raises:
            ArgumentError: If there are not as many keys as pictures.
        """
        count = int(batch_shape[0])
        names = one_each("sample_keys", sample_keys, object, count, optional=True)
        distinct = names[: min(count, 1)] if self.same_on_batch else names
        keys = [self.draws.key(_rank(), name) for name in distinct]
        drawn = [self.weathering.draw(key) for key in keys]
        # The first number of the key is the speed's.
        applied = [float(uniforms(key, 2)[1] < self.p) for key in keys]
        if self.same_on_batch:
            drawn, applied = drawn * count, applied * count
        return {
            "batch_prob": torch.tensor(applied),
            "forward_input_shape": torch.tensor([int(side) for side in batch_shape]),
            **drawn_rows(drawn),
        }

    def forward(
        self,
        input: Tensor,
        params: Params | None = None,
        *,
        mask: Tensor | None = None,
        depth: Tensor | None = None,
        cameras: Sequence[Camera | None] | None = None,
        sample_keys: Sequence[Any] | None = None,
        data_keys: Any = None,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """The pictures in weather; with a mask (pictures, mask).

        Args:
            input: (B, 3, H, W) or (3, H, W) sRGB in [0, 1].
            params: Of an earlier call, or of `forward_parameters`; they are used as they are, and
                what they lack is added to them.
            mask: (B, 1, H, W), (B, H, W) or (H, W) ids; it keeps its shape and type.
            depth: (B, 1, H, W), (B, H, W) or (H, W) z-depth in metres.
            cameras: Of the pictures; level ones where None.
            sample_keys: As of `forward_parameters`.
            data_keys: What kornia's containers pass; nothing hangs on it.

        Raises:
            ArgumentError: As the class says.
            DataError: If the mask holds an id that its taxonomy does not declare.
            TypeError: Of kornia's own, if pictures are integers.
        """
        batch = self.transform_tensor(input)
        check_pictures(batch)
        if params is None:
            params = self.forward_parameters(batch.shape, sample_keys)
        elif sample_keys is not None:
            raise ArgumentError("sample_keys decide what is drawn, and params are drawn: give one")
        check_params(params, len(batch))
        self.look(batch, params, mask=mask, depth=depth, cameras=cameras)
        done = super().forward(input, params)
        if mask is None:
            return done
        return done, self._marked(mask, params["hidden"])

    @torch.no_grad()
    def look(
        self,
        images: Tensor,
        params: Params,
        *,
        mask: Tensor | Sequence[Tensor] | None = None,
        depth: Tensor | None = None,
        cameras: Sequence[Camera | None] | None = None,
    ) -> None:
        """Write into `params` what has to be known of pictures that get weather.

        What the parameters know of depth already stays, unless a depth is given.

        Args:
            images: (B, 3, H, W) sRGB in [0, 1].
            params: Of `forward_parameters`.
            mask: As of `forward`, or one for each picture.
            depth: As of `forward`.
            cameras: As of `forward`.

        Raises:
            ArgumentError: If an input is not as stated in the class.
            DataError: If the mask holds an id that its taxonomy does not declare.
        """
        count, shape = len(images), (images.shape[2], images.shape[3])
        plane = (count, 1, *shape)
        ids = self.weathering.ids
        for name in {"depth", "label"} & set(params):
            if tuple(params[name].shape) != plane:
                raise ArgumentError(
                    f"params are of pictures of size {tuple(params[name].shape[2:])}, got {shape}"
                )
            params[name] = params[name].to(images.device)
        masks = None
        if mask is not None and ids.taxonomy is not None:
            masks = planes("mask", mask, count, shape)
            params["label"] = images.new_full(plane, IGNORE, dtype=torch.uint8)
        depths = None if depth is None else planes("depth", depth, count, shape)
        if cameras is not None:
            given = one_each("cameras", cameras, Camera, count, optional=True)
            for each in given:
                if each is not None and (each.height, each.width) != shape:
                    raise ArgumentError(
                        f"cameras must be of the pictures' size {shape}, got "
                        f"{(each.height, each.width)}: put RandomWeather before crops and resizing"
                    )
            params["camera"] = camera_rows(given)
        if "depth" not in params:
            params["depth"] = images.new_full(plane, torch.nan, dtype=torch.float32)
        for row in self._rows(params):
            label = None if masks is None else whole_ids(masks[row])
            if label is not None:
                train_ids = torch.from_numpy(ids.train_ids(label, shape))
                params["label"][row, 0] = train_ids.to(images.device)
            if depths is None and not bool(params["depth"][row, 0, 0, 0].isnan()):
                continue
            frame = self.weathering.frame(
                picture(unit_range(images[row])),
                drawn_of(params, row),
                mask=label,
                depth=None if depths is None else metres(depths[row]),
                camera=camera_of(params, row, shape),
            )
            found = torch.from_numpy(np.array(frame.depth_m, np.float32)).to(images.device)
            # Unknown is far, and NaN stands for what nobody looked for.
            params["depth"][row, 0] = found.masked_fill(found.isnan(), torch.inf)

    def apply_transform(
        self, input: Tensor, params: Params, flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Render the pictures that get weather; kornia's hook."""
        plane = (len(input), 1, *input.shape[2:])
        params["hidden"] = input.new_zeros(plane, dtype=torch.bool)
        params["transmittance"] = input.new_ones(plane, dtype=torch.float32)
        rows = self._rows(params)
        if not rows:
            return input.clone()
        index = torch.tensor(rows, device=input.device)
        labels = params["label"][index, 0] if "label" in params else None
        shots = self._rendered(unit_range(input[index]), labels, params, rows)
        params["hidden"][index, 0] = hidden_in(
            shots.label, labels, shots.invalid, self.weathering.options.labels
        )
        params["transmittance"][index, 0] = shots.transmittance.detach().float()
        return input.index_copy(0, index, shots.image)

    def apply_transform_mask(
        self, input: Tensor, params: Params, flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Mark what the weather hides; kornia's hook, after the picture's."""
        if "hidden" not in params:
            raise ArgumentError(
                "params know of no picture yet, so nothing is known of what weather hides in the "
                "mask: give the picture along with it, or params of a call that had one"
            )
        unseen = "label" not in params and self.weathering.ids.taxonomy is not None
        if unseen and not self._told and self._rows(params):
            self._told = True
            warnings.warn(
                "RandomWeather saw the mask after the picture, so depth and ground do not come "
                "from the mask: use AugmentationSequential of weather_aug.transforms.kornia "
                "instead of kornia's (taxonomy=None says that masks tell nothing)",
                stacklevel=2,
            )
        return self._marked(input, params["hidden"])

    def _rendered(
        self, images: Tensor, labels: Tensor | None, params: Params, rows: list[int]
    ) -> RenderedBatch:
        shape = (images.shape[2], images.shape[3])
        drawn = [drawn_of(params, row) for row in rows]
        cameras = [
            camera_of(params, row, shape)
            or default_camera(shape, each.speed_m_per_s, self.weathering.hfov_deg)
            for row, each in zip(rows, drawn, strict=True)
        ]
        depth_m = params["depth"][rows]
        lights = []
        for k, camera in enumerate(cameras):
            label = None if labels is None else labels[k].cpu().numpy()
            depth = depth_m[k, 0].cpu().numpy()
            seen = rgb_uint8(picture(images[k]))
            frame = Frame(FrameKey(0, CAMERA), 0.0, camera, seen, label, depth)
            lights.append(light_of(frame))
        return render_batch(
            images,
            depth_m,
            cameras=cameras,
            weathers=[each.weather for each in drawn],
            seeds=[each.seed for each in drawn],
            ambiences=lights,
            times_s=[0.0] * len(drawn),
            labels=labels,
            options=self.weathering.options,
        )

    def _rows(self, params: Params) -> list[int]:
        """Which pictures change: those that the gate lets through, unless their day is clear."""
        # With p = 1 kornia does not ask its gate, neither for pictures nor for masks.
        through = (
            (params["batch_prob"] > 0.5).tolist() if self.p < 1 else [True] * len(params["seed"])
        )
        return [
            row
            for row, applied in enumerate(through)
            if applied and not drawn_of(params, row).weather.is_clear
        ]

    def _marked(self, mask: Tensor, hidden: Tensor) -> Tensor:
        return marked(mask, hidden, self.weathering.ids.ignore_index)


def _rank() -> NDArray[np.int64]:
    """What tells processes apart that train together, in the place of a picture.

    kornia draws parameters before it shows pictures.
    """
    training = torch.distributed.is_available() and torch.distributed.is_initialized()
    return np.full((1, 1, 1), torch.distributed.get_rank() if training else 0)
