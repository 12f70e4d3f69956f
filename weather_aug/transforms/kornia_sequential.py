"""kornia's AugmentationSequential, with the mask shown to RandomWeather before the picture."""

from __future__ import annotations

from typing import Any

from weather_aug._extras import require
from weather_aug.transforms.kornia_tensors import check_pictures
from weather_aug.transforms.kornia_weather import RandomWeather

# Without it the imports below would fail with no word on which extra to install.
require("kornia", extra="kornia", to="use RandomWeather on batches")

import kornia.augmentation as K  # noqa: E402
from kornia.augmentation.container.ops import AugmentationSequentialOps  # noqa: E402
from kornia.constants import DataKey  # noqa: E402

DEPTH_KEY = "mask_depth"
"""What depth is called in a dictionary given to `AugmentationSequential`: kornia moves what begins
with "mask" along with the picture, without blending neighbours."""
_BESIDE = ("cameras", "sample_keys")


class AugmentationSequential(K.AugmentationSequential):
    """kornia's AugmentationSequential, which shows RandomWeather the mask before the picture.

    Convention:
        All that is said of kornia's holds. Where there are several masks the first holds the
        classes; all are marked. In a dictionary (`data_keys=None`) three more names mean something
        to RandomWeather: `mask_depth` (B, 1, H, W) float metres, which follows crops and flips and
        is never marked; and, returned as they are, `cameras` and `sample_keys`, one item a picture.
        Cameras follow no crop or flip: put RandomWeather first. Only its direct children see masks,
        not those of a container inside it.

    Raises:
        ArgumentError: As RandomWeather does.
    """

    def __init__(self, *args: Any, **how: Any) -> None:
        super().__init__(*args, **how)
        self.transform_op = _MasksFirst(self.data_keys)

    def forward(self, *args: Any, params: Any = None, data_keys: Any = None) -> Any:
        """The arguments, each augmented; see kornia's."""
        op = self.transform_op
        if len(args) == 1 and isinstance(args[0], dict):
            names, kinds, _, others = self._preproc_dict_data(args[0])
            masks = [n for n, kind in zip(names, kinds, strict=True) if kind == DataKey.MASK]
            op.depth_place = masks.index(DEPTH_KEY) if DEPTH_KEY in masks else None
            op.beside = {n: v for n, v in (others or {}).items() if n in _BESIDE}
        try:
            return super().forward(*args, params=params, data_keys=data_keys)
        finally:
            op.depth_place, op.beside = None, {}

    def forward_parameters(self, batch_shape: Any) -> list[Any]:
        """Parameters for all modules; see kornia's."""
        params: list[Any] = super().forward_parameters(batch_shape)
        names = self.transform_op.beside.get("sample_keys")
        for item in params if names is not None else ():
            module = self.get_submodule(item.name)
            if isinstance(module, RandomWeather):
                shape = item.data["forward_input_shape"].tolist()
                item.data.update(module.forward_parameters(shape, names))
        return params


class _MasksFirst(AugmentationSequentialOps):
    """What a container does with one module: kornia does the same for its RandomTransplantation."""

    def __init__(self, data_keys: Any) -> None:
        super().__init__(data_keys)
        self.depth_place: int | None = None
        """Which of the masks is depth."""
        self.beside: dict[str, Any] = {}

    def transform(
        self, *arg: Any, module: Any, param: Any, extra_args: Any, data_keys: Any = None
    ) -> Any:
        """Apply one module to all that a container was given."""
        if not isinstance(module, RandomWeather):
            return super().transform(
                *arg, module=module, param=param, extra_args=extra_args, data_keys=data_keys
            )
        keys = self.preproc_datakeys(data_keys)
        masks = [place for place, key in enumerate(keys) if key == DataKey.MASK]
        depth_at = None if self.depth_place is None else masks.pop(self.depth_place)
        if DataKey.INPUT in keys:
            images = module.transform_tensor(arg[keys.index(DataKey.INPUT)])
            check_pictures(images)
            module.look(
                images,
                param.data,
                mask=arg[masks[0]] if masks else None,
                depth=None if depth_at is None else arg[depth_at],
                cameras=self.beside.get("cameras"),
            )
        others = [place for place in range(len(arg)) if place != depth_at]
        done = super().transform(
            *(arg[place] for place in others),
            module=module,
            param=param,
            extra_args=extra_args,
            data_keys=[keys[place] for place in others],
        )
        if depth_at is None:
            return done
        done = list(done) if len(others) > 1 else [done]
        return [*done[:depth_at], arg[depth_at], *done[depth_at:]]
