"""Lamps of vehicles on a finished picture: a small disc, the lens' glow, a halo, a streak below.

Light is added in linear light after everything else has been drawn. A lamp of intensity I (cd) at
distance d gives the camera I / d^2 lux; a pixel takes in 1 / (fx fy) sr, so the values it adds over
all pixels sum to I fx fy / d^2 over the luminance of white. The disc itself is far brighter than
white and stays white however far away it is; fog takes from it exp(-tau) and gives back a halo.

Source:
    Narasimhan and Nayar (2003) for the halo's shape; docs/physics.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, like_image
from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.clip.types import Camera
from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical.fresnel import fresnel
from weather_aug.edit.physical.vehicles import Vehicle
from weather_aug.render.lamp_light import HALO_AREA, HALO_EXPONENT, SeenLamp

Float64 = NDArray[np.float64]

HORIZON_CD_PER_M2 = 2000.0
"""Luminance of the airlight under a closed sky by day: 1e4 lx of horizontal illuminance are 3200
over a half space, and the horizon is darker than the zenith."""
HEAD_LAMP_CD, TAIL_LAMP_CD = 500.0, 6.0
"""Towards who comes: a dipped head lamp above its cut-off, a tail lamp (UN R112, R7: at most 438 to
1000 cd in the zones of glare, 4 to 17 cd)."""
HEAD_LAMP_COLOUR, TAIL_LAMP_COLOUR = (1.06, 1.0, 0.82), (1.0, 0.035, 0.02)
"""Linear RGB, scaled to a luminance of 1 where they are used."""
LAMP_DIAMETER_M = 0.15
HEAD_LAMP_HEIGHT_M, TAIL_LAMP_HEIGHT_M = 0.65, 0.85
HEAD_LAMP_NEAR_M, TAIL_LAMP_NEAR_M = 6.0, 14.0
"""Nearer than this a lamp fades, to nothing at half of it: the recorded vehicle's own lamps are
then seen so well that a disc a hand's breadth beside them looks wrong."""
INSET_M = 0.28
"""From the vehicle's side to the middle of the lamp."""
LENS_SIGMA_PX = 0.7
GLOW_SHARE, GLOW_RAD = 0.04, 0.0035
"""Share of the light that the lens spreads, and how far."""
FORWARD_SHARE = 0.85
"""Of the light that fog scatters, what goes on almost as before."""
HALO_RAD_PER_TAU, HALO_LEAST_RAD = 0.005, 0.002
FAINTEST = 2e-4
"""Linear light at which a profile is cut; the first level of a black pixel is 3e-4."""
LARGEST_REACH_PX = 500.0
OCCLUSION_M, OCCLUSION_RAMP_M = 0.7, 0.3
"""What is nearer than the lamp by more than the first hides it, by the second around that less and
less: no lamp is switched on from one frame to the next."""
MOST_DEPTH_TAU = 20.0
ROUGHNESS = 0.1
"""Root mean square slope of a wet road in the rain."""
ROAD_CD = 1000.0
"""Of a dipped head lamp towards the road before it, which the film mirrors."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A lamp on a vehicle, in the world; the same for every camera."""

    position_world: Float64
    """(3,) metres."""
    facing_world: Float64
    """(3,) unit vector out of the vehicle."""
    up_world: Float64
    """(3,) unit vector."""
    height_m: float
    """Over the road."""
    colour: Float64
    """(3,) linear RGB of luminance 1."""
    intensity_cd: float
    """Towards the camera, straight ahead."""
    road_intensity_cd: float
    """Towards the road before it."""
    near_m: float
    """Nearer than this it fades."""


def lamps_of(
    vehicles: Sequence[Vehicle], share: float, seed: int, up_world: Float64
) -> tuple[Lamp, ...]:
    """Head and tail lamps of those vehicles that drive with lamps on; two and two.

    Args:
        vehicles: Around a camera; who is parked has none.
        share: Of the vehicles that drive with lamps on, in [0, 1] (`Weather.lamps`); a greater one
            adds vehicles and takes none away.
        seed: Which vehicles; drawn by each vehicle's own key.
        up_world: (3,) unit vector.

    Raises:
        ArgumentError: If the share is out of range, or the seed is no integer.
    """
    share, seed = finite("share", share, 0.0, 1.0), check_seed("seed", seed)
    lamps = []
    for vehicle in vehicles:
        draw = float(uniforms(key_of("vehicle-lamps", seed, vehicle.key), 1)[0])
        if not vehicle.parked and draw < share:
            lamps += _lamps_on(vehicle, np.asarray(up_world, np.float64))
    return tuple(lamps)


