"""Severity: one scale in [0, 1] for all weather, and what each point on it means in units.

Convention:
    Light is 0.25, moderate 0.5, heavy 0.75, extreme 1. Between these stops every quantity is
    log-linear in the severity; below light it falls to 0 with the severity squared (fog extinction:
    with the severity), so that 0 is clear.

Source:
    Rates inside the classes of the American Meteorological Society and the Met Office; fog stops
    at the three levels of Foggy Cityscapes; see docs/physics.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from weather_aug._checks import finite, real
from weather_aug.errors import ArgumentError, printable

CONTRAST_THRESHOLD = 0.05
"""Contrast left at the meteorological optical range (World Meteorological Organization)."""

NAMED_SEVERITIES = {"light": 0.25, "moderate": 0.5, "heavy": 0.75, "extreme": 1.0}
MOST_RAIN_MM_PER_H = 400.0
MOST_SNOW_MM_PER_H = 50.0
LEAST_VISIBILITY_M = 1.0


@dataclass(frozen=True)
class Stops:
    """A quantity at light, moderate, heavy and extreme, and the power it falls with below light."""

    values: tuple[float, float, float, float]
    power_below: int = 2

    def at(self, s: float) -> float:
        """The quantity at severity `s` in [0, 1]."""
        if s <= 0.25:
            return self.values[0] * (4 * s) ** self.power_below
        lower = min(int(4 * s) - 1, 2)
        a, b = self.values[lower], self.values[lower + 1]
        return a * (b / a) ** (4 * s - 1 - lower)

    def severity_of(self, value: float) -> float:
        """The inverse of `at`, cut at 1; needs strictly rising stops."""
        if value <= self.values[0]:
            return 0.25 * (value / self.values[0]) ** (1 / self.power_below)
        for lower in range(3):
            a, b = self.values[lower], self.values[lower + 1]
            if value <= b:
                return (1 + lower + math.log(value / a) / math.log(b / a)) / 4
        return 1.0


RAIN = {
    "rain_mm_per_h": Stops((1.5, 5.0, 20.0, 75.0)),
    "mist_per_km": Stops((0.2, 0.6, 2.0, 5.0)),
    "spray_per_km": Stops((0.5, 2.0, 10.0, 25.0)),
    "overcast": Stops((0.35, 0.8, 1.0, 1.0)),
    "gustiness": Stops((0.3, 0.3, 0.3, 0.3)),
    "wetness": Stops((0.5, 0.8, 1.0, 1.0)),
    "puddles": Stops((0.02, 0.06, 0.15, 0.30)),
    "lamps": Stops((0.3, 0.7, 1.0, 1.0)),
    "lens_drops": Stops((3.0, 10.0, 30.0, 80.0)),
    "wipers": Stops((0.2, 0.5, 0.8, 1.0)),
}
RAIN_WIND_M_PER_S = Stops((1.5, 3.0, 6.0, 10.0))
SNOW = {
    "snow_mm_per_h": Stops((0.4, 1.0, 2.0, 4.0)),
    "mist_per_km": Stops((0.3, 0.8, 2.0, 5.0)),
    "overcast": Stops((0.35, 0.8, 1.0, 1.0)),
    "gustiness": Stops((0.25, 0.25, 0.25, 0.25)),
    "wetness": Stops((0.4, 0.6, 0.7, 0.7)),
    "snow_cover": Stops((0.1, 0.6, 0.9, 1.0)),
    "road_snow_cover": Stops((0.02, 0.2, 0.5, 0.9)),
    "snow_depth_m": Stops((0.01, 0.03, 0.08, 0.20)),
    "lamps": Stops((0.3, 0.7, 1.0, 1.0)),
    "lens_drops": Stops((1.0, 2.0, 5.0, 10.0)),
    "wipers": Stops((0.1, 0.2, 0.4, 0.6)),
}
SNOW_WIND_M_PER_S = Stops((0.5, 1.0, 2.0, 4.0))
FOG = {
    "overcast": Stops((0.35, 0.8, 1.0, 1.0)),
    "wetness": Stops((0.1, 0.2, 0.3, 0.4)),
    "lamps": Stops((0.5, 0.8, 1.0, 1.0)),
}
FOG_WIND_M_PER_S = Stops((0.5, 0.5, 0.5, 0.5))
FOG_PER_M = Stops((0.005, 0.01, 0.02, 0.06), power_below=1)
_FOG_INVERSE_HEIGHT = (0.0, 0.0, 1 / 60, 1 / 25)
FALLING = ("rain_mm_per_h", "snow_mm_per_h", "mist_per_km", "spray_per_km", "lens_drops", "wipers")
"""What ends when it stops falling; the ground and the sky stay as they are."""


def rain_severity(mm_per_h: float) -> float:
    """Severity in [0, 1] of a rain rate; the inverse of `Weather.rain` up to extreme."""
    return RAIN["rain_mm_per_h"].severity_of(finite("mm_per_h", mm_per_h, 0, MOST_RAIN_MM_PER_H))


def snow_severity(mm_per_h: float) -> float:
    """Severity in [0, 1] of a liquid-equivalent snow rate."""
    return SNOW["snow_mm_per_h"].severity_of(finite("mm_per_h", mm_per_h, 0, MOST_SNOW_MM_PER_H))


def fog_severity(visibility_m: float) -> float:
    """Severity in [0, 1] of a meteorological optical range in metres."""
    visibility_m = real("visibility_m", visibility_m)
    if visibility_m < LEAST_VISIBILITY_M:
        raise ArgumentError(f"visibility_m must be at least 1 m, got {visibility_m!r}")
    return FOG_PER_M.severity_of(-math.log(CONTRAST_THRESHOLD) / visibility_m)


def visibility_from_severity(s: float) -> float:
    """Meteorological optical range in metres of a fog severity in [0, 1]."""
    beta_per_m = FOG_PER_M.at(s)
    return -math.log(CONTRAST_THRESHOLD) / beta_per_m if beta_per_m else math.inf


def fog_scale_height_m(s: float) -> float:
    """Height over which fog of a severity in [0, 1] thins by a factor e, metres."""
    # Inverse heights, linear between the stops, because they are 0 at the light ones.
    position = max(4 * s - 1, 0.0)
    lower = min(int(position), 2)
    a, b = _FOG_INVERSE_HEIGHT[lower], _FOG_INVERSE_HEIGHT[lower + 1]
    inverse = a + (b - a) * (position - lower)
    return 1.0 / inverse if inverse else math.inf


def parse_severity(severity: float | str) -> float:
    """A severity in [0, 1] from a number or one of its names.

    Raises:
        ArgumentError: If it is neither.
    """
    if isinstance(severity, str):
        if severity not in NAMED_SEVERITIES:
            raise ArgumentError(
                f"severity {printable(severity)!r} is not one of {', '.join(NAMED_SEVERITIES)}, "
                "nor a number in [0, 1]"
            )
        return NAMED_SEVERITIES[severity]
    return finite("severity", severity, 0, 1)


def severity_from(
    severity: float | str | None, unit: str, value: float | None, inverse: Any
) -> float:
    """The severity given as such, or as a `value` in its `unit`; exactly one must be given."""
    if (severity is None) == (value is None):
        raise ArgumentError(f"give either a severity or {unit}")
    if severity is None:
        return float(inverse(value))
    try:
        return parse_severity(severity)
    except ArgumentError as error:
        raise ArgumentError(f"{error}; for a value in its unit write {unit}=...") from None
