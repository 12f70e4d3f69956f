"""Particles sorted among a scene's Gaussians, all blended in one pass, instead of over its picture.

`compose.render` has two layers: the scene's picture with one depth at each pixel, and air and
particles over it. Where a pixel shows one surface that is exact, and scenes cache it. Where it has
several (soft edges, leaves, half-transparent Gaussians) one depth stands for all of them. Here each
Gaussian has its own place in the order and its own way through the air: its light c becomes
t c + (1 - t) A, and a flake between two Gaussians is drawn between them.

Which colours are blended is a choice. Gaussians are fitted to be blended in sRGB, while air and
particles add up in linear light. To blend the linear light of the Gaussians instead would make each
pixel that several of them share brighter than it was recorded; to blend particles in sRGB would
make dark streaks of bright ones. So the scene's own picture B is blended as it was fitted, what
weather does is blended in linear light, and at each pixel the linear light S of the Gaussians is
scaled to that of B. Without weather the picture is then the scene's own, and with it each Gaussian
still fades by its own depth. As linear light is a convex function of sRGB, the factor is at most 1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weather_aug._compiled import compiled
from weather_aug._keys import check_seed
from weather_aug._rows import survival
from weather_aug.air import Air, air_of
from weather_aug.clip.types import Camera, FrameKey
from weather_aug.colour import linear_from_srgb, srgb_from_linear
from weather_aug.edit.ambience import Ambience
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import blend, projection
from weather_aug.gaussians.gather import Gathered, Weights, exposure_of, gather, sky_of
from weather_aug.gaussians.rasterise import NEAR_M
from weather_aug.gaussians.rasterise_cpu import lens_of
from weather_aug.gaussians.sky import sky_picture
from weather_aug.gaussians.tiles import tiles_of
from weather_aug.gaussians.types import Pinhole, Reconstruction
from weather_aug.particles.shelter import Shelter
from weather_aug.render.fields import fields_of, resolved_of, splats_of
from weather_aug.render.froxels import even_fog
from weather_aug.render.medium import Medium, Optics, carried_at, near_optical_depth, optical_depth
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.render.project import CONIC, DEPTH, LIGHT, PEAK, U
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.render.taken import camera_in
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

BLACK = 1e-4
"""Linear light added on both sides of the factor, so that black over black stays a number."""


class Splats(NamedTuple):
    """Gaussians on a picture, as the rasteriser's kernels take them."""

    parts: Float32
    """(N, 6), see `gaussians.projection.project`."""
    depths_m: Float32
    """(N,)."""
    radii_px: Float32
    """(N,), 0 for what is not drawn."""


