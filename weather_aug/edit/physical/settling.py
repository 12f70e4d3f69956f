"""Where snow can settle, and where wheels keep it off: maps on the small grid."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.edit.physical.site import Site, shrunk
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

FARTHEST_SIDE_M = 60.0
ROUGH_M = 0.08
LEAST_STEP_M = 1e-3


def facing_up(site: Site) -> Float32:
    """How level surfaces lie, (h, w) in [0, 1]: the upward part of their normals; 0 in the sky.

    From the places of the cell above and the cell below; across a jump of depth nothing is level.
    Where the frame has normals they must agree: a picture of Gaussians has a depth that is not
    smooth enough to tell a wall from a roof, and normals that mean little on small round things.
    """
    up = _up_of_places(site)
    if site.frame.normals_world is not None:
        up = np.minimum(up, _up_of_normals(site))
    up[site.small_classes == SKY] = 0.0
    up[site.is_ground] = 1.0
    return cv2.blur(up.astype(np.float32), (3, 3))


def _up_of_normals(site: Site) -> Float32:
    normals = np.asarray(site.frame.normals_world, np.float32)
    up = shrunk(normals @ site.axes_world[2].astype(np.float32), site.step)
    return np.clip(up, 0.0, 1.0)


def _up_of_places(site: Site) -> Float32:
    points = site.offsets
    with np.errstate(invalid="ignore"):
        rise = np.zeros_like(points)
        rise[1:-1] = points[:-2] - points[2:]
        away = np.hypot(rise[..., 0], rise[..., 1])
        up = away / np.sqrt(away**2 + rise[..., 2] ** 2 + ROUGH_M**2)
        jump = away > 0.5 + 0.25 * site.depth_m
    up[~np.isfinite(up) | jump] = 0.0
    return up.astype(np.float32)


def lateral_m(site: Site, path: Float64 | None) -> Float32:
    """How far left of the driven way the road's plane is seen, (h, w) metres.

    Args:
        site: The frame.
        path: (P, 2) places (along, left) of the camera in the order driven, street axes; None where
            the way is unknown: then, as when the car was parked, it goes straight ahead.
    """
    places = _on_plane(site)
    if path is None or not _steps(np.asarray(path, np.float64)).any():
        ahead = site.axes_world[:2] @ site.frame.camera.world_from_camera[:3, 2]
        ahead = ahead / max(float(np.hypot(*ahead)), 1e-6)
        path = site.origin[:2] + np.outer((0.0, 1.0), ahead)
    return _signed_distance(places, np.asarray(path, np.float64)).astype(np.float32)


def _steps(path: Float64) -> NDArray[np.bool_]:
    """(P - 1,) which steps of a path lead anywhere."""
    return np.hypot(*np.diff(path, axis=0).T) > LEAST_STEP_M


def _on_plane(site: Site) -> Float64:
    """(h, w, 2) where the views through the cells meet the road's plane; far away above it."""
    rays = site.rays.astype(np.float64)
    above = site.origin[2] - site.plane[0] - site.plane[1:] @ site.origin[:2]
    fall = -(rays[..., 2] - rays[..., :2] @ site.plane[1:])
    distance = above / np.maximum(fall, above / 500.0)
    return site.origin[:2] + distance[..., None] * rays[..., :2]


def _signed_distance(places: Float64, path: Float64) -> Float64:
    """Signed distance (h, w), left positive, from a polyline whose ends go on for ever."""
    kept = _steps(path)
    starts, steps = path[:-1][kept], np.diff(path, axis=0)[kept]
    lengths = np.hypot(*steps.T)
    best = np.full(places.shape[:2], np.inf)
    signed = np.zeros(places.shape[:2])
    for index, (start, step, length) in enumerate(zip(starts, steps, lengths, strict=True)):
        unit = step / length
        offset = places - start
        along = offset @ unit
        low = -np.inf if index == 0 else 0.0
        high = np.inf if index == len(starts) - 1 else length
        beyond = along - np.clip(along, low, high)
        left = offset[..., 1] * unit[0] - offset[..., 0] * unit[1]
        distance = np.hypot(left, beyond)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        signed = np.where(nearer, np.where(left < 0, -distance, distance), signed)
    return np.clip(signed, -FARTHEST_SIDE_M, FARTHEST_SIDE_M)
