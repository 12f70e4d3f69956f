"""What a reconstructed drive knows of its street's geometry: reflections, surfaces, heights.

Pure functions of a `Reconstruction`. A road's plane is a point of it and its unit normal, up, both
in world axes and metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.clip.types import Camera, FrameKey
from weather_aug.edit.physical.mirror import BANK_M, BANK_PER_M
from weather_aug.edit.physical.mirror_seen import Seen, road_of, small_camera
from weather_aug.edit.physical.site import GROUND_TOLERANCE_M, GROUND_TOLERANCE_PER_M, Site
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.draw import view
from weather_aug.gaussians.gather import Gathered, gather
from weather_aug.gaussians.rasterise import rasterise
from weather_aug.gaussians.rotations import matrices_of
from weather_aug.gaussians.types import Gaussians, Pinhole, Reconstruction
from weather_aug.particles.shelter import CELL_M, Shelter
from weather_aug.scene.shelter import Points, shelter_of_points
from weather_aug.taxonomy import GROUND, SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_OPACITY = 0.5
"""A Gaussian that is less opaque stands for no surface."""
EXTENT_SIGMAS = 1.5
"""How far from its middle a Gaussian still stands for a surface, standard deviations."""
SAMPLE_M = 0.25
MOST_SAMPLES = 24
"""Along an axis of a Gaussian."""
RANGE_M = 40.0
"""From the nearest recorded camera; Gaussians farther off are large and vague."""


class Plane(NamedTuple):
    """A road's plane, world axes."""

    point_world: Float64
    """(3,), metres."""
    normal_world: Float64
    """(3,), of length 1, up."""

    def height_m(self, points_world: NDArray[np.floating]) -> Float64:
        """(N,) of points (N, 3) over the plane, metres."""
        return np.asarray((points_world - self.point_world) @ self.normal_world, np.float64)


@dataclass(frozen=True, eq=False)
class HeightMap:
    """The heights of a street's surfaces on a grid of its ground; axes as those of `Shelter`."""

    top_m: Float32
    """(A, L) highest surface over each cell, above `origin_m[2]`; -inf where nothing is known."""
    bottom_m: Float32
    """(A, L) lowest one; inf where nothing is known."""
    origin_m: Float64
    """(3,) street coordinates of the corner of cell [0, 0], and of the height 0."""
    axes_world: Float64
    """(3, 3), rows: along the street, to the left, up."""
    cell_m: float


def mirrored_camera(camera: Camera, plane: Plane) -> Camera:
    """The camera whose picture, turned upside down, is what `camera` sees mirrored in a plane.

    A mirror image of a camera is left-handed. So its picture's rows are turned over as well: row v
    of the mirrored picture is row H - 1 - v of this camera's. It is at rest.

    Raises:
        ArgumentError: If the normal is not of length 1, or the camera is not over the plane.
    """
    normal = np.asarray(plane.normal_world, np.float64)
    if normal.shape != (3,) or abs(float(np.linalg.norm(normal)) - 1.0) > 1e-6:
        raise ArgumentError(f"normal_world must be a unit vector (3,), got {normal!r}")
    above_m = float(plane.height_m(camera.centre_world))
    if not above_m > 0:
        raise ArgumentError(
            f"the camera is {-above_m:.3g} m below the plane; give a normal that points up, or a "
            "lower plane"
        )
    pose = np.eye(4)
    rotation = camera.world_from_camera[:3, :3]
    turned = rotation - 2.0 * np.outer(normal, normal @ rotation)
    pose[:3, :3] = turned * (1.0, -1.0, 1.0)
    pose[:3, 3] = camera.centre_world - 2.0 * above_m * normal
    intrinsics = camera.intrinsics.copy()
    intrinsics[1, 2] = camera.height - 1 - camera.intrinsics[1, 2]
    return replace(
        camera,
        intrinsics=intrinsics,
        world_from_camera=pose,
        velocity_m_per_s=np.zeros(3),
        angular_velocity_rad_per_s=np.zeros(3),
    )


