"""What a browser is shown of a scene: splats, points, poses. Arrays in, arrays out; no browser.

Convention:
    A browser blends splats back to front in sRGB, with 8 bits for colours and opacities and float16
    for covariances; it knows no spherical harmonics, and drops what is smaller or fainter than
    about a pixel. So each Gaussian has one colour here, that in which the drive saw it from
    nearest, and particles are widened to a pixel with less opacity in turn.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.air import air_of
from weather_aug.clip.types import Camera, Frame
from weather_aug.colour import srgb_from_linear
from weather_aug.edit.ambience import Ambience
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.cube import on_face
from weather_aug.gaussians.gather import gather
from weather_aug.gaussians.harmonics import colours_seen
from weather_aug.gaussians.rotations import quaternions_of
from weather_aug.gaussians.types import Gaussians, Reconstruction, Style
from weather_aug.particles.field import COVARIANCE, OPACITY, VELOCITY
from weather_aug.particles.shelter import Shelter, exposed
from weather_aug.render.fields import fields_of, resolved_of
from weather_aug.render.light import particle_colour
from weather_aug.render.options import RenderOptions
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
T = TypeVar("T")

LARGEST_M = 200.0
"""Standard deviation; its square still fits into float16."""
NEAR_M = 0.5
"""Nearer than this a recorded camera does not count as having seen a Gaussian."""
MOST_CAMERAS = 64
"""Recorded cameras, spread over the drive, from which colours are looked up."""
PIXEL_FILTER_PX2 = 0.3
"""What the browser's shader adds to a projected covariance."""
LEAST_WIDTH_PX = 0.8
"""Standard deviation to which a narrower particle is widened: the shader drops what is small."""
FARTHEST_POINT_M = 80.0


class Splats(NamedTuple):
    """N splats in one coordinate frame, as viser takes them."""

    centres_m: Float32
    """(N, 3)."""
    covariances_m2: Float32
    """(N, 3, 3)."""
    rgbs: UInt8
    """(N, 3), sRGB."""
    opacities: UInt8
    """(N, 1), 255 is opaque."""

    def padded(self, count: int) -> Splats:
        """The first `count` splats, filled up with invisible ones.

        A browser updates as many splats as it had in place, and any other number anew.
        """
        kept = Splats._make(array[:count] for array in self)
        missing = max(count - len(self.centres_m), 0)
        return Splats._make(np.pad(a, [(0, missing)] + [(0, 0)] * (a.ndim - 1)) for a in kept)


def covariances_of(quaternions: Float32, scales_m: Float32) -> Float32:
    """(N, 3, 3) from quaternions (N, 4), not necessarily of unit length, and axes (N, 3)."""
    axes = _rotations_of(quaternions) * np.minimum(scales_m, LARGEST_M)[:, None, :]
    covariances: Float32 = axes @ axes.transpose(0, 2, 1)
    return covariances


def background_splats(
    reconstruction: Reconstruction,
    cameras: Sequence[Camera],
    style: str | None = None,
    amount: float = 1.0,
) -> Splats:
    """What stands still, in world axes, in a style of its colours.

    Args:
        reconstruction: The drive.
        cameras: Recorded ones; each Gaussian has the colour in which the nearest saw it.
        style: A name in `reconstruction.styles`; None is the scene's own colours.
        amount: In 0..1, how far to go from the own colours to the style's.
    """
    everybody = [actor.track_id for actor in reconstruction.actors]
    found = gather(reconstruction, 0.0, style=style, amount=amount, without=everybody, labels=False)
    means = found.means_m.numpy()
    seen_from, seen = nearest_views(means, cameras)
    towards = torch.from_numpy(means - seen_from)
    colours = colours_seen(found.sh, towards, torch.zeros(3)).numpy()
    # From where nobody looked the harmonics were never fitted, but for their mean.
    mean = colours_seen(found.sh, towards, torch.zeros(3), 0).numpy()
    return Splats(
        means,
        covariances_of(found.quaternions.numpy(), found.scales_m.numpy()),
        levels(np.where(seen[:, None], colours, mean)),
        levels(found.opacities.numpy()[:, None]),
    )


