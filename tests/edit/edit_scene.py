"""A street for the editor's tests: road, kerb, grass, what stands on them and the sky, ray traced.

Its colours are anchored to the world, so that two cameras see the same street.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.dress import dress
from weather_aug.edit.physical.edit import edited, geometry_of
from weather_aug.edit.physical.layers import ILLUMINATION, NAMES, Layers, layers_of, thumbnail_of
from weather_aug.edit.physical.materials import MATERIALS, material_table
from weather_aug.edit.physical.site import site_of
from weather_aug.taxonomy import ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID
from weather_aug.weather import Weather

CAMERA_HEIGHT_M = 1.5
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation of a level camera that looks along x, with z up."""
BOXES = (
    ("car", (9.0, 13.0), (-3.6, -1.9), (0.0, 1.5)),
    ("person", (8.0, 8.4), (2.2, 2.8), (0.0, 1.75)),
    ("pole", (11.0, 11.2), (4.4, 4.6), (0.0, 6.0)),
    ("vegetation", (16.0, 20.0), (4.5, 8.0), (1.5, 6.0)),
    ("building", (14.0, 60.0), (-20.0, -8.0), (0.0, 7.0)),
    ("wall", (22.0, 50.0), (9.0, 9.5), (0.0, 1.6)),
)
"""Class and ranges of x (ahead), y (left) and z (up), metres."""
COLOURS = {
    "road": (96, 94, 92),
    "sidewalk": (140, 132, 126),
    "terrain": (92, 112, 62),
    "car": (150, 40, 36),
    "person": (60, 70, 120),
    "pole": (74, 78, 80),
    "vegetation": (54, 84, 40),
    "building": (170, 140, 110),
    "wall": (120, 110, 104),
    "sky": (150, 182, 226),
}
AMBIENCE = Ambience(
    np.eye(3),
    sky=np.array([0.30, 0.47, 0.76]),
    middle=np.full(3, 0.2),
    ground=np.full(3, 0.12),
    airlight=np.array([0.55, 0.56, 0.57]),
    camera_height_m=CAMERA_HEIGHT_M,
)
EFFECTS = ("relight", "sky", "film", "mirror", "puddles", "ripples", "snow_cover", "tracks")
DEEP = Weather(snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2)
ALL = Weather(
    rain_mm_per_h=10.0,
    wetness=0.8,
    puddles=0.3,
    snow_cover=0.5,
    road_snow_cover=0.4,
    snow_depth_m=0.05,
    overcast=0.7,
)
"""Some of everything."""
WEATHERS = {
    "overcast": Weather(overcast=0.8),
    "wet": Weather(wetness=0.9, overcast=0.6, rain_mm_per_h=8.0),
    "puddles": Weather(wetness=1.0, puddles=0.2, overcast=1.0),
    "light snow": Weather.snow("light", falling=False),
    "heavy snow": Weather.snow("heavy", falling=False),
}


@dataclass(frozen=True, eq=False)
class Street:
    """A camera in the street; angles in degrees, positive to the left, upwards and clockwise."""

    width: int = 128
    height: int = 80
    focal_px: float = 100.0
    place_m: tuple[float, float] = (0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    labelled: bool = True
    depth_type: type = np.float32
    boxes: tuple = BOXES
    road_half_m: float = 3.8
    ambience: Ambience = AMBIENCE

    @cached_property
    def camera(self):
        yaw, pitch, roll = np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg])
        turned = _turn(2, yaw) @ FORWARD @ _turn(0, pitch) @ _turn(2, roll)
        pose = np.eye(4)
        pose[:3, :3] = turned
        pose[:3, 3] = (*self.place_m, CAMERA_HEIGHT_M)
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        intrinsics = np.array(
            [[self.focal_px, 0, centre[0]], [0, self.focal_px, centre[1]], [0, 0, 1.0]]
        )
        return Camera(intrinsics, pose, self.width, self.height)

    @cached_property
    def frame(self):
        origin, rays = self.camera.centre_world, rays_of(self.camera)
        with np.errstate(divide="ignore"):
            depth = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
        aside = np.abs((origin + np.where(np.isfinite(depth), depth, 0)[..., None] * rays)[..., 1])
        label = np.select(
            [~np.isfinite(depth), aside < self.road_half_m, aside < self.road_half_m + 2.5],
            [SKY, ROAD, SIDEWALK],
            TERRAIN,
        )
        for name, *ranges in self.boxes:
            hit = _box_hit(origin, rays, np.array(ranges))
            label[hit < depth] = TRAIN_ID[name]
            depth = np.minimum(depth, hit)
        points = origin + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays
        return Frame(
            FrameKey(0, "front"),
            1.0,
            self.camera,
            _shared(_picture(label, points)),
            _shared(label.astype(np.uint8)) if self.labelled else None,
            _shared(depth.astype(self.depth_type)),
        )

    @cached_property
    def layers(self):
        return layers_of(site_of(self.frame, self.ambience.axes_world, CAMERA_HEIGHT_M))

    def edited(self, weather, window=None, without=()):
        """(H, W, 3) of a window, the whole picture if None."""
        whole = (0, 0, self.height, self.width)
        return edited(self.frame, self.layers, weather, self.ambience, window or whole, without)


