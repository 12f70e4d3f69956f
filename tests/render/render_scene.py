"""Small cameras and frames for the renderer's tests."""

import numpy as np

from weather_aug.clip.types import Camera, Frame, FrameKey

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation of a level camera that looks along the street (x), with z up."""


def make_camera(width=160, height=96, focal_px=None, velocity=(0.0, 0.0, 0.0), **kwargs):
    focal_px = focal_px or 0.75 * width
    pose = np.eye(4)
    pose[:3, :3] = FORWARD
    pose[:3, 3] = (0, 0, 1.5)
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    )
    kwargs = {"velocity_m_per_s": np.array(velocity, float)} | kwargs
    return Camera(intrinsics, pose, width, height, **kwargs)


def make_frame(camera, image, depth_m, label=None, time_s=1.0):
    shape = (camera.height, camera.width)
    image = np.broadcast_to(np.asarray(image, np.uint8), (*shape, 3)).copy()
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), shape).copy()
    return Frame(FrameKey(0, "front"), time_s, camera, image, label, depth)
