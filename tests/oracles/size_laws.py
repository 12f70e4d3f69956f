"""Size laws, and what of them a camera draws, by quadrature in float64.

Shares no code with the package but the classes' edges and speeds and the fades' limits, which are
conventions of the field and no laws.
"""

from itertools import pairwise

import numpy as np
from scipy import stats

from weather_aug.particles import statistics
from weather_aug.particles.resolve import FAR_M, NEAR_FULL_M, NEAR_M

EDGES_MM = {"rain": statistics.RAIN_EDGES_MM, "snow": statistics.SNOW_EDGES_MM}
LARGEST_MM = 6.0
"""Of water: where the laws of drops and of melted flakes end."""


def number(kind, rate, d_mm):
    """Particles per m3 and mm: Marshall and Palmer (1948); Gunn and Marshall (1958), melted."""
    if kind == "rain":
        return 8000 * np.exp(-4.1 * rate**-0.21 * d_mm)
    return 3800 * rate**-0.87 * np.exp(-2.55 * rate**-0.48 * d_mm)


def diameter_mm(kind, d_mm):
    """Of the particle: a drop is what it melts to, a flake has the density 0.17 / D g/cm3."""
    return d_mm if kind == "rain" else np.sqrt(d_mm**3 / 0.17)


def geometric_extinction_per_m(kind, rate):
    """Silhouette area per volume: the law of drops by quadrature, Rasmussen's line for snow."""
    if kind == "snow":
        return 2.451e-3 * rate
    d = np.linspace(0, LARGEST_MM, 60_001)
    return np.trapezoid(number(kind, rate, d) * np.pi / 4 * d**2 * 1e-6, d)


def law_extinction_per_m(kind, rate):
    """The same by quadrature over the size law of either kind."""
    d = np.linspace(0, LARGEST_MM, 60_001)
    area = np.pi / 4 * diameter_mm(kind, d) ** 2 * 1e-6
    return np.trapezoid(number(kind, rate, d) * area, d)


def sizes(kind, rate):
    """(weight, D in m) of each class, on Gauss-Legendre nodes: the law, not the sixteen sizes."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    found = []
    for low, high in pairwise(EDGES_MM[kind]):
        d = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        weight = 0.5 * (high - low) * weights * number(kind, rate, d)
        found.append((weight, diameter_mm(kind, d) * 1e-3))
    return found


def streaks_m(population, camera):
    """(C,) path across the line of sight while the shutter is open, averaged over the picture."""
    velocity = -population.fall_speed_m_per_s[:, None] * (1 + population.wetness) * [0, 0, 1.0]
    relative = (velocity - camera.velocity_m_per_s) @ camera.world_from_camera[:3, :3]
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    lengths = []
    for u in np.linspace(0, camera.width, 7):
        for v in np.linspace(0, camera.height, 7):
            across = relative[:, :2] - relative[:, 2:] * [(u - cx) / fx, (v - cy) / fy]
            lengths.append(np.hypot(*across.T))
    return np.mean(lengths, axis=0) * camera.exposure_s


def reach_m(diameter_m, streak_m, focal_px, alpha):
    """Depth where (pi/4) w^2 / (max(w, 1) max(l + w, 1)) falls to alpha (1 + z / 30), by search."""
    depth = np.geomspace(0.01, 400, 40_000)
    w, length = focal_px * diameter_m / depth, focal_px * streak_m / depth
    pixel = np.pi / 4 * w * w / (np.maximum(w, 1) * np.maximum(length + w, 1))
    above = depth[pixel >= alpha * (1 + depth / 30)]
    return above[-1] if len(above) else 0.0


def fade(depth_m, limit_m):
    """Opacity of a particle that fades in and out."""
    rise = np.clip((depth_m - NEAR_M) / (NEAR_FULL_M - NEAR_M), 0, 1)
    return rise * np.clip((limit_m - depth_m) / (0.15 * limit_m), 0, 1)


def abrupt(depth_m, limit_m):
    """Planted fault: particles that do not fade."""
    return ((depth_m > NEAR_M) & (depth_m < limit_m)).astype(float)


def arrived(mean):
    """Mean opacity of a cube's particles while the latest ones of it are still appearing."""
    width = 0.25 + 0.1 * mean
    count = np.arange(1, int(mean + 12 * np.sqrt(mean) + 40))
    f = (np.arange(400) + 0.5) / 400
    lost = np.maximum(0, 1 - (np.arange(40)[:, None] + f) / width).mean(axis=1)
    per_count = np.cumsum(lost)[np.minimum(count, 40) - 1]
    return 1 - (stats.poisson.pmf(count, mean) * per_count).sum() / mean


def _drawn_sizes(population, rate, camera, alpha, share=arrived):
    """(weight, D, limit) of every size that is drawn; `share` of a cube's mean count weighs it."""
    for streak, cell_m, (weights, diameters) in zip(
        streaks_m(population, camera),
        population.cell_m,
        sizes(population.kind, rate),
        strict=True,
    ):
        weights = weights * share(weights.sum() * cell_m**3)
        for weight, diameter in zip(weights, diameters, strict=True):
            limit = min(reach_m(diameter, streak, camera.focal_px[0], alpha), FAR_M)
            if limit > NEAR_FULL_M / 0.85:
                yield weight, diameter, limit


def drawn_optical_depth(population, rate, camera, alpha, depth_m, fade=fade):
    """Of what is drawn up to a depth on the axis."""
    depth = np.linspace(NEAR_M, depth_m, 1500)
    return sum(
        weight * np.pi / 4 * diameter**2 * np.trapezoid(fade(depth, limit), depth)
        for weight, diameter, limit in _drawn_sizes(population, rate, camera, alpha)
    )


def drawn_count(population, rate, camera, alpha):
    """Expected particles in the picture: N(D) dD times (W H / f^2) z^2 dz over what is drawn."""
    (fx, fy) = camera.focal_px
    solid = camera.width * camera.height / (fx * fy)
    return sum(
        weight * solid * (limit**3 - NEAR_M**3) / 3
        for weight, _, limit in _drawn_sizes(population, rate, camera, alpha, lambda mean: 1)
    )