def flat_street(level=96, *, width=256, height=160, focal_px=200.0, label=ROAD, **view):
    """A street of one class and one grey without end, and the sky."""
    street = Street(width, height, focal_px, boxes=(), road_half_m=1e4, **view)
    frame = street.frame
    ground = frame.label == ROAD
    image = np.where(ground[..., None], np.uint8(level), frame.image)
    label = np.where(ground, np.uint8(label), np.uint8(SKY))
    frame = Frame(frame.key, 1.0, frame.camera, image, label, frame.depth_m)
    # What is cached is what was drawn.
    street.__dict__["frame"] = frame
    return street


def plain_layers(street, *, step=4.0, illumination=None, **maps):
    """Layers by hand: no gains, no sky between leaves, a light on all of it; others by name."""
    camera = street.camera
    shape = int(-(-camera.height // step)), int(-(-camera.width // step))
    stack = np.zeros((len(NAMES), *shape), np.float16)
    named = {"illumination": 0.8 if illumination is None else illumination, "luminance": 0.2}
    named |= {"lateral_m": 30.0, "facing_up": 0.0} | maps
    for name, value in named.items():
        stack[NAMES.index(name)] = value
    plane = np.zeros(3)
    lit = float(np.median(stack[ILLUMINATION]))
    thumbnail = thumbnail_of(street.frame.image)
    no_tint = np.zeros(3, np.float32)
    return Layers(step, stack, no_tint, plane, street.frame.label, lit, thumbnail)


def painted(street, layers, weather, window=None, without=()):
    """(H, W, 3) of a window, with layers by hand."""
    whole = (0, 0, street.height, street.width)
    return edited(street.frame, layers, weather, street.ambience, window or whole, without)


def rays_of(camera):
    """(H, W, 3) world axes: what a metre of depth adds to the place of a surface."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
    return rays @ camera.world_from_camera[:3, :3].T


def points_of(frame):
    """(H, W, 3) world places of the surfaces; not finite in the sky."""
    depth = np.asarray(frame.depth_m, np.float64)
    with np.errstate(invalid="ignore"):
        return frame.camera.centre_world + depth[..., None] * rays_of(frame.camera)


def _turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return matrix


def _box_hit(origin, rays, ranges):
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    first, second = (ranges[:, 0] - origin) / rays, (ranges[:, 1] - origin) / rays
    enter = np.minimum(first, second).max(-1)
    leave = np.maximum(first, second).min(-1)
    return np.where((enter < leave) & (enter > 0.05), enter, np.inf)


def _picture(label, points):
    """(H, W, 3) sRGB: each class's colour, with a pattern of its place and one cast shadow."""
    table = np.zeros((256, 3))
    for name, colour in COLOURS.items():
        table[TRAIN_ID[name]] = colour
    waves = np.sin(points @ np.array([3.1, 2.3, 4.7])) * np.sin(points @ np.array([-1.7, 2.9, 0.9]))
    shadow = (np.abs(points[..., 0] - 7.0) < 1.0) & (points[..., 1] < 0.0)
    light = (1 + 0.12 * waves) * np.where(shadow, 0.55, 1.0)
    light = np.where(label == SKY, 1.0, light)
    return np.clip(table[label] * light[..., None], 0, 255).astype(np.uint8)


def _shared(array):
    array.flags.writeable = False
    return array


@cache
def street(**view):
    """One of each kind, so that it is drawn once."""
    return Street(**view)


def light(image):
    """Linear light of sRGB levels."""
    return SRGB_LEVELS_LINEAR[image]


def off(one, other):
    """(H, W) greatest difference of a channel, levels."""
    return np.abs(one.astype(int) - other).max(-1)


def with_material(name, **changes):
    """A table of materials with a fault in one class."""

    def wrong(*, labelled):
        table = material_table(labelled=labelled).copy()
        for field, value in changes.items():
            table[TRAIN_ID[name], MATERIALS[name]._fields.index(field)] = value
        table.flags.writeable = False
        return table

    return wrong


def with_geometry(**changes):
    """A camera's geometry with a fault."""

    def wrong(*args, **kwargs):
        found = geometry_of(*args, **kwargs)
        return found._replace(**{k: np.float32(f(getattr(found, k))) for k, f in changes.items()})

    return wrong


def with_layers(name, change):
    """The kernel with a fault in one layer, a function of (h, w) float16 and the window."""

    def wrong(surface, classes, window, *others):
        *between, layers, step, tile, out = others
        maps = layers.view(np.float16).copy()
        maps[NAMES.index(name)] = change(maps[NAMES.index(name)], window, step)
        bits = maps.view(np.uint16)
        bits.flags.writeable = False
        dress(surface, classes, window, *between, bits, step, tile, out)

    return wrong
