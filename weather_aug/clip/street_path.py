"""Where the street runs, and how the car with the cameras drives along it.

The street's own coordinates are (station, offset): station is world x, offset is y minus the
height of the centre line at that x. The shear keeps everything in closed form; on curves this
gentle (slope below 0.25) it narrows the street by at most 3 %.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug._keys import key_of, uniforms

Float64 = NDArray[np.float64]

EGO_SPEED_M_PER_S = 9.0


class Section(NamedTuple):
    """The street across: offsets from the centre line, metres, the same on both sides."""

    lane_edge_m: float = 3.4
    cycle_edge_m: float = 4.8
    kerb_m: float = 7.0
    kerb_height_m: float = 0.12
    strip_inner_m: float = 7.45
    strip_outer_m: float = 8.65
    facade_m: float = 11.6
    crossing_period_m: float = 120.0
    crossing_phase_m: float = 52.0
    crossing_width_m: float = 4.0


class Curve(NamedTuple):
    """The centre line y(x): two sines."""

    wide_m: float
    wide_rad_per_m: float
    wide_phase_rad: float
    fine_m: float
    fine_rad_per_m: float
    fine_phase_rad: float


class Ego(NamedTuple):
    """The car with the cameras at one moment."""

    position_world: Float64
    """(3,) metres, on the road."""
    yaw_rad: float
    velocity_m_per_s: Float64
    """(3,) world axes."""
    yaw_rate_rad_per_s: float


def curve_of(seed: int) -> Curve:
    """Return the centre line of the street with this seed."""
    u = uniforms(key_of("street-curve", seed), 6)
    return Curve(
        wide_m=10.0 + 3.0 * u[0],
        wide_rad_per_m=2 * math.pi / (400.0 + 60.0 * u[1]),
        # The start lies near an inflection, so that the first metres look far down the street.
        wide_phase_rad=2 * math.pi * (0.20 + 0.10 * u[2]) + (math.pi if u[5] < 0.5 else 0.0),
        fine_m=0.8 + 0.6 * u[3],
        fine_rad_per_m=2 * math.pi / (170.0 + 40.0 * u[4]),
        fine_phase_rad=2 * math.pi * u[5],
    )


@compiled
def centre_y(curve: Curve, x: float) -> float:
    """Height y of the centre line at x, metres."""
    wide = curve.wide_m * math.sin(curve.wide_rad_per_m * x + curve.wide_phase_rad)
    return wide + curve.fine_m * math.sin(curve.fine_rad_per_m * x + curve.fine_phase_rad)


@compiled
def centre_slope(curve: Curve, x: float) -> float:
    """Slope dy/dx of the centre line at x."""
    wide = curve.wide_m * curve.wide_rad_per_m
    fine = curve.fine_m * curve.fine_rad_per_m
    return wide * math.cos(curve.wide_rad_per_m * x + curve.wide_phase_rad) + fine * math.cos(
        curve.fine_rad_per_m * x + curve.fine_phase_rad
    )


def centre_bend(curve: Curve, x: float) -> float:
    """Second derivative of the centre line at x, 1/m."""
    wide = curve.wide_m * curve.wide_rad_per_m**2
    fine = curve.fine_m * curve.fine_rad_per_m**2
    return -wide * math.sin(curve.wide_rad_per_m * x + curve.wide_phase_rad) - fine * math.sin(
        curve.fine_rad_per_m * x + curve.fine_phase_rad
    )


def ego_at(curve: Curve, time_s: float) -> Ego:
    """Return pose and exact velocities of the ego car: constant dx/dt, a gentle sway in lane."""
    sway_m, sway_rad_per_s = 0.25, 0.7
    x, vx = EGO_SPEED_M_PER_S * time_s, EGO_SPEED_M_PER_S
    phase = sway_rad_per_s * time_s
    y = centre_y(curve, x) - 1.7 + sway_m * math.sin(phase)
    vy = centre_slope(curve, x) * vx + sway_m * sway_rad_per_s * math.cos(phase)
    ay = centre_bend(curve, x) * vx * vx - sway_m * sway_rad_per_s**2 * math.sin(phase)
    return Ego(
        position_world=np.array([x, y, 0.0]),
        yaw_rad=math.atan2(vy, vx),
        velocity_m_per_s=np.array([vx, vy, 0.0]),
        # d/dt atan(vy / vx) at constant vx.
        yaw_rate_rad_per_s=ay * vx / (vx * vx + vy * vy),
    )
