"""Cameras, frames and splats for measurements: everything goes through the library's kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import Ambience
from weather_aug.particles.field import ParticleField
from weather_aug.particles.statistics import Population
from weather_aug.render.compose import render
from weather_aug.render.medium import Medium
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.render.project import BAND_ROWS, project, sorted_in_blocks, split_by_band
from weather_aug.render.stage import optics_of
from weather_aug.render.tile import TILE_FLOATS, blend_band
from weather_aug.weather import Weather

Float = NDArray[Any]

AXES = np.eye(3)
UP = np.array([0.0, 0, 1])
CALM = Air((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
AMBIENCE = Ambience(
    AXES,
    sky=np.array([0.6, 0.65, 0.7]),
    middle=np.full(3, 0.2),
    ground=np.full(3, 0.12),
    airlight=np.full(3, 0.6),
)
CLEAR_AIR = Medium(*(np.float32(v) for v in (0, 0, 0, 0, 60 / 1024, 0, 3)))
NOTHING_RESOLVED = np.zeros(1025, np.float32)
AIR_ONLY = RenderOptions(without=EFFECTS)
"""Air and particles: the background as recorded, clean glass, a camera that adds nothing."""


def camera(
    width: int, height: int, focal_px: float, speed_m_per_s: float = 0.0, **kwargs: Any
) -> Camera:
    """A level camera at 1.5 m that looks along the street and drives that way."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = (0, 0, 1.5)
    middle = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    velocity = np.array([speed_m_per_s, 0.0, 0.0])
    return Camera(np.array(middle), pose, width, height, velocity_m_per_s=velocity, **kwargs)


def wall(cam: Camera, depth_m: float | Float, level: int | Float = 0) -> Frame:
    """A frame whose every pixel has this sRGB level and depth."""
    shape = (cam.height, cam.width)
    levels = np.broadcast_to(np.asarray(level, np.uint8), shape)
    image = np.repeat(levels[..., None], 3, axis=2)
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), shape).copy()
    return Frame(FrameKey(0, "front"), 1.0, cam, image, None, depth)


def slants(cam: Camera) -> Float:
    """(H, W) length of each pixel's ray per metre of depth."""
    (fx, fy), (cx, cy) = cam.focal_px, cam.principal_px
    v, u = np.mgrid[: cam.height, : cam.width]
    return np.asarray(np.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2))


def through(
    frame: Frame, weather: Weather, seed: int = 0, options: RenderOptions = AIR_ONLY
) -> Float:
    """Transmittance (H, W) of a frame rendered in a weather."""
    return render(frame, weather, seed=seed, ambience=AMBIENCE, options=options).transmittance


def extinction_per_m(
    frames: list[tuple[Frame, Weather, int]], options: RenderOptions = AIR_ONLY
) -> float:
    """Extinction that explains the mean transmittance of rendered walls: Beer-Lambert, inverted."""
    shots = [through(frame, weather, seed, options) for frame, weather, seed in frames]
    mean = float(np.mean(shots))
    frame = frames[0][0]
    assert frame.depth_m is not None
    path_m = slants(frame.camera) * frame.depth_m
    low, high = 0.0, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.exp(-middle * path_m).mean() > mean else (low, middle)
    return low


def field(population: Population, seed: int, air: Air = CALM) -> ParticleField:
    """A field over the street's axes."""
    return ParticleField(population, seed, air, AXES)


def whole(cam: Camera) -> tuple[int, int, int, int]:
    """Window of the whole picture."""
    return (0, 0, cam.height, cam.width)


def in_picture(records: Float, cam: Camera) -> Float:
    """Records whose middles are inside the picture."""
    u = cam.focal_px[0] * records[:, 0] / records[:, 2] + cam.principal_px[0]
    v = cam.focal_px[1] * records[:, 1] / records[:, 2] + cam.principal_px[1]
    across = (u >= -0.5) & (u < cam.width - 0.5)
    return np.asarray(records[across & (v >= -0.5) & (v < cam.height - 0.5)])


def balls(places: Float, velocities: Float, diameter_m: float, opacity: float = 1.0) -> Float:
    """Records (N, 13) of balls in camera axes."""
    records = np.zeros((len(places), 13), np.float32)
    records[:, :3], records[:, 3:6] = places, velocities
    records[:, [6, 9, 11]] = diameter_m**2 / 8
    records[:, 12] = opacity
    return records


def splats_of(records: Float, cam: Camera, *, compensate: bool = True) -> Float:
    """The library's splats (M, 16) of particles in clear air."""
    white = np.ones((1, 3), np.float32)
    blocks, kinds = sorted_in_blocks(np.asarray(records, np.float32), np.array([len(records)]))
    return np.asarray(
        project(
            blocks,
            kinds,
            white,
            optics_of(cam, UP),
            CLEAR_AIR,
            NOTHING_RESOLVED,
            white[0],
            whole(cam),
            compensate,
        )
    )


def transmittance(records: Float, cam: Camera, *, compensate: bool = True) -> Float:
    """Transmittance (H, W) of particles alone, in clear air."""
    splats = splats_of(records, cam, compensate=compensate)
    bands = -(-cam.height // BAND_ROWS)
    splats, starts = split_by_band(splats, whole(cam), bands)
    stride = (cam.width + 15) // 16 * 16 + 80
    tiles = np.empty((BAND_ROWS // 4, stride // 4, TILE_FLOATS), np.float32)
    rows = []
    for band in range(bands):
        planes = np.zeros((BAND_ROWS, 5, stride), np.float32)
        planes[:, 3], planes[:, 4] = 1.0, 1000.0
        mine = splats[starts[band] : starts[band + 1]]
        blend_band(mine, whole(cam), band * BAND_ROWS, planes, tiles)
        rows.append(planes[:, 3, : cam.width])
    return np.concatenate(rows)[: cam.height]
