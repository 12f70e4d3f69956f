"""A small street for the batch renderer's tests, as arrays, as tensors and under names."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from render_scene import make_camera, make_frame

from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.render.batch import BATCH_OPTIONS, render_batch
from weather_aug.render.compose import render
from weather_aug.taxonomy import (
    BUILDING,
    IGNORE,
    ROAD,
    SIDEWALK,
    SKY,
    TERRAIN,
    TRAIN_ID,
    VEGETATION,
)
from weather_aug.weather import Weather

AMBIENCE = Ambience(
    np.eye(3),
    sky=np.array([0.4, 0.6, 0.9]),
    middle=np.full(3, 0.2),
    ground=np.full(3, 0.12),
    airlight=np.array([0.55, 0.56, 0.57]),
)
FOG = Weather(visibility_m=120.0, fog_scale_height_m=30.0)
WEATHERS = {
    "rain": Weather(rain_mm_per_h=75.0),
    "snow": Weather.snow("extreme"),
    "wet snow": Weather(
        snow_mm_per_h=12.0, snow_wetness=0.8, wind_m_per_s=(2, 4, 0), gustiness=0.4
    ),
    "spray": Weather(spray_per_km=150.0),
    "even fog": Weather(visibility_m=80.0),
    "fog": replace(Weather.fog("heavy"), overcast=0.0),
    "patchy fog": Weather(visibility_m=90.0, fog_patchiness=0.8),
    "puffy low fog": Weather(
        visibility_m=90.0, fog_scale_height_m=12.0, fog_patchiness=0.4, fog_puffs=0.4
    ),
    "rain and fog": Weather.mix(replace(FOG, fog_patchiness=0.5), Weather.rain("extreme")),
    "rain and snow": Weather.mix(Weather.rain("heavy"), Weather.snow("heavy")),
}
BACKGROUNDS = {
    "overcast": Weather(overcast=0.7),
    "wet": Weather(wetness=1.0, puddles=0.4),
    "after rain": Weather.rain("extreme", falling=False),
    "snowed on": Weather(snow_cover=0.6, road_snow_cover=0.4, snow_depth_m=0.08),
    "after snow": Weather.snow("moderate", falling=False),
    "road snow": Weather(road_snow_cover=0.5, overcast=1.0),
    "rain after snow": Weather.mix(
        Weather.rain("moderate"), Weather.snow("heavy", falling=False, wetness=0.5)
    ),
}
"""Weathers of surfaces, most of them under clear air."""
AGREEMENT_DB = 50
"""At least this near to `render`; its own rounding to 8 bits alone is 59 dB."""
MOTIONS = {
    "parked": {},
    "driving": {"velocity_m_per_s": np.array([14.0, 0.3, 0])},
    "turning": {
        "velocity_m_per_s": np.array([8.0, 0, 0]),
        "angular_velocity_rad_per_s": np.array([0.1, -0.6, 0.2]),
    },
}


@dataclass(frozen=True)
class Case:
    """One picture to render both ways."""

    frame: Frame
    weather: Weather
    seed: int = 3

    def alone(self, **choices):
        """By `render`, with what a batch draws."""
        choices = {"options": BATCH_OPTIONS} | choices
        return render(self.frame, self.weather, seed=self.seed, ambience=AMBIENCE, **choices)


def street(motion="parked", *, width=160, height=96, labelled=True, time_s=1.0, **optics):
    """Road, facades and sky with texture, and their depth."""
    optics = {"exposure_s": 0.004} | MOTIONS[motion] | optics
    camera = make_camera(width, height, **optics)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    x = (u - (width - 1) / 2) / camera.focal_px[0]
    y = (v - (height - 1) / 2) / camera.focal_px[1]
    with np.errstate(divide="ignore"):
        road, facade = np.where(y > 0, 1.5 / y, np.inf), 4.0 / np.abs(x)
    facade[facade * -y > 6.0] = np.inf
    depth = np.minimum(road, facade).astype(np.float32)
    depth[depth > 300] = np.inf
    label = np.where(road < facade, ROAD, BUILDING).astype(np.uint8)
    label[np.isinf(depth)] = SKY
    image = np.random.default_rng(5).integers(20, 235, (height, width, 3)).astype(np.uint8)
    image[label == SKY] = 200 + image[label == SKY] // 8
    return make_frame(camera, image, depth, label if labelled else None, time_s)


def yard(*, labelled=True, **optics):
    """The street with all that surfaces may be: pavements, grass, trees, a car, poles, a shadow."""
    frame = street("driving", labelled=labelled, **optics)
    depth, image = frame.depth_m.copy(), frame.image.copy()
    height, width = depth.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    left_m = (u - (width - 1) / 2) / frame.camera.focal_px[0] * np.minimum(depth, 300)
    y = (v - (height - 1) / 2) / frame.camera.focal_px[1]
    ground = np.isfinite(depth) & (depth * y > 1.5 - 1e-3)
    label = np.where(ground, ROAD, np.where(np.isinf(depth), SKY, BUILDING)).astype(np.uint8)
    label[ground & (np.abs(left_m) > 2.5)] = SIDEWALK
    label[ground & (left_m > 3.2)] = TERRAIN
    label[(label == BUILDING) & (u < width // 4)] = VEGETATION
    label[height - 6 :, width // 3 : width // 2] = IGNORE
    image[:] = 90 + image // 8
    image[label == VEGETATION] = (30, 70, 25) + image[label == VEGETATION] // 4
    image[label == SKY] = (150, 180, 240)
    image[ground & (depth > 5) & (depth < 9)] //= 2
    car = np.s_[height // 2 - 2 : height // 2 + 12, width // 2 : width // 2 + 26]
    label[car], depth[car], image[car] = TRAIN_ID["car"], 8.5, (120, 20, 25)
    pole = np.s_[height // 4 : height // 2 + 14, width // 5 : width // 5 + 3]
    label[pole], depth[pole] = TRAIN_ID["pole"], 7.0
    return make_frame(frame.camera, image, depth, label if labelled else None)


def arguments(cases, dtype=torch.float32):
    """Of `render_batch`, for cases of one size."""
    frames = [case.frame for case in cases]
    images = np.stack([frame.image for frame in frames])
    labels = None
    if frames[0].label is not None:
        labels = torch.from_numpy(np.stack([frame.label for frame in frames]))
    return {
        "images": torch.from_numpy(images).permute(0, 3, 1, 2).to(dtype) / 255,
        "depth_m": torch.from_numpy(np.stack([frame.depth_m for frame in frames])),
        "cameras": [frame.camera for frame in frames],
        "weathers": [case.weather for case in cases],
        "seeds": [case.seed for case in cases],
        "ambiences": [AMBIENCE] * len(cases),
        "times_s": [frame.time_s for frame in frames],
        "labels": labels,
        "splatting": "torch",
    }


def batch(cases, **overrides):
    return render_batch(**(arguments(cases) | overrides))


def psnr(levels, expected):
    """Of (3, H, W) in [0, 1] against (H, W, 3) uint8, decibels."""
    image = 255 * levels.detach().double().cpu().numpy().transpose(1, 2, 0)
    return 10 * np.log10(255**2 / max(np.mean((image - expected) ** 2), 1e-12))
