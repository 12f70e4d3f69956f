"""Pictures and depth for the benchmarks: 1/f texture over a street-shaped depth map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import Ambience, ambience_of
from weather_aug.taxonomy import BUILDING, ROAD, SKY

AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FACADE_M = 9.0
CAMERA_HEIGHT_M = 1.5


def street(height: int, width: int, *, speed_m_per_s: float = 0.0) -> tuple[Frame, Ambience]:
    """A road between two facades under a sky, with its light."""
    focal_px = 1.1 * width
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]]
    )
    camera = Camera(
        intrinsics,
        np.eye(4),
        width,
        height,
        exposure_s=0.005,
        velocity_m_per_s=np.array([0.0, 0.0, speed_m_per_s]),
    )
    v, u = np.mgrid[:height, :width].astype(np.float32)
    x, y = (u - (width - 1) / 2) / focal_px, (v - (height - 1) / 2) / focal_px
    with np.errstate(divide="ignore"):
        road = np.where(y > 0, CAMERA_HEIGHT_M / y, np.inf)
        facade = FACADE_M / np.abs(x)
    facade[facade * -y > 12.0] = np.inf
    depth = np.minimum(road, facade).astype(np.float32)
    depth[depth > 500] = np.inf
    label = np.where(road < facade, ROAD, BUILDING).astype(np.uint8)
    label[np.isinf(depth)] = SKY
    frame = Frame(FrameKey(0, "bench"), 1.0, camera, texture(height, width), label, depth)
    return frame, ambience_of(frame, AXES)


def texture(height: int, width: int) -> NDArray[np.uint8]:
    """Noise with a 1/f spectrum, as photographs have, (H, W, 3) uint8."""
    rng = np.random.default_rng(0)
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    amplitude = 1 / np.maximum(np.hypot(fy, fx), 1 / width)
    planes = []
    for _ in range(3):
        spectrum = np.fft.fft2(rng.normal(size=(height, width))) * amplitude
        plane = np.fft.ifft2(spectrum).real
        planes.append(110 + 45 * plane / plane.std())
    return np.clip(np.stack(planes, axis=-1), 0, 255).astype(np.uint8)