def nearest_views(means_m: Float32, cameras: Sequence[Camera]) -> tuple[Float32, NDArray[np.bool_]]:
    """Centre (N, 3) of the camera that has each point in its picture and is nearest to it.

    Args:
        means_m: (N, 3), world axes.
        cameras: At most 64 of them, evenly spread, are asked.

    Returns:
        The centres, and (N,) whether any camera has the point in its picture; else the centre is 0.
    """
    centres = np.zeros_like(means_m)
    nearest = np.full(len(means_m), np.inf, np.float32)
    for camera in spread(cameras, MOST_CAMERAS):
        local = means_m - camera.centre_world.astype(np.float32)
        local = local @ camera.world_from_camera[:3, :3].astype(np.float32)
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
        depth = np.maximum(local[:, 2], 1e-6)
        x, y = local[:, 0] / depth * fx + cx, local[:, 1] / depth * fy + cy
        nearer = (local[:, 2] > NEAR_M) & (local[:, 2] < nearest)
        nearer &= (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
        nearest[nearer] = local[nearer, 2]
        centres[nearer] = camera.centre_world
    return centres, np.isfinite(nearest)


def actors_alone(reconstruction: Reconstruction) -> Reconstruction:
    """The same drive with one Gaussian of its background only, which `actor_splats` leaves out."""
    background = reconstruction.background
    alone = Gaussians(
        *(
            getattr(background, name)[:1]
            for name in (
                "means_m",
                "quaternions",
                "log_scales",
                "logit_opacities",
                "sh",
                "class_scores",
            )
        )
    )
    styles = {
        name: Style(style.sh[:1], style.actor_sh, style.sky)
        for name, style in reconstruction.styles.items()
    }
    return replace(
        reconstruction, background=alone, styles=styles, support=reconstruction.support[:1]
    )


def actor_splats(
    alone: Reconstruction,
    time_s: float,
    centre_m: Float64,
    style: str | None = None,
    amount: float = 1.0,
    without: Collection[int] = (),
) -> Splats:
    """What moves, at a moment of the drive, in world axes.

    Args:
        alone: As `actors_alone` gives it.
        time_s: In the clip's time.
        centre_m: (3,) from where colours are seen: the recorded camera's at that time.
        style: As for `background_splats`.
        amount: As for `background_splats`.
        without: Track ids that are hidden.
    """
    found = gather(alone, time_s, style=style, amount=amount, without=without, labels=False)
    first = len(alone.background)
    colours = found.colours_seen(centre_m).numpy()[first:]
    scales, quaternions = found.scales_m.numpy()[first:], found.quaternions.numpy()[first:]
    return Splats(
        found.means_m.numpy()[first:],
        covariances_of(quaternions, scales),
        levels(colours),
        levels(found.opacities.numpy()[first:, None]),
    )


def particle_splats(
    view: Camera,
    time_s: float,
    weather: Weather,
    seed: int,
    light: Ambience,
    *,
    shelter: Shelter | None = None,
    max_particles: int = 4000,
    emphasis: float = 1.0,
) -> Splats:
    """What falls around a camera at a moment, in world axes, smeared by the shutter.

    These are the particles that `render` would draw for this camera, in this weather and seed.

    Args:
        view: The browser's camera, at rest.
        time_s: Seconds since the clip's start.
        weather: State of the air.
        seed: Which particles fall and which gusts blow.
        light: Around the recorded camera, as recorded.
        shelter: Bridges and roofs.
        max_particles: Expected number at the most.
        emphasis: Factor on opacities, at least 1; the browser drops what is fainter than 1/100.
    """
    emphasis = finite("emphasis", emphasis, 1.0, 100.0)
    options = RenderOptions(max_particles)
    fields = fields_of(
        weather, seed, air_of(weather, time_s, seed), light.axes_world, options, None
    )
    resolved, _ = resolved_of(fields, view, max_particles)
    window = (0, 0, view.height, view.width)
    sky = light.under(weather.overcast)
    parts = [_no_splats()]
    for field, part in zip(fields, resolved, strict=True):
        found = field.particles(view, time_s, part, window)
        found = exposed(found, view, field.air.wind_m_per_s, shelter)
        colour = srgb_from_linear(np.clip(particle_colour(field.population.kind, sky), 0.0, 1.0))
        parts.append(_smeared(found, view, levels(colour), emphasis))
    return Splats._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def _smeared(particles: Float32, view: Camera, rgb: UInt8, emphasis: float) -> Splats:
    """Splats of records (N, 13), each smeared along its way while the shutter is open.

    A particle that covers a part of a pixel is drawn over more of it, and as much fainter: its
    opacity times its area on the picture is kept, but for the emphasis.
    """
    places = particles[:, :3].astype(np.float64)
    own = np.empty((len(places), 3, 3))
    rows, columns = np.triu_indices(3)
    own[:, rows, columns] = own[:, columns, rows] = particles[:, COVARIANCE : COVARIANCE + 6]
    way = particles[:, VELOCITY : VELOCITY + 3] * view.exposure_s
    focal_px = math.sqrt(math.prod(view.focal_px))
    width_m = LEAST_WIDTH_PX / focal_px * places[:, 2]
    drawn = own + way[:, :, None] * way[:, None, :] / 12 + np.eye(3) * width_m[:, None, None] ** 2
    kept = np.sqrt(_area_px4(own, places, view, 0.0) / _area_px4(drawn, places, view, 1.0))
    opacity = np.clip(emphasis * particles[:, OPACITY] * kept, 0.0, 1.0)
    rotation = view.world_from_camera[:3, :3]
    return Splats(
        (places @ rotation.T + view.centre_world).astype(np.float32),
        (rotation @ drawn @ rotation.T).astype(np.float32),
        np.broadcast_to(rgb, (len(places), 3)).copy(),
        levels(opacity[:, None]),
    )


def _area_px4(covariances: Float64, places: Float64, view: Camera, filtered: float) -> Float64:
    """Determinants (N,) of projected covariances, with the shader's filter or without."""
    fx, fy = view.focal_px
    x, y, z = places.T
    zero = np.zeros_like(z)
    jacobian = np.array([[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]])
    jacobian = jacobian.transpose(2, 0, 1)
    seen = jacobian @ covariances @ jacobian.transpose(0, 2, 1)
    seen += filtered * PIXEL_FILTER_PX2 * np.eye(2)
    area: Float64 = np.maximum(np.linalg.det(seen), 1e-12)
    return area


def browser_camera(
    position_m: Float64, wxyz: Float64, fov_rad: float, size_px: tuple[int, int], like: Camera
) -> Camera:
    """The camera of a browser's window, at rest, with the shutter and lens of a recorded one.

    Args:
        position_m: (3,) in world axes.
        wxyz: (4,) rotation of the camera's axes (x right, y down, z forward) into the world's.
        fov_rad: Vertical.
        size_px: (width, height) of the window.
        like: A recorded camera.
    """
    width, height = size_px
    focal_px = 0.5 * height / math.tan(0.5 * fov_rad)
    intrinsics = np.array(
        [[focal_px, 0, 0.5 * (width - 1)], [0, focal_px, 0.5 * (height - 1)], [0, 0, 1.0]]
    )
    pose = np.eye(4)
    pose[:3, :3] = _rotations_of(np.asarray(wxyz, np.float64)[None])[0]
    pose[:3, 3] = position_m
    return Camera(
        intrinsics,
        pose,
        width,
        height,
        exposure_s=like.exposure_s,
        aperture_m=like.aperture_m,
    )


def depth_points(frame: Frame, step_px: int) -> tuple[Float32, UInt8]:
    """Points (N, 3) in world axes and their colours (N, 3), of every `step_px`th pixel each way.

    A frame without depth has none; farther than 80 m depth is too coarse to look at.
    """
    if frame.depth_m is None:
        return np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)
    depth = frame.depth_m[::step_px, ::step_px].astype(np.float64)
    rows, columns = np.nonzero((depth > 0) & (depth < FARTHEST_POINT_M))
    z = depth[rows, columns]
    rows, columns = rows * step_px, columns * step_px
    camera = frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    local = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1)
    world = local @ camera.world_from_camera[:3, :3].T + camera.centre_world
    return world.astype(np.float32), frame.image[rows, columns]


