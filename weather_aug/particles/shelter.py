"""What the sky is open to: a map of covers (bridges, tunnels, roofs), and the particles it lets by.

Convention:
    A street's coordinates are world coordinates along the rows of `axes_world`: along, left, up. A
    particle is sheltered if its way back, up and against the wind, meets a cover from below. Only
    overhangs are in the map: what is inside or behind a wall, the depth of the scene hides.

Source:
    A height map of the surfaces that are open to the sky, looked up upstream of each particle, as
    renderers of games do; here of the undersides, because these are what a street camera sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._compiled import compiled, inlined
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError
from weather_aug.particles.resolve import FAR_M
from weather_aug.weather import Wind

CELL_M = 0.5
REACH_M = 15.0
"""How far upstream a particle's way is followed, metres along the ground."""
LEAST_FALL_M_PER_S = 0.05
"""What hovers or rises still came from above, slowly."""

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shelter:
    """Undersides over a street, on a grid of its ground; see the module's Convention.

    Raises:
        ArgumentError: If a shape is wrong, or a number is none (infinity means open sky).
    """

    cover_m: Float32
    """(A, L) height of the lowest underside over each cell, above `origin_m[2]`; inf: open sky."""
    origin_m: Float64
    """(3,) street coordinates of the corner of cell [0, 0], and of the height 0 of `cover_m`."""
    axes_world: Float64
    """(3, 3), rows: along the street, to the left, up."""
    cell_m: float = CELL_M
    """Side of a cell; the rows of `cover_m` go along the street, its columns to the left."""
    top_m: float = field(init=False)
    """Height of the highest underside, above `origin_m[2]`; -inf if there is none."""

    def __post_init__(self) -> None:
        finite("cell_m", self.cell_m, 0.01, 100.0)
        cover = np.array(self.cover_m, np.float32, order="C")
        origin = np.array(self.origin_m, np.float64)
        axes = np.array(self.axes_world, np.float64)
        if cover.ndim != 2 or np.isnan(cover).any() or (cover == -np.inf).any():
            raise ArgumentError(f"cover_m must be (A, L) heights or inf, got shape {cover.shape}")
        if origin.shape != (3,) or axes.shape != (3, 3):
            raise ArgumentError(
                f"origin_m must be (3,) and axes_world (3, 3), got {origin.shape} and {axes.shape}"
            )
        if not (np.isfinite(origin).all() and np.isfinite(axes).all()):
            raise ArgumentError("origin_m and axes_world must be finite")
        for name, array in (("cover_m", cover), ("origin_m", origin), ("axes_world", axes)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        covered = cover[np.isfinite(cover)]
        object.__setattr__(self, "top_m", float(covered.max()) if covered.size else -np.inf)

    @property
    def is_open(self) -> bool:
        """Whether the sky is open everywhere."""
        return self.top_m == -np.inf


def exposed(
    particles: Float32, camera: Camera, wind_m_per_s: Wind, shelter: Shelter | None
) -> Float32:
    """The particles that came from the open sky, in their order.

    The way back is straight: against the wind, and up at the particle's own rate of falling. The
    swaying of a flake goes both ways on its fall, so it is left out: a flake near the edge of a
    cover does not come and go.

    Args:
        particles: (N, 13) float32 records in camera axes; only position (0-2) and velocity relative
            to the camera's centre (3-5) are read.
        camera: Whose axes these are.
        wind_m_per_s: Wind along the street, to its left, up. Up is in the particles' velocities
            already.
        shelter: Map of covers; None if there is none.

    Returns:
        (M, 13) float32, M <= N; `particles` itself where no cover is near.
    """
    if shelter is None or shelter.is_open or len(particles) == 0:
        return particles
    centre_m = shelter.axes_world @ camera.centre_world - shelter.origin_m
    size_m = shelter.cell_m * np.array(shelter.cover_m.shape)
    beyond_m = np.maximum(-centre_m[:2], centre_m[:2] - size_m).max()
    # A depth of FAR_M lies farther off at the corners of a picture.
    corner = np.hypot(camera.width / camera.focal_px[0], camera.height / camera.focal_px[1])
    if beyond_m > FAR_M * (1.0 + corner) + REACH_M:
        return particles
    street_from_camera = shelter.axes_world @ camera.world_from_camera[:3, :3]
    scale = np.array([1 / shelter.cell_m, 1 / shelter.cell_m, 1.0])
    kept = np.empty_like(particles)
    count = keep_exposed(
        particles,
        (street_from_camera * scale[:, None]).astype(np.float32),
        (centre_m * scale).astype(np.float32),
        np.float32(shelter.axes_world[2] @ camera.velocity_m_per_s),
        np.float32(wind_m_per_s[0] / shelter.cell_m),
        np.float32(wind_m_per_s[1] / shelter.cell_m),
        shelter.cover_m,
        # A little above, so that the highest underside is passed for sure.
        np.float32(shelter.top_m + 0.01),
        np.float32(REACH_M / shelter.cell_m),
        np.float32(LEAST_FALL_M_PER_S),
        kept,
    )
    return kept[:count]


@compiled
def keep_exposed(
    particles: Float32,
    cells_from_camera: Float32,
    centre: Float32,
    camera_rise: np.float32,
    wind_x: np.float32,
    wind_y: np.float32,
    cover: Float32,
    top: np.float32,
    reach: np.float32,
    least_fall: np.float32,
    out: Float32,
) -> int:
    """Copy the particles that meet no cover; rows 0 and 1 of the map's frame are in cells.

    Args:
        particles: (N, 13).
        cells_from_camera: (3, 3) to (cells along, cells to the left, metres up).
        centre: (3,) of the camera, the same way.
        camera_rise: Upward velocity of the camera, m/s.
        wind_x: Wind along, cells/s.
        wind_y: Wind to the left, cells/s.
        cover: (A, L) undersides, metres up.
        top: Height that no underside reaches.
        reach: How far to follow, cells.
        least_fall: Least rate of falling, m/s.
        out: (N, 13).

    Returns:
        Number of rows written.
    """
    r = cells_from_camera
    speed = np.sqrt(wind_x * wind_x + wind_y * wind_y)
    longest = np.float32(np.inf)
    if speed > np.float32(0.0):
        longest = reach / speed
    rows, columns = np.float32(cover.shape[0]), np.float32(cover.shape[1])
    zero = np.float32(0.0)
    count = 0
    for n in range(particles.shape[0]):
        p = particles[n]
        z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + centre[2]
        kept = True
        if z < top:
            x = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + centre[0]
            y = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + centre[1]
            rise = r[2, 0] * p[3] + r[2, 1] * p[4] + r[2, 2] * p[5] + camera_rise
            fall = max(-rise, least_fall)
            end = min((top - z) / fall, longest)
            x1, y1 = x - wind_x * end, y - wind_y * end
            if max(x, x1) >= zero and min(x, x1) < rows and max(y, y1) >= zero:
                if min(y, y1) < columns:
                    kept = not _meets_cover(x, y, z, fall, wind_x, wind_y, end, cover)
        if kept:
            for k in range(particles.shape[1]):
                out[count, k] = p[k]
            count += 1
    return count


@inlined
def _meets_cover(
    x: np.float32,
    y: np.float32,
    z: np.float32,
    fall: np.float32,
    wind_x: np.float32,
    wind_y: np.float32,
    end: np.float32,
    cover: Float32,
) -> bool:
    """Whether the way back from (x, y, z) goes through an underside within `end` seconds.

    Between two covered cells the underside has a step, and the way may go through the step. What is
    still under a cover at the end of the way did not come from the sky.

    Source:
        Amanatides and Woo, A Fast Voxel Traversal Algorithm, 1987.
    """
    never = np.float32(np.inf)
    i, j = np.int64(np.floor(x)), np.int64(np.floor(y))
    step_i, step_j = np.int64(0), np.int64(0)
    next_i, next_j, each_i, each_j = never, never, never, never
    if wind_x != np.float32(0.0):
        each_i = np.float32(1.0) / abs(wind_x)
        ahead = x - np.float32(i)
        step_i = np.int64(-1)
        if wind_x < np.float32(0.0):
            ahead = np.float32(1.0) - ahead
            step_i = np.int64(1)
        next_i = ahead * each_i
    if wind_y != np.float32(0.0):
        each_j = np.float32(1.0) / abs(wind_y)
        ahead = y - np.float32(j)
        step_j = np.int64(-1)
        if wind_y < np.float32(0.0):
            ahead = np.float32(1.0) - ahead
            step_j = np.int64(1)
        next_j = ahead * each_j
    below = False
    height = z
    while True:
        leave = min(min(next_i, next_j), end)
        higher = z + fall * leave
        underside = never
        if 0 <= i < cover.shape[0] and 0 <= j < cover.shape[1]:
            underside = cover[i, j]
        if height >= underside:
            if below:
                return True
        else:
            if higher >= underside:
                return True
            below = bool(underside < never)
        if leave >= end:
            return below
        if next_i <= next_j:
            i += step_i
            next_i += each_i
        else:
            j += step_j
            next_j += each_j
        height = higher
