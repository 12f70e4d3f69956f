"""A wall, the ground and a floating box, drawn exactly in float64, from any camera.

The colour of a surface is an affine function of its place over its depth in one camera, b: on each
plane that is affine in the pixels of b, so that bilinear sampling of b is exact, whatever the
cameras. Depths of the surfaces are far apart, so that no occlusion is within the tolerance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Float64, Frame, FrameKey

GROUND_Y_M, WALL_Z_M, WALL_TOP_M = 1.5, 30.0, -6.0
BOX_LOW_M, BOX_HIGH_M = np.array([-1.2, -0.9, 8.0]), np.array([0.9, 0.7, 8.6])
NOTHING, GROUND, WALL, BOX = -1, 0, 1, 2
"""Faces; those of the box are BOX + axis, plus 3 on the far side."""


def camera(
    shift_m: tuple[float, float, float] = (0, 0, 0),
    yaw_rad: float = 0.0,
    pitch_rad: float = 0.0,
    width: int = 64,
    height: int = 48,
    focal_px: float = 50.0,
) -> Camera:
    """World axes are those of a camera that does not turn: x right, y down, z ahead."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    yaw = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    pitch = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = yaw @ pitch, shift_m
    centre = (width - 1) / 2 + 0.3, (height - 1) / 2 - 0.2
    intrinsics = np.array([[focal_px, 0, centre[0]], [0, 1.1 * focal_px, centre[1]], [0, 0, 1]])
    return Camera(intrinsics, pose, width, height)


def directions(of: Camera) -> Float64:
    """(H, W, 3) rays of depth 1 through the pixels, in world axes."""
    rows, columns = np.mgrid[: of.height, : of.width].astype(float)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    return pixels @ np.linalg.inv(of.intrinsics).T @ of.world_from_camera[:3, :3].T


def hits(origin: Float64, rays: Float64) -> tuple[Float64, NDArray[np.int64]]:
    """Depth and face of the nearest surface along rays (..., 3)."""
    depth, face = np.full(rays.shape[:-1], np.inf), np.full(rays.shape[:-1], NOTHING)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (GROUND_Y_M - origin[1]) / rays[..., 1]
        ground = np.where(
            (ground > 0) & (origin[2] + ground * rays[..., 2] < WALL_Z_M), ground, np.inf
        )
        wall = (WALL_Z_M - origin[2]) / rays[..., 2]
        y = origin[1] + wall * rays[..., 1]
        wall = np.where((wall > 0) & (y <= GROUND_Y_M) & (y >= WALL_TOP_M), wall, np.inf)
        slabs = np.sort(
            np.stack([(BOX_LOW_M - origin) / rays, (BOX_HIGH_M - origin) / rays]), axis=0
        )
    near, axis = slabs[0].max(axis=-1), slabs[0].argmax(axis=-1)
    box = np.where((near > 0) & (near < slabs[1].min(axis=-1)), near, np.inf)
    backwards = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] < 0
    for reached, ids in ((ground, GROUND), (wall, WALL), (box, BOX + axis + 3 * backwards)):
        nearer = reached < depth
        depth, face = np.where(nearer, reached, depth), np.where(nearer, ids, face)
    return depth, face


def colours(points: Float64, camera_b: Camera) -> Float64:
    """(..., 3) in [0, 1] of places, or of directions with a last coordinate of 0; (..., 4)."""
    affine = np.array([[0.06, 0.02, 0.05, 0.9], [-0.05, 0.07, 0.07, 1.2], [0.03, -0.06, 0.1, 0.7]])
    depth_b = (points @ np.linalg.inv(camera_b.world_from_camera).T)[..., 2]
    return points @ affine.T / depth_b[..., None]


def view(of: Camera, camera_b: Camera) -> tuple[Frame, Float64, NDArray[np.int64]]:
    """The frame with exact depth, the picture (H, W, 3) float64 and the face of each pixel."""
    rays = directions(of)
    depth, face = hits(of.centre_world, rays)
    sky = face == NOTHING
    places = np.where(
        sky[..., None], rays, of.centre_world + np.where(sky, 1, depth)[..., None] * rays
    )
    picture = colours(np.concatenate([places, ~sky[..., None]], axis=-1), camera_b)
    blank = np.zeros((of.height, of.width, 3), np.uint8)
    return Frame(FrameKey(0, "view"), 0.0, of, blank, depth_m=depth), np.clip(picture, 0, 1), face


def sampled_from_one_face(
    from_: Camera, to: Camera, depth: Float64, faces_to: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(H, W): pixels of one view whose four neighbours in the other are of one face, any face.

    Between faces the colours have a crease, where bilinear sampling is not exact.
    """
    sky = np.isinf(depth)[..., None]
    rays = directions(from_)
    places = np.where(sky, rays, from_.centre_world + np.where(sky, 1, depth[..., None]) * rays)
    homogeneous = np.concatenate([places, ~sky], axis=-1)
    in_to = (homogeneous @ np.linalg.inv(to.world_from_camera).T)[..., :3] @ to.intrinsics.T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = in_to[..., 0] / in_to[..., 2], in_to[..., 1] / in_to[..., 2]
    usable = (in_to[..., 2] > 0) & np.isfinite(column) & np.isfinite(row)
    left = np.clip(np.where(usable, column, 0), 0, to.width - 1.001).astype(int)
    top = np.clip(np.where(usable, row, 0), 0, to.height - 1.001).astype(int)
    around = np.stack([faces_to[top + i, left + j] for i in (0, 1) for j in (0, 1)])
    return usable & (around == around[0]).all(axis=0)


def truly_visible(from_: Camera, to: Camera, depth: Float64) -> NDArray[np.bool_]:
    """(H, W): pixels whose surface the other camera sees in its picture, by a ray back to it."""
    rays = directions(from_)
    solid = np.isfinite(depth)
    places = from_.centre_world + np.where(solid, depth, 1.0)[..., None] * rays
    back = places - to.centre_world
    reached, _ = hits(to.centre_world, back)
    in_to = back @ to.world_from_camera[:3, :3] @ to.intrinsics.T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = in_to[..., 0] / in_to[..., 2], in_to[..., 1] / in_to[..., 2]
    inside = (column >= 0) & (column <= to.width - 1) & (row >= 0) & (row <= to.height - 1)
    return solid & (in_to[..., 2] > 0) & inside & (reached > 1 - 1e-9)