def _lamps_on(vehicle: Vehicle, up: Float64) -> list[Lamp]:
    length, width, _ = vehicle.size_m
    ahead = vehicle.heading_world
    left = np.cross(up, ahead)
    ends = (
        (1.0, HEAD_LAMP_HEIGHT_M, HEAD_LAMP_COLOUR, HEAD_LAMP_CD, ROAD_CD, HEAD_LAMP_NEAR_M),
        (-1.0, TAIL_LAMP_HEIGHT_M, TAIL_LAMP_COLOUR, TAIL_LAMP_CD, TAIL_LAMP_CD, TAIL_LAMP_NEAR_M),
    )
    lamps = []
    for end, height_m, tint, *powers in ends:
        colour = np.array(tint) / float(np.array(tint) @ LUMINANCE)
        for side in (1.0, -1.0):
            offset = 0.5 * end * length * ahead + side * (0.5 * width - INSET_M) * left
            place = vehicle.centre_world + offset + height_m * up
            lamps.append(Lamp(place, end * ahead, up, height_m, colour, *powers))
    return lamps


def seen_lamps(
    lamps: Sequence[Lamp],
    camera: Camera,
    depth_m: NDArray[Any],
    *,
    extinction_per_m: float,
    wetness: float,
    airlight: Float64,
    camera_height_m: float,
) -> tuple[SeenLamp, ...]:
    """Lamps that face a camera and that nothing hides, as they are drawn on its picture.

    Args:
        lamps: In the world.
        camera: Of the whole picture.
        depth_m: (H, W) z-depth of the whole picture, metres; only a few pixels are read.
        extinction_per_m: Of the air along the way, 1/m, at least 0.
        wetness: Of the road, in [0, 1].
        airlight: (3,) linear RGB; its luminance says how bright the day is to the camera.
        camera_height_m: Over the road, metres.

    Raises:
        ArgumentError: If an argument is out of range, or the depth has not the camera's shape.
    """
    like_image("depth_m", depth_m, (camera.height, camera.width))
    extinction_per_m = finite("extinction_per_m", extinction_per_m, 0.0)
    wetness = finite("wetness", wetness, 0.0, 1.0)
    camera_height_m = finite("camera_height_m", camera_height_m, 0.1, 10.0)
    white_per_cd = float(np.asarray(airlight, np.float64) @ LUMINANCE) / HORIZON_CD_PER_M2
    seen = []
    for lamp in lamps:
        shown = _seen(
            lamp, camera, depth_m, extinction_per_m, wetness, white_per_cd, camera_height_m
        )
        if shown is not None:
            seen.append(shown)
    return tuple(seen)


def _seen(
    lamp: Lamp,
    camera: Camera,
    depth_m: NDArray[Any],
    extinction_per_m: float,
    wetness: float,
    white_per_cd: float,
    camera_height_m: float,
) -> SeenLamp | None:
    away = camera.centre_world - lamp.position_world
    distance_m = float(np.linalg.norm(away))
    x, y, z = (-away @ camera.world_from_camera[:3, :3]).tolist()
    if z < 0.5:
        return None
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    u, v = cx + fx * x / z, cy + fy * y / z
    facing = float(away @ lamp.facing_world) / distance_m
    aim = _ramp(facing, 0.05, 0.9) * _ramp(distance_m, 0.5 * lamp.near_m, lamp.near_m)
    tau = min(extinction_per_m * distance_m, MOST_DEPTH_TAU)
    radius_px = 0.5 * LAMP_DIAMETER_M * fx / z
    light = aim * white_per_cd * lamp.intensity_cd * fx * fy / distance_m**2
    halo_px = fx * (HALO_LEAST_RAD + HALO_RAD_PER_TAU * tau)
    outside = max(-u, -v, u - camera.width + 1, v - camera.height + 1)
    if light <= 0.0 or outside > LARGEST_REACH_PX:
        return None
    light *= _unhidden(depth_m, u, v, z, max(radius_px, 1.0))
    if light <= 0.0:
        return None
    direct, forward = math.exp(-tau), math.exp(-(1.0 - FORWARD_SHARE) * tau)
    # A disc of radius r has the variance r^2 / 4 along each axis.
    variance_px2 = 0.25 * radius_px**2 + LENS_SIGMA_PX**2
    core, glow = light * direct * (1.0 - GLOW_SHARE), light * direct * GLOW_SHARE
    halo = light * (forward - direct)
    reach = max(
        _core_reach_px(core, variance_px2),
        _halo_reach_px(glow, GLOW_RAD * fx),
        _halo_reach_px(halo, halo_px),
    )
    if reach <= 0.0 or outside > reach:
        return None
    streak = _streak(lamp, camera, distance_m, camera_height_m)
    mirrored = lamp.road_intensity_cd / lamp.intensity_cd * wetness * streak.reflectance
    values = (
        u,
        v,
        variance_px2,
        core,
        glow,
        GLOW_RAD * fx,
        halo,
        halo_px,
        reach,
        streak.u,
        streak.v,
        streak.foot_v,
        light * forward * mirrored,
        math.hypot(streak.across_px, radius_px, LENS_SIGMA_PX),
        math.hypot(streak.down_px, radius_px, LENS_SIGMA_PX),
        *lamp.colour,
    )
    return SeenLamp(*(np.float32(value) for value in values))