def render_joint(
    reconstruction: Reconstruction,
    camera: Camera,
    time_s: float,
    weather: Weather,
    *,
    seed: int,
    ambience: Ambience,
    style: str | Weights | None = None,
    amount: float = 1.0,
    without: Collection[int] = (),
    poses: Mapping[int, ArrayLike] | None = None,
    key: FrameKey | None = None,
    air: Air | None = None,
    shelter: Shelter | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> UInt8:
    """Look at a reconstructed drive through weather, its particles among the scene's Gaussians.

    Air and particles only: what weather does to surfaces is the style's part; lamps, plumes, glass
    and sensor are not drawn.

    Args:
        reconstruction: The drive.
        camera: Any.
        time_s: Moment, seconds since the clip's start.
        weather: State of the air. Its fog must be even.
        seed: Which particles fall, as in `compose.render`.
        ambience: Light and axes of the scene.
        style: Colours of the surfaces, as in `gaussians.gather`.
        amount: In 0..1, of the style.
        without: Track ids of actors to leave out.
        poses: (4, 4) by track id: actors put elsewhere.
        key: A recorded frame whose exposure to apply; the scene's own if None.
        air: How the air moves and has moved; if None, as if the weather had always been the same.
        shelter: Bridges and roofs, None for an open sky.
        options: Choices besides the weather.

    Returns:
        (H, W, 3) sRGB.

    Raises:
        ArgumentError: If the fog is patchy, an option asks for what is not drawn here, or as of
            `gather`.
    """
    seed = check_seed("seed", seed)
    _check(weather, options)
    exposure = None if key is None else exposure_of(reconstruction, key)
    camera = camera_in(camera, weather, options)
    gathered = gather(
        reconstruction,
        time_s,
        style=style,
        amount=amount,
        without=without,
        poses=poses,
        origin_m=camera.centre_world,
        labels=False,
    )
    scene = projected(gathered, camera)
    srgb = gathered.colours_seen(camera.centre_world).numpy()
    sky = sky_picture(
        sky_of(reconstruction, style, amount), Pinhole.of(camera), camera.world_from_camera
    )
    light, sky_light = _light(srgb), _light(sky)
    factor = _factor(scene, (srgb, light), (sky, sky_light), camera, exposure)

    air = air_of(weather, time_s, seed) if air is None else air
    fields = fields_of(weather, seed, air, ambience.axes_world, options, None)
    resolved, carried = resolved_of(fields, camera, options.max_particles)
    medium = medium_of(weather, fields, ambience)
    optics = optics_of(camera, ambience.axes_world[2])
    window = (0, 0, camera.height, camera.width)
    under = ambience.under(weather.overcast)
    falling, colours = _particles(
        splats_of(camera, time_s, fields, resolved, under, optics, medium, carried, window, shelter)
    )
    through = _through(scene, optics, medium, carried)[:, None]
    veil = (1.0 - through) * ambience.airlight.astype(np.float32)
    planes = np.concatenate([through * light, veil], axis=1)
    planes = np.concatenate([planes, np.pad(colours, ((0, 0), (3, 0)))])
    seen, left = blended(_joined(scene, falling), planes, camera)
    endless = np.full(left.shape, np.inf, np.float32)
    tau = optical_depth(endless, window, optics, medium, carried, even_fog())
    behind, before = (left * np.exp(-tau))[..., None], (left * (1.0 - np.exp(-tau)))[..., None]
    total = factor * (seen[..., :3] + behind * sky_light)
    total += seen[..., 3:] + before * ambience.airlight
    return np.round(255.0 * srgb_from_linear(np.clip(total, 0.0, 1.0))).astype(np.uint8)


def projected(gathered: Gathered, camera: Camera) -> Splats:
    """Gaussians that were gathered about the camera's centre, on its picture."""
    count = len(gathered.means_m)
    view = np.eye(4)
    view[:3, :3] = camera.world_from_camera[:3, :3].T
    splats = Splats(
        np.empty((count, projection.PARTS), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
    )
    projection.project(
        gathered.means_m.numpy(),
        gathered.quaternions.numpy(),
        gathered.scales_m.numpy(),
        gathered.opacities.numpy(),
        view,
        lens_of(Pinhole.of(camera)),
        NEAR_M,
        True,
        *splats,
    )
    return splats


def blended(splats: Splats, planes: Float32, camera: Camera) -> tuple[Float32, Float32]:
    """Blend planes (N, C) front to back: (H, W, C), and (H, W) the share of light that passes."""
    height, width = camera.height, camera.width
    tiles = tiles_of(*splats, width, height)
    parts = np.empty((len(tiles.order), projection.PARTS), np.float32)
    values = np.empty((len(tiles.order), planes.shape[1]), np.float32)
    blend.gather(tiles.order, splats.parts, np.ascontiguousarray(planes, np.float32), parts, values)
    left = np.empty((height, width), np.float32)
    out = np.empty((height, width, planes.shape[1]), np.float32)
    ends = np.empty(len(tiles.starts) - 1, np.int64)
    whole = (0, len(ends))
    blend.blend(parts, values, tiles.starts, tiles.ranks, whole, left, out, ends)
    return out, left


def _check(weather: Weather, options: RenderOptions) -> None:
    if not isinstance(weather, Weather):
        raise ArgumentError(f"weather must be a Weather, got {type(weather).__name__}")
    if weather.fog_patchiness > 0 or weather.fog_puffs > 0:
        raise ArgumentError(
            "joint rendering knows even fog only; set fog_patchiness and fog_puffs to 0, or use "
            "compose.render"
        )
    if options.needs_rig or options.multiple_scattering:
        raise ArgumentError(
            "joint rendering draws preset='physical' with alignment='world' and without multiple "
            "scattering; use compose.render for others"
        )


def _light(srgb: Float32) -> Float32:
    """Linear light of sRGB values at least 0, and never nothing, so that it can be scaled."""
    return (linear_from_srgb(srgb.astype(np.float64)) + BLACK).astype(np.float32)


def _factor(
    scene: Splats,
    colours: tuple[Float32, Float32],
    sky: tuple[Float32, Float32],
    camera: Camera,
    exposure: Float32 | None,
) -> Float32:
    """(H, W, 3) light of the scene's picture over the blended light of its Gaussians.

    Args:
        scene: On the picture.
        colours: (N, 3) each, sRGB and light.
        sky: (H, W, 3) each, the same.
        camera: Of the picture.
        exposure: (3, 4) on the picture's sRGB.
    """
    both, left = blended(scene, np.concatenate(colours, axis=1), camera)
    both += left[..., None] * np.concatenate(sky, axis=2)
    picture = both[..., :3]
    if exposure is not None:
        picture = picture @ exposure[:, :3].T + exposure[:, 3]
    return (linear_from_srgb(np.clip(picture, 0.0, 1.0)) / both[..., 3:]).astype(np.float32)


def _particles(splats: Float32) -> tuple[Splats, Float32]:
    """Splats (M, 16) of `render.project`, far to near, as the rasteriser takes them; their light.

    Nearest first, because the rasteriser keeps that order among equal depths.
    """
    splats = splats[::-1]
    parts = np.concatenate(
        [splats[:, U : CONIC + 3], splats[:, PEAK : PEAK + 1]], axis=1, dtype=np.float32
    )
    depths = np.ascontiguousarray(splats[:, DEPTH])
    return Splats(parts, depths, np.ones_like(depths)), splats[:, LIGHT : LIGHT + 3]


def _joined(scene: Splats, falling: Splats) -> Splats:
    return Splats(*(np.concatenate(pair) for pair in zip(scene, falling, strict=True)))


def _through(scene: Splats, optics: Optics, medium: Medium, carried: Float32) -> Float32:
    """(N,) share of each Gaussian's light that reaches the camera through the air."""
    out = np.ones(len(scene.depths_m), np.float32)
    _fill_through(*scene, optics, medium, carried, out)
    return out


@compiled
def _fill_through(
    parts: Float32,
    depths: Float32,
    radii: Float32,
    optics: Optics,
    medium: Medium,
    carried: Float32,
    out: Float32,
) -> None:
    for n in range(depths.shape[0]):
        if not radii[n] > np.float32(0.0):
            continue
        x = (parts[n, 0] - optics.cx) / optics.fx
        y = (parts[n, 1] - optics.cy) / optics.fy
        drawn = carried_at(depths[n], carried, medium)
        out[n] = survival(near_optical_depth(depths[n], x, y, optics, medium, drawn))
