"""The particle settings that WeatherEdit published, as data.

Convention:
    A preset's x, y and z are the axes of the release's box: "right-forward-up" for Waymo and
    PandaSet, "right-down-forward" for nuScenes, about the first pose of the vehicle's reference
    camera. Lengths are metres, angles radians, opacities and greys in [0, 1] (greys are sRGB).
    One preset per weather: the release knows no light, moderate or heavy.

    What the release does and we keep: the falling speed is one number per frame for all particles,
    the tilt of a streak is not the direction it falls in, the fog's opacity grows with the depth
    (so that its optical depth grows with the square; it is not Koschmieder's law, and ends with the
    box), and the nuScenes box reaches 45 m below the camera and only 15 m above it, so that most of
    it is inside the ground. What we do not keep is named in `PublishedField`.

Source:
    Qian et al., "WeatherEdit: Controllable Weather Editing with 4D Gaussian Field", and the values
    of its public release. The paper's text gives no numbers; where the release is silent on a
    meaning we chose the one in which rain points along the tilted vertical, in the picture's plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from weather_aug.errors import ArgumentError

Vector = tuple[float, float, float]

BOX_AXES = {
    "right-forward-up": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "right-down-forward": ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),
}
"""By name, the box's x, y and z as (along, left, up)."""

_DATASETS = {"waymo": "waymo", "pandaset": "waymo", "nuscenes": "nuscenes"}
"""Block of settings of each data set; the release gives Waymo and PandaSet the same."""


@dataclass(frozen=True)
class PublishedPreset:
    """One weather of one data set; see the module's Convention."""

    dataset: str
    weather: str
    count: int
    """Particles in the box."""
    axes: str
    """A name of `BOX_AXES`."""
    box_low_m: Vector
    box_high_m: Vector
    fall_m_per_frame: float
    """Of the front camera; the release has no time step."""
    opacity_mean: float
    opacity_std: float
    """Draws outside [0, 1] (0.6 % of snow at either end) are clamped by us, not by the release."""
    scale_mean_m: Vector
    """Standard deviations of a particle's Gaussian, along x, y and z before its tilt."""
    scale_std_m: Vector
    """Draws below 0 (16 % of the y of Waymo's rain) are harmless: scales count by their square."""
    y_multipliers: Vector
    """Factors on the drawn y-scale of the first, second and last third of the particles."""
    tilt_axis: str
    """"x", "y" or "z": a particle turns about it, right-handed; the tilt of fog is 0."""
    tilt_mean_rad: float
    tilt_std_rad: float
    grey_srgb: float
    opacity_per_size: float = 0.0
    """Above 0 (fog: 0.1) the opacity is 1 - exp(-this max(forward, 2 |x|) / `size_m`) instead, of
    the position at time 0."""

    @property
    def size_m(self) -> float:
        """The release's s: width of the box, to which the fog's opacity refers."""
        return self.box_high_m[0] - self.box_low_m[0]

    @property
    def extent_m(self) -> Vector:
        """Sides of the box."""
        (x0, y0, z0), (x1, y1, z1) = self.box_low_m, self.box_high_m
        return x1 - x0, y1 - y0, z1 - z0

    @property
    def density_per_m3(self) -> float:
        """Particles per volume of the box."""
        return self.count / math.prod(self.extent_m)

    @property
    def forward_axis(self) -> int:
        """Which of the box's axes points ahead."""
        return ("x", "y", "z").index("y" if self.axes == "right-forward-up" else "z")

    @property
    def vertical_axis(self) -> int:
        """Which of the box's axes is vertical."""
        return 3 - self.forward_axis

    def without_attributes(self) -> PublishedPreset:
        """The paper's ablation without attribute modelling: every particle is the same blob.

        One isotropic size (the geometric mean over axes and thirds, which keeps the volume), no
        tilt, and the mean opacity. The release has no code for it; this reading is ours.
        """
        volume = math.prod(self.scale_mean_m) * math.prod(self.y_multipliers) ** (1 / 3)
        size_m = volume ** (1 / 3)
        return replace(
            self,
            opacity_mean=self._mean_opacity(),
            opacity_std=0.0,
            scale_mean_m=(size_m,) * 3,
            scale_std_m=(0.0, 0.0, 0.0),
            y_multipliers=(1.0, 1.0, 1.0),
            tilt_mean_rad=0.0,
            tilt_std_rad=0.0,
            opacity_per_size=0.0,
        )

    def _mean_opacity(self) -> float:
        if self.opacity_per_size == 0.0:
            return self.opacity_mean
        middles = (np.arange(512) + 0.5) / 512
        low, extent, k = self.box_low_m, self.extent_m, self.forward_axis
        forward_m = low[k] + extent[k] * middles
        aside_m = low[0] + extent[0] * middles
        depth_m = np.maximum(forward_m[:, None], 2 * np.abs(aside_m))
        return float(-np.expm1(-self.opacity_per_size * depth_m / self.size_m).mean())


