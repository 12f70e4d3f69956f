"""Velocities of a camera from its poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def velocities(times_s: Float64, world_from_camera: Float64) -> tuple[Float64, Float64]:
    """Linear and angular velocity of one camera at each of its T moments.

    Central differences, one-sided at the ends; zero for a clip of one frame.

    Args:
        times_s: (T,), strictly increasing.
        world_from_camera: (T, 4, 4).

    Returns:
        (T, 3) m/s in world axes and (T, 3) rad/s in camera axes.

    Source:
        reference formula: v = (C(t2) - C(t1)) / dt, w = log(R1^T R2) / dt.
    """
    count = len(times_s)
    linear, angular = np.zeros((count, 3)), np.zeros((count, 3))
    for index in range(count):
        before, after = max(index - 1, 0), min(index + 1, count - 1)
        step_s = times_s[after] - times_s[before]
        if step_s <= 0:
            continue
        first, last = world_from_camera[before], world_from_camera[after]
        linear[index] = (last[:3, 3] - first[:3, 3]) / step_s
        angular[index] = rotation_vector(first[:3, :3].T @ last[:3, :3]) / step_s
    return linear, angular


def rotation_vector(rotation: Float64) -> Float64:
    """Axis times angle (3,), radians, of a rotation matrix (3, 3); angles below pi."""
    skew = rotation - rotation.T
    sine_axis = 0.5 * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    sine = float(np.linalg.norm(sine_axis))
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    if sine < 1e-12:
        return sine_axis
    vector: Float64 = sine_axis * (np.arctan2(sine, cosine) / sine)
    return vector
