"""Rigid motions from files: checked, made exactly orthonormal, and the up direction they imply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import RIGID_TOLERANCE
from weather_aug.errors import CalibrationError

Float64 = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3
MIN_TRAVEL_M = 1.0


def rigid_motion(rows: Float64, where: str) -> Float64:
    """(4, 4) rigid motion from 12 or 16 numbers (row-major), its rotation made orthonormal.

    Raises:
        CalibrationError: If it is not a finite rotation and translation to 1e-4; `where` is named.
    """
    matrix = np.eye(4)
    matrix[:3] = np.asarray(rows, np.float64).reshape(-1, 4)[:3]
    if not np.isfinite(matrix).all():
        raise CalibrationError(f"{where} holds NaN or infinity; repair it or leave the frame out")
    rotation = matrix[:3, :3]
    off_rigid = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off_rigid > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise CalibrationError(
            f"{where} is not a rigid motion (its rotation is off by {off_rigid:.2g}); repair it"
        )
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right
    return matrix


def motion_from_quaternion(wxyz: Float64, translation_m: Float64, where: str) -> Float64:
    """(4, 4) rigid motion from a unit quaternion (w, x, y, z) and a translation.

    Raises:
        CalibrationError: If the quaternion's length is not 1 to 1e-3; `where` is named.
    """
    length = float(np.linalg.norm(wxyz))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise CalibrationError(f"{where} has a quaternion of length {length:g} instead of 1")
    w, x, y, z = wxyz / length
    motion = np.eye(4)
    motion[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    motion[:3, 3] = translation_m
    return motion


def inverse_motion(a_from_b: Float64) -> Float64:
    """(4, 4) b_from_a of a rigid a_from_b."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = a_from_b[:3, :3].T
    b_from_a[:3, 3] = -a_from_b[:3, :3].T @ a_from_b[:3, 3]
    return b_from_a


def up_from_travel(world_from_camera: Float64) -> Float64:
    """(3,) unit vector against gravity, from the poses (T, 4, 4) of a forward-facing camera.

    A camera on a car is level across the road but may nod; the car drives along the road. Each
    camera's -y axis is made perpendicular to the mean direction of travel in camera axes, and the
    results are averaged. Where the clip travels less than a metre, the -y axes are averaged as
    they are. On a slope the result is the road's normal.
    """
    rotations, centres = world_from_camera[:, :3, :3], world_from_camera[:, :3, 3]
    up_camera = np.array([0.0, -1.0, 0.0])
    steps = np.einsum("tji,tj->ti", rotations[:-1], np.diff(centres, axis=0))
    travel = steps.sum(axis=0)
    length = float(np.linalg.norm(travel))
    if length >= MIN_TRAVEL_M:
        forward = travel / length
        up_camera = up_camera - (up_camera @ forward) * forward
    up = np.einsum("tij,j->i", rotations, up_camera)
    return np.asarray(up / np.linalg.norm(up), np.float64)