def published_preset(dataset: str, weather: str) -> PublishedPreset:
    """The release's settings of one data set and weather.

    Args:
        dataset: "waymo", "pandaset" (the same) or "nuscenes".
        weather: "rain", "snow" or "fog".

    Raises:
        ArgumentError: If either is another name.
    """
    if dataset not in _DATASETS:
        raise ArgumentError(f"dataset must be one of {', '.join(_DATASETS)}, got {dataset!r}")
    block = {p.weather: p for p in PUBLISHED_PRESETS if p.dataset == _DATASETS[dataset]}
    if weather not in block:
        raise ArgumentError(f"weather must be one of {', '.join(block)}, got {weather!r}")
    return block[weather]


_WAYMO = PublishedPreset(
    dataset="waymo",
    weather="rain",
    count=100_000,
    axes="right-forward-up",
    box_low_m=(-20.0, -20.0, -5.0),
    box_high_m=(20.0, 60.0, 35.0),
    fall_m_per_frame=0.3,
    opacity_mean=0.2,
    opacity_std=0.001,
    scale_mean_m=(0.005, 0.001, 0.06),
    scale_std_m=(0.001, 0.001, 0.001),
    y_multipliers=(1.0, 2.0, 4.0),
    tilt_axis="y",
    tilt_mean_rad=0.4,
    tilt_std_rad=0.1,
    grey_srgb=0.7,
)
_NUSCENES = replace(
    _WAYMO,
    dataset="nuscenes",
    count=200_000,
    axes="right-down-forward",
    box_low_m=(-23.0, -15.0, -30.0),
    box_high_m=(37.0, 45.0, 30.0),
    scale_mean_m=(0.005, 0.02, 0.01),
    tilt_axis="z",
)


def _snow(rain: PublishedPreset, count: int, fall_m_per_frame: float) -> PublishedPreset:
    return replace(
        rain,
        weather="snow",
        count=count,
        fall_m_per_frame=fall_m_per_frame,
        opacity_mean=0.5,
        opacity_std=0.2,
        scale_mean_m=(0.006, 0.004, 0.01),
        y_multipliers=(3.0, 4.0, 6.0),
        tilt_std_rad=0.2,
        grey_srgb=0.85,
    )


def _fog(rain: PublishedPreset) -> PublishedPreset:
    return replace(
        rain,
        weather="fog",
        count=200_000,
        fall_m_per_frame=0.0,
        opacity_mean=0.0,
        opacity_std=0.0,
        scale_mean_m=(0.7, 0.7, 0.7),
        scale_std_m=(0.0, 0.0, 0.0),
        y_multipliers=(1.0, 1.0, 1.0),
        tilt_mean_rad=0.0,
        tilt_std_rad=0.0,
        grey_srgb=0.65,
        opacity_per_size=0.1,
    )


PUBLISHED_PRESETS = (
    _WAYMO,
    _snow(_WAYMO, 200_000, 0.4),
    _fog(_WAYMO),
    _NUSCENES,
    _snow(_NUSCENES, 300_000, 0.3),
    _fog(_NUSCENES),
)
"""All that was published for driving scenes."""
