"""A camera that looks along x with z up, and fields in a steady wind."""

import numpy as np

from weather_aug.air import Air
from weather_aug.clip.types import Camera
from weather_aug.particles.field import ParticleField

AXES = np.eye(3)
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""world_from_camera rotation."""


def turn_z(yaw_deg):
    yaw = np.radians(yaw_deg)
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])


def camera(yaw_deg=0.0, centre=(0, 0, 1.5), speed=0.0, width=160, height=96, **kwargs):
    pose = np.eye(4)
    pose[:3, :3] = turn_z(yaw_deg) @ FORWARD
    pose[:3, 3] = centre
    focal = 0.75 * width
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    kwargs = {"velocity_m_per_s": np.array([speed, 0.0, 0.0])} | kwargs
    return Camera(intrinsics, pose, width, height, **kwargs)


def steady(wind, time_s, wet_s=0.0):
    """Air of a wind that has always blown."""
    return Air(tuple(wind), tuple(time_s * v for v in wind), wet_s)


def field(population, seed=1, wind=(0.0, 0.0, 0.0), time_s=0.0, **kwargs):
    return ParticleField(population, seed, steady(wind, time_s), AXES, **kwargs)


def seen(population, cam, time_s, resolved, seed=1, wind=(0.0, 0.0, 0.0)):
    """Particles of a steady wind in the whole picture."""
    return field(population, seed, wind, time_s).particles(cam, time_s, resolved, whole(cam))


def whole(cam):
    return (0, 0, cam.height, cam.width)


def world(particles, cam):
    pose = cam.world_from_camera
    return particles[:, :3].astype(float) @ pose[:3, :3].T + pose[:3, 3]


def inside(particles, cam):
    u = cam.focal_px[0] * particles[:, 0] / particles[:, 2] + cam.principal_px[0]
    v = cam.focal_px[1] * particles[:, 1] / particles[:, 2] + cam.principal_px[1]
    return (u >= -0.5) & (u < cam.width - 0.5) & (v >= -0.5) & (v < cam.height - 0.5)


def diameter(particles):
    """Diameter of balls, m."""
    return np.sqrt(8 * particles[:, 6].astype(float))


def nearest(points, others):
    """Distance of each point to the nearest of the others."""
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0]
