"""What a default render of any weather and any frame compiles or loads after `warm_up`.

Run in a process of its own, because what other tests have rendered is already compiled.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numba.core.dispatcher import Dispatcher

from weather_aug.clip.types import Box, Frame
from weather_aug.edit.ambience import ambience_of
from weather_aug.particles.shelter import Shelter
from weather_aug.render import compose
from weather_aug.render.lens_wiper import CROSSING, wiper_of
from weather_aug.taxonomy import TRAIN_ID
from weather_aug.weather import Weather

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from render_scene import make_camera, make_frame  # noqa: E402

AXES = np.eye(3)
WEATHERS = {
    "fog": Weather.fog("extreme"),
    "uneven fog": Weather.fog("heavy", fog_patchiness=0.5, fog_puffs=0.2),
    "rain": Weather.rain("extreme", wipers=1.0),
    "light rain": Weather.rain("light"),
    "wet road": Weather.rain("heavy", falling=False),
    "snow": Weather.snow("extreme", wipers=1.0),
    "snowed road": Weather.snow("heavy", falling=False),
    "sleet": Weather.mix(Weather.rain("heavy"), Weather.snow("heavy", snow_wetness=0.7)),
    "cloud": Weather(overcast=1.0),
}


def kernels() -> dict[str, Dispatcher]:
    """All compiled functions of the package, by their names."""
    found = {}
    for name, module in sorted(sys.modules.items()):
        if name.startswith("weather_aug"):
            for value in vars(module).values():
                if isinstance(value, Dispatcher):
                    found[f"{value.py_func.__module__}.{value.py_func.__name__}"] = value
    return found


def frames() -> Iterator[Frame]:
    """A road under a sky with a wall, a tree and a car, in all the forms a frame comes in."""
    width, height = 96, 64
    camera = make_camera(width, height, 80.0, velocity=(9.0, 0.0, 0.0))
    rows, columns = np.mgrid[:height, :width]
    with np.errstate(divide="ignore"):
        depth = np.minimum(1.5 * 80.0 / np.maximum(rows - 31.5, 0), 40.0)
    label = np.where(rows > 31, TRAIN_ID["road"], TRAIN_ID["building"])
    label[:32, 70:] = TRAIN_ID["vegetation"]
    label[:10] = TRAIN_ID["sky"]
    depth[:10] = np.inf
    label[28:40, 30:50], depth[28:40, 30:50] = TRAIN_ID["car"], 12.0
    image = (90 + 5 * (rows * 7 + columns * 3) % 61)[..., None] + np.array([0, 4, 9])
    frame = make_frame(camera, image, depth, label.astype(np.uint8))
    pose = np.eye(4)
    pose[:3, 3] = (14.0, 0.5, 0.75)
    car = Box(1, "car", pose, (4.5, 1.8, 1.5), np.array([12.0, 0.0, 0.0]))
    frame = replace(frame, boxes=(car,))
    half = np.nan_to_num(np.asarray(frame.depth_m), posinf=65504.0).astype(np.float16)
    for plain in (frame, replace(frame, depth_m=half)):
        for known in (plain, replace(plain, label=None), replace(plain, boxes=())):
            yield known
            yield frozen(known)


def frozen(frame: Frame) -> Frame:
    """The frame with arrays that cannot be written, as a scene maps them."""
    arrays: dict[str, Any] = {}
    for name in ("image", "label", "depth_m"):
        array = getattr(frame, name)
        if array is not None:
            arrays[name] = array.copy()
            arrays[name].flags.writeable = False
    return replace(frame, **arrays)


def render_all() -> None:
    """Every weather on every frame, whole and a window, with and without a roof."""
    cover = np.full((20, 20), 4.0, np.float32)
    roofs = (None, Shelter(cover, np.array([5.0, -10.0, 0.0]), AXES))
    for frame in frames():
        ambience = ambience_of(frame, AXES)
        for weather in WEATHERS.values():
            for k, roof in enumerate(roofs):
                wiper = wiper_of(weather, frame.camera, k, 0, 0.0)
                # While the blade passes, and just after it.
                since_s = (0.5, 3.0)[k] * CROSSING
                time_s = wiper.start_s + since_s * wiper.period_s if wiper else 0.1 * k
                compose.render(
                    replace(frame, time_s=time_s),
                    weather,
                    seed=k,
                    ambience=ambience,
                    window=None if roof else (5, 9, 40, 50),
                    shelter=roof,
                )


@contextlib.contextmanager
def fault() -> Iterator[None]:
    """Let `warm_up` forget the frames that nobody labelled."""
    render = compose.render

    def labelled_only(frame: Frame, *args: Any, **kwargs: Any) -> Any:
        return None if frame.label is None else render(frame, *args, **kwargs)

    with mock.patch.object(compose, "render", labelled_only):
        yield


def main() -> None:
    """Print, as JSON, the kernels that renders use and those of them that `warm_up` left cold."""
    with fault() if "--fault" in sys.argv else contextlib.nullcontext():
        compose.warm_up()
    warm = {name: set(kernel.signatures) for name, kernel in kernels().items()}
    render_all()
    left = {
        name: [str(found) for found in kernel.signatures if found not in warm.get(name, set())]
        for name, kernel in kernels().items()
    }
    used = [name for name, kernel in kernels().items() if kernel.signatures]
    cold = {name: signatures for name, signatures in left.items() if signatures}
    print(json.dumps({"used": used, "cold": cold}))  # noqa: T201


if __name__ == "__main__":
    main()
