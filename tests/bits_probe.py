"""Renders a set of cases and prints a digest of every plane; run in processes set up differently.

The inputs are made of integers and of operations that IEEE 754 fixes, so that they are equal on
every machine.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Box, Camera, Frame, FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.edit.surface import Surface, depth_of
from weather_aug.particles.shelter import Shelter
from weather_aug.render import stage
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.fields import RigMotion
from weather_aug.render.lens_wiper import CROSSING, wiper_of
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.taxonomy import BUILDING, ROAD, SKY, TRAIN_ID
from weather_aug.weather import Weather

HEIGHT, WIDTH, FOCAL_PX = 120, 208, 160.0
PLANES = ("image", "label", "invalid", "transmittance")
AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
STREET = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1.0]])
SCATTERED = RenderOptions(multiple_scattering=True)
PUBLISHED = RenderOptions(preset="weatheredit")
PATCHY = {"fog_patchiness": 0.7, "fog_puffs": 0.3}
WIPED = Weather.rain("extreme", wipers=1.0)

CASES: dict[str, tuple[Weather, dict[str, Any]]] = {
    "rain": (Weather.rain("heavy", gustiness=0.4), {}),
    "snow-dry": (Weather.snow("heavy"), {}),
    "snow-wet": (Weather.snow("moderate", snow_wetness=0.8), {}),
    "fog": (Weather.fog("heavy"), {}),
    "fog-uneven": (Weather.fog("moderate", **PATCHY), {}),
    "fog-shallow": (Weather(visibility_m=90.0, fog_scale_height_m=12.0, **PATCHY), {}),
    "mix": (Weather.mix(Weather.rain("heavy"), Weather.snow("heavy")), {}),
    "turning": (Weather.mix(Weather.fog("light"), Weather.rain("heavy")), {"turn": 0.3}),
    "shelter": (Weather.rain("heavy"), {"shelter": True}),
    "scattering": (Weather.fog("heavy", **PATCHY), {"options": SCATTERED}),
    "published-rain": (Weather.rain("heavy"), {"options": PUBLISHED}),
    "published-snow": (Weather.snow("heavy"), {"options": PUBLISHED}),
    "published-fog": (Weather.fog("heavy"), {"options": PUBLISHED}),
    "carried": (Weather.snow("heavy"), {"options": RenderOptions(alignment="camera")}),
    "few": (Weather.rain("extreme"), {"options": RenderOptions(max_particles=300)}),
    "air-only": (Weather.rain("heavy"), {"options": RenderOptions(without=EFFECTS)}),
    "wet-road": (Weather.rain("extreme", falling=False), {"traffic": True}),
    "snowed-road": (Weather.snow("heavy", falling=False), {"traffic": True}),
    "traffic": (Weather.rain("heavy"), {"traffic": True, "moment": 0.5}),
    "wiped": (WIPED, {"moment": 3.0}),
    "unlabelled": (WIPED, {"traffic": True, "labelled": False, "moment": 0.5}),
    "half": (Weather.snow("extreme"), {"precision": np.float16}),
}
"""Weathers, and what their frames and renders have besides.

A "moment" is when a wiper's blade is in the picture (below 1) or has passed (above)."""
SEED = 77