def mirrored(
    reconstruction: Reconstruction,
    camera: Camera,
    plane: Plane,
    time_s: float,
    *,
    key: FrameKey | None = None,
    threads: int = 1,
) -> Seen:
    """The street as `camera` sees it mirrored in the road, also what its picture does not show.

    Without the ground, what is below the plane, and the sky: they are what a road mirrors, not what
    it mirrors them with. Colours are those towards the camera itself: none was ever recorded from
    below the road.

    Args:
        reconstruction: The drive.
        camera: Over the road. `mirror_seen.small_camera` is the one that the editor wants.
        plane: The road's.
        time_s: Moment, in the clip's time.
        key: A recorded frame whose exposure the colours shall have; the scene's own if None.
        threads: Of the rasteriser.

    Returns:
        Colours, depth and opacity in the camera's own rows and columns.

    Raises:
        ArgumentError: As of `mirrored_camera`, or if there is no such frame.
    """
    below = mirrored_camera(camera, plane)
    rotation = below.world_from_camera[:3, :3]
    camera_from_origin = np.eye(4, dtype=np.float32)
    camera_from_origin[:3, :3] = rotation.T
    camera_from_origin[:3, 3] = rotation.T @ (camera.centre_world - below.centre_world)
    with torch.no_grad():
        gathered = gather(reconstruction, time_s, origin_m=camera.centre_world)
        kept = torch.from_numpy(stands_on(gathered, camera, plane))
        drawn = rasterise(
            gathered.means_m[kept],
            gathered.quaternions[kept],
            gathered.scales_m[kept],
            gathered.opacities[kept],
            gathered.colours_seen(camera.centre_world)[kept],
            torch.from_numpy(camera_from_origin),
            Pinhole.of(below),
            threads=threads,
        )
    opacity = drawn.opacity.numpy()[::-1]
    srgb = drawn.colours.numpy()[::-1] / np.maximum(opacity, 1e-6)[..., None]
    if key is not None:
        exposure = _exposure(reconstruction, key)
        srgb = srgb @ exposure[:, :3].T + exposure[:, 3]
    depth = drawn.depth_m.numpy()[::-1]
    return Seen(*(np.ascontiguousarray(a) for a in (np.clip(srgb, 0, 1), depth, opacity)))


def seen_in_road(
    reconstruction: Reconstruction, site: Site, *, novel: bool = False, threads: int = 1
) -> Seen:
    """The mirror image that `edit.physical.layers.layers_of` takes for a frame.

    Args:
        reconstruction: The drive.
        site: The frame. The road lies under its camera as its own depth tells; where the
            reconstruction has refined a recorded camera, the road moves along with it.
        novel: Whether the frame was drawn from the reconstruction; its camera stands right then.
        threads: Of the rasteriser.
    """
    frame = site.frame
    camera, plane = small_camera(site), Plane(*road_of(site))
    refined = None if novel else reconstruction.cameras.get(frame.key)
    if refined is not None:
        moved = refined.world_from_camera @ np.linalg.inv(camera.world_from_camera)
        camera = replace(camera, world_from_camera=refined.world_from_camera)
        point = moved[:3, :3] @ plane.point_world + moved[:3, 3]
        plane = Plane(point, moved[:3, :3] @ plane.normal_world)
    key = frame.key if frame.key in reconstruction.exposures else None
    return mirrored(reconstruction, camera, plane, frame.time_s, key=key, threads=threads)


def surfaces(
    reconstruction: Reconstruction, camera: Camera, time_s: float, *, threads: int = 1
) -> tuple[Float32, Float32]:
    """Depth (H, W), metres, `inf` in the sky, and normals (H, W, 3), world axes, of what is seen.

    Normals point to the camera and are zero in the sky.
    """
    seen = view(reconstruction, camera, time_s, want=("depth", "normals"), threads=threads)
    assert seen.depth_m is not None and seen.normals_world is not None
    return seen.depth_m, seen.normals_world


def height_map(
    reconstruction: Reconstruction, axes_world: Float64, cell_m: float = CELL_M
) -> HeightMap:
    """Highest and lowest surface over each cell of the ground, of what stands still.

    Args:
        reconstruction: The drive.
        axes_world: (3, 3), rows: along the street, to the left, up.
        cell_m: Side of a cell, in [0.05, 10] m.

    Raises:
        ArgumentError: If the drive shows no surface, or `cell_m` is out of its range.
    """
    finite("cell_m", cell_m, 0.05, 10.0)
    points, _ = surface_points(reconstruction, min(SAMPLE_M, 0.5 * cell_m))
    if not len(points):
        raise ArgumentError("the reconstruction has no opaque Gaussian near its cameras")
    street = points @ axes_world.T
    index = np.floor(street[:, :2] / cell_m).astype(np.int64)
    corner = index.min(axis=0)
    shape = tuple((index.max(axis=0) - corner + 1).tolist())
    place = np.ravel_multi_index(tuple((index - corner).T), shape)
    reference_m = float(np.median(street[:, 2]))
    top, bottom = np.full(shape, -np.inf, np.float32), np.full(shape, np.inf, np.float32)
    height = (street[:, 2] - reference_m).astype(np.float32)
    np.maximum.at(top.reshape(-1), place, height)
    np.minimum.at(bottom.reshape(-1), place, height)
    return HeightMap(top, bottom, np.append(corner * cell_m, reference_m), axes_world, cell_m)