def _core_reach_px(light: float, variance_px2: float) -> float:
    """Where a Gaussian of this light falls to the faintest that counts, pixels."""
    peak = light / (2.0 * math.pi * variance_px2 * FAINTEST)
    return math.sqrt(2.0 * variance_px2 * math.log(peak)) if peak > 1.0 else 0.0


def _halo_reach_px(light: float, radius_px: float) -> float:
    """Where a halo of this light falls to the faintest that counts, pixels."""
    peak = light / (HALO_AREA * radius_px**2 * FAINTEST)
    reach = radius_px * math.log(peak) ** (1.0 / HALO_EXPONENT) if peak > 1.0 else 0.0
    return min(reach, LARGEST_REACH_PX)


def _ramp(value: float, low: float, high: float) -> float:
    """0 up to `low`, 1 from `high` on, smooth between."""
    t = min(max((value - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


def _unhidden(depth_m: NDArray[Any], u: float, v: float, z: float, radius_px: float) -> float:
    """Share of nine places on a lamp that nothing nearer hides."""
    steps = (-0.7 * radius_px, 0.0, 0.7 * radius_px)
    rows = [min(max(round(v + step), 0), depth_m.shape[0] - 1) for step in steps]
    columns = [min(max(round(u + step), 0), depth_m.shape[1] - 1) for step in steps]
    found = depth_m[np.ix_(rows, columns)].astype(np.float64)
    nearer = np.where(found > 0, z - found, -np.inf)
    return float(
        np.mean(
            [
                1.0 - _ramp(by, OCCLUSION_M - OCCLUSION_RAMP_M, OCCLUSION_M + OCCLUSION_RAMP_M)
                for by in nearer.ravel().tolist()
            ]
        )
    )


class _Streak(NamedTuple):
    """Where a wet road mirrors a lamp."""

    u: float
    v: float
    foot_v: float
    reflectance: float
    across_px: float
    down_px: float


def _streak(lamp: Lamp, camera: Camera, distance_m: float, camera_height_m: float) -> _Streak:
    """The image of a lamp in the plane of the road, smeared by the road's slopes.

    Source:
        Mirror images seen at a grazing angle g in waves of slope m are smeared by 2 m f times the
        share of the way behind the mirror, across by sin g less.
    """
    fx, fy = camera.focal_px
    mirror = _pixel(camera, lamp.position_world - 2.0 * lamp.height_m * lamp.up_world)
    foot = _pixel(camera, lamp.position_world - lamp.height_m * lamp.up_world)
    grazing_rad = math.atan2(camera_height_m + lamp.height_m, distance_m)
    behind = lamp.height_m / (lamp.height_m + camera_height_m)
    down_px = 2.0 * ROUGHNESS * fy * behind
    across_px = math.sin(grazing_rad) * down_px * fx / fy
    return _Streak(*mirror, foot[1], float(fresnel(grazing_rad)), across_px, down_px)


def _pixel(camera: Camera, point_world: Float64) -> tuple[float, float]:
    x, y, z = ((point_world - camera.centre_world) @ camera.world_from_camera[:3, :3]).tolist()
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return cx + fx * x / max(z, 0.1), cy + fy * y / max(z, 0.1)
