"""A procedural street seen by three cameras: exact depth, labels, normals and poses, no files.

The clip is for whatever needs to know the truth: a point of a wall has the same label and colour in
every frame and camera that sees it, up to what the pixel can resolve.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from weather_aug._checks import MAX_PIXELS
from weather_aug._keys import check_seed
from weather_aug.clip.street_draw import Canvas, Rig, fill
from weather_aug.clip.street_layout import CHUNK_M, SECTION, Actor, chunk
from weather_aug.clip.street_parts import joined
from weather_aug.clip.street_path import Ego, curve_of, ego_at
from weather_aug.clip.street_rays import World, world_of
from weather_aug.clip.street_surface import Looks, Setting
from weather_aug.clip.street_texture import noise_tile
from weather_aug.clip.street_traffic import movers
from weather_aug.clip.types import Box, Camera, Float64, Frame, FrameKey
from weather_aug.errors import ArgumentError, ClipError, printable

RATE_HZ = 10.0
EXPOSURE_S = 0.002
FIELD_OF_VIEW_RAD = math.radians(70.0)
BEHIND_M, AHEAD_M = 45.0, 400.0
BOX_RANGE_M = 120.0
SUN = (-0.42, 0.46, 0.785)
SUN_RADIUS_RAD = 0.011
"""Over twice the true one: thin haze widens the disc, and four rays show it better."""

CAMERAS = ("left", "front", "right")


class Mount(NamedTuple):
    """Where a camera sits on the car."""

    position_m: tuple[float, float, float]
    """Ahead, left, up."""
    yaw_rad: float
    """To the left."""


MOUNTS = {
    "left": Mount((1.35, 0.30, 1.6), math.radians(50.0)),
    "front": Mount((1.50, 0.0, 1.6), 0.0),
    "right": Mount((1.35, -0.30, 1.6), math.radians(-50.0)),
}


@dataclass(frozen=True)
class StreetClip:
    """A drive along a street that is made up from a seed; a `Clip`.

    Convention:
        World: x along the street, y left, z up, metres; the road is z = 0. The time step is 0.1 s,
        the ego car drives at 9 m/s. Two clips of one seed show the same street; a longer one drives
        farther. Label, depth and normals are those of the ray through the pixel centre; the image
        averages four rays. Boxes are those of vehicles, cyclists and walkers within 120 m whose
        hull reaches into the picture, hidden ones included. Leaves of trees are single surfaces:
        their labels and depths are as ragged as real ones.

    Raises:
        ArgumentError: If a size or count is out of range, or the seed is no integer.
    """

    frames: int = 24
    """Time steps, 1..10000."""
    width: int = 640
    """Pixels, 16..4096."""
    height: int = 360
    """Pixels, 16..4096."""
    seed: int = 0
    """Which street; any integer in [-2**63, 2**64)."""

    def __post_init__(self) -> None:
        for name, low, high in (("frames", 1, 10_000), ("width", 16, 4096), ("height", 16, 4096)):
            object.__setattr__(self, name, _whole(name, getattr(self, name), low, high))
        object.__setattr__(self, "seed", check_seed("seed", self.seed))
        if self.width * self.height > MAX_PIXELS:
            raise ArgumentError(f"{self.width}x{self.height} is more than {MAX_PIXELS} pixels")

    @property
    def name(self) -> str:
        """What the clip is called: street-<seed>."""
        return f"street-{self.seed}"

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, from left to right."""
        return CAMERAS

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of all frames, by time, then by camera."""
        return tuple(FrameKey(t, camera) for t in range(self.frames) for camera in CAMERAS)

    @property
    def up_world(self) -> Float64:
        """(3,) unit vector against gravity: z."""
        return np.array([0.0, 0.0, 1.0])

    def frame(self, key: FrameKey) -> Frame:
        """Draw one frame; see the class's Convention.

        Raises:
            ClipError: If the clip has no such frame.
        """
        time_index, name = self._checked(key)
        time_s = time_index / RATE_HZ
        ego = ego_at(curve_of(self.seed), time_s)
        camera = camera_at(ego, name, self.width, self.height)
        stage = _stage(self.seed, time_index)
        canvas = _drawn(stage, camera)
        for array in canvas:
            array.flags.writeable = False
        return Frame(
            key=FrameKey(time_index, name),
            time_s=time_s,
            camera=camera,
            image=canvas.image,
            label=canvas.label,
            depth_m=canvas.depth_m,
            normals_world=canvas.normals_world,
            boxes=tuple(_box(actor) for actor in stage.actors if _in_picture(actor, camera)),
        )

    def _checked(self, key: FrameKey) -> FrameKey:
        try:
            index, name = key
            known = name in CAMERAS and index == int(index) and 0 <= index < self.frames
        except (TypeError, ValueError, OverflowError):
            known = False
        if not known:
            raise ClipError(
                f"clip {self.name} has no frame {printable(key)}; it has time indices 0.."
                f"{self.frames - 1} of cameras {', '.join(CAMERAS)}"
            )
        return FrameKey(int(index), name)


def camera_at(ego: Ego, name: str, width: int, height: int) -> Camera:
    """Return one of the cameras of the ego car at a moment, with its exact velocities."""
    mount = MOUNTS[name]
    forward_yaw = ego.yaw_rad + mount.yaw_rad
    c, s = math.cos(forward_yaw), math.sin(forward_yaw)
    # Columns: right, down and forward of the camera in the world.
    rotation = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    ego_c, ego_s = math.cos(ego.yaw_rad), math.sin(ego.yaw_rad)
    ahead, left, up = mount.position_m
    lever = np.array([ego_c * ahead - ego_s * left, ego_s * ahead + ego_c * left, up])
    spin_world = np.array([0.0, 0.0, ego.yaw_rate_rad_per_s])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, ego.position_world + lever
    focal_px = 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW_RAD)
    return Camera(
        intrinsics=np.array(
            [
                [focal_px, 0.0, 0.5 * (width - 1)],
                # The horizon lies above the middle: more street, less sky.
                [0.0, focal_px, 0.46 * (height - 1)],
                [0.0, 0.0, 1.0],
            ]
        ),
        world_from_camera=pose,
        width=width,
        height=height,
        exposure_s=EXPOSURE_S,
        velocity_m_per_s=ego.velocity_m_per_s + np.cross(spin_world, lever),
        angular_velocity_rad_per_s=rotation.T @ spin_world,
    )


class _Stage(NamedTuple):
    world: World
    looks: Looks
    setting: Setting
    actors: tuple[Actor, ...]


@functools.lru_cache(maxsize=4)
def _stage(seed: int, time_index: int) -> _Stage:
    """Return everything that can be seen at a time; kept, because three cameras see it."""
    curve = curve_of(seed)
    time_s = time_index / RATE_HZ
    x = float(ego_at(curve, time_s).position_world[0])
    stations = (x - BEHIND_M, x + AHEAD_M)
    low, high = (math.floor(station / CHUNK_M) for station in stations)
    chunks = [chunk(seed, index) for index in range(low, high + 1)]
    actors = [actor for piece in chunks for actor in piece.actors]
    actors += movers(seed, curve, time_s, stations)
    parts = joined([*(piece.scenery for piece in chunks), *(actor.parts for actor in actors)])
    return _Stage(
        world=world_of(parts),
        looks=Looks(parts.material, parts.label, parts.look),
        setting=Setting(curve, SECTION, noise_tile(), _suns()),
        actors=tuple(actors),
    )


def _suns() -> Float64:
    """(4, 3) unit vectors to points around the middle of the sun's disc."""
    middle = np.array(SUN) / math.sqrt(sum(v * v for v in SUN))
    across = np.cross(middle, (0.0, 0.0, 1.0))
    over = np.cross(across, middle)
    turns = np.array([0.4, 2.0, 3.5, 5.1])
    ring = np.outer(np.cos(turns), across) + np.outer(np.sin(turns), over)
    suns: Float64 = middle + SUN_RADIUS_RAD * ring
    return suns / np.linalg.norm(suns, axis=1, keepdims=True)