def frame_of(
    turn: float = 0.0,
    *,
    traffic: bool = False,
    labelled: bool = True,
    precision: Any = np.float32,
) -> Frame:
    """A road between walls under a sky, with texture, trees and a car, if asked for.

    The camera drives and may turn, radians per second.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.int64)
    texture = (rows * 7919 + columns * 104729 + rows * columns * 31) % 61
    base = np.stack([texture + 70, texture + 75, texture + 80], axis=-1)
    below = np.maximum(rows - HEIGHT // 2, 0)
    aside = np.abs(columns - WIDTH // 2)
    with np.errstate(divide="ignore"):
        road, wall = 1.5 * FOCAL_PX / below, 6.0 * FOCAL_PX / aside
    depth = np.minimum(road, wall)
    sky = (rows < HEIGHT // 2 - aside // 2) | ~np.isfinite(depth)
    label = np.where(sky, SKY, np.where(road < wall, ROAD, BUILDING)).astype(np.uint8)
    base[sky] += 90
    if traffic:
        label[(label == BUILDING) & (columns > WIDTH // 2)] = TRAIN_ID["vegetation"]
        label[58:76, 92:114], depth[58:76, 92:114] = TRAIN_ID["car"], 12.0
    pose = np.eye(4)
    # A turn of the pose whose numbers are exact: 3-4-5.
    pose[:3, :3] = AXES @ np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]])
    pose[:3, 3] = (12.25, -3.5, 1.5)
    camera = Camera(
        np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]]),
        pose,
        WIDTH,
        HEIGHT,
        velocity_m_per_s=np.array([9.0, 3.0, 0.0]),
        angular_velocity_rad_per_s=np.array([0.0, turn, 0.1 * turn]),
        exposure_s=1 / 64,
    )
    far = np.inf if precision == np.float32 else 65504.0
    return Frame(
        FrameKey(0, "front"),
        3.375,
        camera,
        base.astype(np.uint8),
        label if labelled else None,
        np.where(sky, far, depth).astype(precision),
        boxes=(_car(pose),) if traffic else (),
    )


def _car(world_from_camera: NDArray[np.float64]) -> Box:
    """12 m ahead, driving down the street."""
    pose = np.eye(4)
    pose[:3, :3] = STREET.T
    pose[:3, 3] = world_from_camera[:3, 3] + 12.0 * world_from_camera[:3, 2] - (0, 0, 0.75)
    return Box(1, "car", pose, (4.5, 1.75, 1.5), 12.0 * STREET[0])


def rendered(name: str) -> RenderedFrame:
    """Render one case."""
    weather, extra = CASES[name]
    made = {key: extra[key] for key in ("turn", "traffic", "labelled", "precision") if key in extra}
    frame = frame_of(**made)
    if "moment" in extra:
        wiper = wiper_of(WIPED, frame.camera, SEED, 0, 0.0)
        assert wiper is not None
        since_s = extra["moment"] * CROSSING * wiper.period_s
        frame = replace(frame, time_s=wiper.start_s + since_s)
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = AXES, (0.0, 0.0, 1.5)
    cover = np.where(np.arange(60)[:, None] % 20 < 8, 5.0, math.inf) * np.ones((60, 60))
    roof = Shelter(cover.astype(np.float32), np.array([-10.0, -30.0, 0.0]), STREET)
    return render(
        frame,
        weather,
        seed=SEED,
        ambience=ambience_of(frame, STREET),
        shelter=roof if extra.get("shelter") else None,
        rig=RigMotion(first, frame.camera.world_from_camera),
        options=extra.get("options", RenderOptions()),
    )


def digests(names: list[str]) -> dict[str, str]:
    """SHA-256 of each plane of each case, by "case/plane"."""
    found = {}
    for name in names:
        shot = rendered(name)
        for plane in PLANES:
            data = getattr(shot, plane)
            if data is not None:
                found[f"{name}/{plane}"] = hashlib.sha256(data.tobytes()).hexdigest()
    return found


def canaries() -> dict[str, str]:
    """Digests of what is known to depend on the CPU level."""
    x = np.linspace(-20.0, 20.0, 20_001)
    square = np.sin(np.arange(64.0 * 64.0)).reshape(64, 64)
    values = {
        "numpy exp": np.exp(x),
        "numpy power": np.abs(x) ** 2.4,
        "C exp": np.array([math.exp(v) for v in x]),
        "BLAS product": square @ square,
        "OpenCV blur": cv2.GaussianBlur(square, (0, 0), 2.0),
    }
    return {name: hashlib.sha256(value.tobytes()).hexdigest() for name, value in values.items()}


@contextlib.contextmanager
def fault() -> Iterator[None]:
    """Let numpy's exp, whose last bit depends on the CPU, draw every pixel's depth."""
    read = stage.Stage._run

    def faulty(self: stage.Stage, surface: Surface, *arguments: Any) -> stage.Planes:
        whole = (0, 0, len(surface.image) // surface.width, surface.width)
        depth = depth_of(surface, whole).reshape(-1)
        logarithm = np.log(np.minimum(depth, 1e4).astype(np.float64))
        jittered = (np.exp(logarithm) * 2.0**45 % 1.0).astype(np.float32) + depth
        jittered.flags.writeable = False
        surface = surface._replace(single=jittered, half=surface.half[:0])
        return read(self, surface, *arguments)

    with mock.patch.object(stage.Stage, "_run", faulty):
        yield


def set_threads(count: int) -> None:
    """Of the libraries that have a call for it; the others read the environment."""
    import numba
    import torch

    cv2.setNumThreads(count)
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    torch.set_num_threads(count)


def main() -> None:
    """Print digests of planes and canaries as JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--threads", type=int)
    parser.add_argument("--fault", action="store_true")
    parser.add_argument("--save", type=Path)
    arguments = parser.parse_args()
    names = arguments.cases.split(",")
    if arguments.threads:
        set_threads(arguments.threads)
    if arguments.save:
        shots = {name: rendered(name) for name in names}
        saved = {f"{n}/{p}": getattr(s, p) for n, s in shots.items() for p in PLANES}
        np.savez(arguments.save, **{k: plane for k, plane in saved.items() if plane is not None})
    with fault() if arguments.fault else contextlib.nullcontext():
        planes = digests(names)
    print(json.dumps({"planes": planes, "canaries": canaries()}))  # noqa: T201


if __name__ == "__main__":
    main()