def sky_face_wxyz(face: int) -> Float64:
    """Quaternion (4,) of a face of a cube map: an image's x (right), y (down), z in world axes.

    A cube map's faces are drawn as seen from outside, so z points inwards; what is seen from inside
    is the image's back, which is right.
    """
    corner = np.zeros(())
    middle = on_face(face, corner, corner)
    across = on_face(face, corner + 1, corner) - middle
    down = on_face(face, corner, corner + 1) - middle
    axes = np.stack([across, down, np.cross(across, down)], axis=1)
    return np.asarray(quaternions_of(axes), np.float64)


def sky_face_direction(face: int) -> Float64:
    """(3,) unit vector to the middle of a face of a cube map."""
    return on_face(face, np.zeros(()), np.zeros(()))


def fog_end_m(weather: Weather) -> float | None:
    """Where a linear fog must be opaque to halve the light at the same distance; None if clear.

    Browsers fade linearly with distance: 1 - d / end stands for exp(-extinction d).
    """
    per_m = weather.fog_per_m + weather.mist_per_km / 1000
    return 2 * math.log(2) / per_m if per_m > 0 else None


def spread(items: Sequence[T], most: int) -> Sequence[T]:
    """At most `most` of the items, evenly spread, the first among them."""
    if most < 1:
        raise ArgumentError(f"most must be at least 1, got {most}")
    if len(items) <= most:
        return items
    return [items[i * len(items) // most] for i in range(most)]


def levels(values: NDArray[np.floating]) -> UInt8:
    """Values in 0..1, cut there, as 8-bit levels."""
    return np.round(255 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def _rotations_of(quaternions: NDArray[Any]) -> NDArray[Any]:
    """(N, 3, 3) of quaternions (N, 4) of any length but zero, in their precision."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rotations = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rotations).transpose(2, 0, 1)


def _no_splats() -> Splats:
    return Splats(
        np.empty((0, 3), np.float32),
        np.empty((0, 3, 3), np.float32),
        np.empty((0, 3), np.uint8),
        np.empty((0, 1), np.uint8),
    )