def _drawn(stage: _Stage, camera: Camera) -> Canvas:
    shape = (camera.height, camera.width)
    canvas = Canvas(
        image=np.empty((*shape, 3), np.uint8),
        label=np.empty(shape, np.uint8),
        depth_m=np.empty(shape, np.float32),
        normals_world=np.empty((*shape, 3), np.float32),
    )
    rig = Rig(
        rotation=np.array(camera.world_from_camera[:3, :3]),
        centre=np.array(camera.centre_world),
        focal_px=camera.focal_px[0],
        principal_px=np.array(camera.principal_px),
    )
    fill(stage.world, stage.looks, stage.setting, rig, canvas)
    return canvas


def _box(actor: Actor) -> Box:
    pose = np.eye(4)
    c, s = math.cos(actor.yaw_rad), math.sin(actor.yaw_rad)
    pose[:2, :2] = [[c, -s], [s, c]]
    x, y, z = actor.position_world
    pose[:3, 3] = x, y, z + actor.size_m[2] / 2
    velocity = np.array(actor.velocity_m_per_s)
    return Box(actor.track_id, actor.class_name, pose, actor.size_m, velocity)


def _in_picture(actor: Actor, camera: Camera) -> bool:
    """Tell whether the actor's box, as eight corners, reaches into the view of the camera."""
    x, y, z = actor.position_world
    if math.dist((x, y), camera.centre_world[:2]) > BOX_RANGE_M:
        return False
    signs = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    corners_box = signs * actor.size_m
    c, s = math.cos(actor.yaw_rad), math.sin(actor.yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    corners = corners_box @ turn.T + (x, y, z + actor.size_m[2] / 2)
    points = (corners - camera.centre_world) @ camera.world_from_camera[:3, :3]
    points = points @ camera.intrinsics.T
    u, v, w = points.T
    # Outside only if all corners lie beyond one face of the frustum.
    beyond = (
        w < 0.1,
        u < -0.5 * w,
        u > (camera.width - 0.5) * w,
        v < -0.5 * w,
        v > (camera.height - 0.5) * w,
    )
    return not any(face.all() for face in beyond)


def _whole(name: str, value: int, low: int, high: int) -> int:
    try:
        number = value.__index__()
    except AttributeError:
        number = low - 1
    if isinstance(value, bool) or not low <= number <= high:
        raise ArgumentError(f"{name} must be an integer in {low}..{high}, got {printable(value)!r}")
    return number
