"""Particles drawn alone, by the compiled kernels, for the checks of the physics."""

import logging

import numpy as np
from oracles import reference_render as reference

from weather_aug.render.medium import Medium
from weather_aug.render.project import project, sorted_in_blocks
from weather_aug.render.stage import optics_of
from weather_aug.render.tile import TILE_FLOATS, blend_band

UP = np.array([0.0, 0, 1])
CLEAR_AIR = Medium(*(np.float32(v) for v in (0, 0, 0, 0, 60 / 1024, 0, 3)))
NOTHING_RESOLVED = np.zeros(1025, np.float32)
FILTER_PX2 = 0.3
FAINTEST = 1 / 255
"""What a peak is raised by, against the cut of its footprint."""


def measured(text):
    """Say what a check has measured; `pytest tests/physics --log-cli-level=INFO` shows it."""
    logging.getLogger("physics").info(text)


def solid(position, velocity, diameter_m, opacity=1.0):
    """Records (N, 13) of balls; opacity scales the peak."""
    position = np.atleast_2d(np.asarray(position, float))
    records = np.zeros((len(position), 13), np.float32)
    records[:, :3] = position
    records[:, 3:6] = velocity
    records[:, [6, 9, 11]] = (np.asarray(diameter_m, float).reshape(-1, 1)) ** 2 / 8
    records[:, 12] = opacity
    return records


def splats_of_records(records, camera, colour=(1.0, 1.0, 1.0), *, compensate=True):
    """(M, 16) Gaussians on the picture in clear air."""
    blocks, kinds = sorted_in_blocks(np.asarray(records, np.float32), np.array([len(records)]))
    return project(
        blocks,
        kinds,
        np.array([colour], np.float32),
        optics_of(camera, UP),
        CLEAR_AIR,
        NOTHING_RESOLVED,
        np.ones(3, np.float32),
        (0, 0, camera.height, camera.width),
        compensate,
    )


def layer(splats, camera, level=0, depth_m=1000.0):
    """Picture (H, W, 3) and transmittance (H, W) of splats over a uniform sRGB level."""
    height, width = camera.height, camera.width
    rows, columns = (-(-n // 4) * 4 for n in (height, width))
    planes = np.empty((rows, 5, columns), np.float32)
    planes[:, :3] = np.broadcast_to(reference.linear(level), 3)[:, None]
    planes[:, 3], planes[:, 4] = 1.0, depth_m
    tiles = np.empty((rows // 4, columns // 4, TILE_FLOATS), np.float32)
    blend_band(splats, (0, 0, height, width), 0, planes, tiles)
    light = planes[:height, :3, :width].transpose(0, 2, 1).astype(float)
    return np.round(reference.srgb(light)).astype(np.uint8), planes[:height, 3, :width].copy()


def covariances(splats):
    """(M, 2, 2) of the footprints, px^2, the pixel filter included."""
    a, b, c = splats[:, 2:5].astype(float).T
    conic = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    return np.linalg.inv(conic)


def long_axes(splats):
    """(M, 2) unit vectors along the streaks."""
    return np.linalg.eigh(covariances(splats))[1][:, :, 1]


def angle_deg(first, second):
    """Angle between two lines, degrees in [0, 90]; arrays of (..., 2)."""
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return np.degrees(np.arctan2(np.abs(cross), np.abs((first * second).sum(-1))))