def shelter_from_gaussians(reconstruction: Reconstruction, axes_world: Float64) -> Shelter | None:
    """Map the bridges and roofs over a street, from its surfaces instead of its frames.

    By the rules of `scene.shelter`: a gap over the ground, then a thin layer, wide enough; where
    classes are known, of what may be part of a building.

    Args:
        reconstruction: The drive.
        axes_world: (3, 3), rows: along the street, to the left, up.

    Returns:
        The map, cut to the covers; None where the sky is open everywhere.
    """
    points, owner = surface_points(reconstruction, SAMPLE_M)
    if not len(points) or not reconstruction.cameras:
        return None
    classes = _classes(reconstruction.background.class_scores)
    centres = _centres(reconstruction)
    nearest = _nearest(points, centres)
    return shelter_of_points(
        Points(
            points @ axes_world.T,
            (points - centres[nearest]) @ axes_world[2],
            None if classes is None else classes[owner],
        ),
        axes_world,
        axes_world @ centres[0],
    )


def surface_points(
    reconstruction: Reconstruction, spacing_m: float
) -> tuple[Float64, NDArray[np.int64]]:
    """Points (P, 3) of the surfaces that stand still near the way driven, world axes, metres.

    Each opaque Gaussian is an ellipsoid of `EXTENT_SIGMAS`, with points about `spacing_m` apart.

    Returns:
        The points, and (P,) to which of the background's Gaussians each belongs.
    """
    background = reconstruction.background
    opaque = background.logit_opacities >= np.log(LEAST_OPACITY / (1.0 - LEAST_OPACITY))
    if reconstruction.cameras:
        centres = _centres(reconstruction)
        near = _nearest(background.means_m, centres)
        away = np.linalg.norm(background.means_m - centres[near], axis=1)
        opaque &= away < RANGE_M
    classes = _classes(background.class_scores)
    if classes is not None:
        opaque &= classes != SKY
    picked = np.flatnonzero(opaque)
    parts = list(_sampled(background, picked, spacing_m))
    if not parts:
        return np.empty((0, 3)), np.empty(0, np.int64)
    points, owners = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(owners)


def _sampled(
    gaussians: Gaussians, picked: NDArray[np.int64], spacing_m: float
) -> Iterator[tuple[Float64, NDArray[np.int64]]]:
    """Points of ellipsoids, those with equally many along each axis together."""
    half = EXTENT_SIGMAS * np.exp(gaussians.log_scales[picked].astype(np.float64))
    counts = np.clip(np.ceil(2.0 * half / spacing_m), 1, MOST_SAMPLES).astype(np.int64)
    unit = gaussians.quaternions[picked].astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    turned = matrices_of(torch.from_numpy(unit)).numpy()
    axes = turned * half[:, None, :]
    for alike in np.unique(counts, axis=0):
        members = np.flatnonzero((counts == alike).all(axis=1))
        steps = [(2.0 * np.arange(n) + 1.0) / n - 1.0 for n in alike]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[(grid**2).sum(axis=1) <= 1.0]
        offsets = np.einsum("mij,gj->mgi", axes[members], grid)
        points = gaussians.means_m[picked[members], None].astype(np.float64) + offsets
        yield points.reshape(-1, 3), np.repeat(picked[members], len(grid))


def stands_on(gathered: Gathered, camera: Camera, plane: Plane) -> Mask:
    """(R,) which Gaussians a road mirrors: what stands over it, not the ground nor the sky.

    What the classes call ground is none of it up to a bank's height, by the rule of
    `mirror.mirror_map`; where nobody labelled, what lies within the ground's tolerance is ground.
    """
    means = gathered.means_m.numpy().astype(np.float64) + gathered.origin_m
    height = plane.height_m(means)
    away = np.linalg.norm(means - camera.centre_world, axis=1)
    classes = _classes(gathered.class_scores.numpy())
    if classes is None:
        return height > GROUND_TOLERANCE_M + GROUND_TOLERANCE_PER_M * away
    is_bank = height > BANK_M + BANK_PER_M * away
    return (height > 0) & (classes != SKY) & (is_bank | ~np.isin(classes, GROUND))


def _classes(scores: NDArray[np.floating]) -> NDArray[np.uint8] | None:
    """(N,) train ids of scores (N, C), None if nobody labelled."""
    return None if scores.shape[1] == 0 else scores.argmax(axis=1).astype(np.uint8)


def _centres(reconstruction: Reconstruction) -> Float64:
    """(K, 3) places of the recorded cameras, world axes."""
    return np.stack([camera.centre_world for camera in reconstruction.cameras.values()])


def _nearest(points: NDArray[np.floating], centres: Float64) -> NDArray[np.int64]:
    """(N,) which of the centres (K, 3) is nearest to each point (N, 3)."""
    best = np.full(len(points), np.inf)
    which = np.zeros(len(points), np.int64)
    for index, centre in enumerate(centres):
        away = ((points - centre) ** 2).sum(axis=1)
        closer = away < best
        best[closer], which[closer] = away[closer], index
    return which


def _exposure(reconstruction: Reconstruction, key: FrameKey) -> Float64:
    try:
        return np.asarray(reconstruction.exposures[key], np.float64)
    except KeyError:
        raise ArgumentError(
            f"the reconstruction has no frame {key}; its frames are {len(reconstruction.exposures)}"
        ) from None
