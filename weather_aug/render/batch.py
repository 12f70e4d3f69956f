"""A batch of frames in weather, in torch, on the tensors' own device.

The same pictures as `render`'s. What has the same bits: depth; the particles' records; on a CPU the
shares of uneven fog; with splatting "compiled" also the particles' shapes and their order. What has
not: tone, air and encoding are computed with the exact exp and powers here, by polynomials there;
with "torch" and "gsplat" footprints are, too, and particles are sorted by their exact depth rather
than by 4096 keys. A picture differs by less than a level nearly everywhere (above 45 dB, and 50 dB
as a rule), and its transmittance by less than 0.01. A picture here is not quantised.

Every run gives the same bits on a device, with "compiled" and with "torch"; gsplat promises none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.air import Air, air_of
from weather_aug.clip.types import FAR_DEPTH_M, Camera
from weather_aug.edit.ambience import Ambience
from weather_aug.particles.shelter import Shelter
from weather_aug.render import batch_shade
from weather_aug.render.batch_checks import (
    check_cameras,
    check_options,
    check_tensors,
    one_each,
)
from weather_aug.render.batch_fog import fog_shares
from weather_aug.render.batch_medium import AirColumn, pixel_rays
from weather_aug.render.batch_particles import Job, Particles, particle_layer, splatting_on
from weather_aug.render.batch_splat import Layer
from weather_aug.render.fields import RigMotion
from weather_aug.render.fog import fog_volume_of
from weather_aug.render.label import least_linear_contrast
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.taxonomy import SKY
from weather_aug.weather import Weather

ROWS_AT_ONCE = 32
"""Rows that a CPU shades together: in the cache, and in memory that is not given back meanwhile."""


@dataclass(frozen=True, eq=False)
class RenderedBatch:
    """Pictures in weather and what can still be said about them, on the images' device."""

    image: Tensor
    """(B, 3, H, W) sRGB in [0, 1], of the images' dtype; not quantised."""
    label: Tensor | None
    """(B, H, W) train ids, 255 where the surface cannot be seen; None where none were given."""
    invalid: Tensor
    """(B, H, W) uint8, 1 where the surface is undetectable or beyond the optical range."""
    transmittance: Tensor
    """(B, H, W) share of the surface's light that reaches the pixel, in [0, 1]."""
    depth: Tensor
    """(B, H, W) z-depth of the surface, metres, `inf` for the sky."""


def render_batch(
    images: Tensor,
    depth_m: Tensor,
    *,
    cameras: Sequence[Camera],
    weathers: Sequence[Weather],
    seeds: Sequence[int],
    ambiences: Sequence[Ambience],
    times_s: Sequence[float],
    airs: Sequence[Air | None] | None = None,
    shelters: Sequence[Shelter | None] | None = None,
    rigs: Sequence[RigMotion | None] | None = None,
    labels: Tensor | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
    splatting: str = "auto",
) -> RenderedBatch:
    """Render each picture of a batch in its own weather, on the images' device.

    The particles and the uneven fog are those of `render`, made on the CPU and uploaded; everything
    per pixel is torch. See the module's text for what is equal to `render` bit by bit.

    Convention:
        Gradients flow from `image` to `images`, and nowhere else; the tone curve is interpolated
        between 8-bit levels, and at a level its slope is that of the interval above. float16 and
        bfloat16 are computed in float32; transmittance and depth then come back in float32.
        Pictures are worked on one after the other, so that memory beyond the result does not grow
        with the batch (but for what autograd keeps).

    Args:
        images: (B, 3, H, W) sRGB in [0, 1], floating point, on a CPU or CUDA device.
        depth_m: (B, H, W) or (B, 1, H, W) z-depth in metres on the same device; what is not in
            (0, 60000) is far.
        cameras: B cameras of the pictures' size.
        weathers: B weathers.
        seeds: B seeds, as in `render`.
        ambiences: B lights.
        times_s: B times, seconds.
        airs: B motions of the air, as in `render`; None where the weather has been the same since
            time 0.
        shelters: B maps of bridges and roofs; None for an open sky.
        rigs: B motions of the reference camera, for options that carry the particles along with it.
        labels: (B, H, W) integer train ids on the same device; they decide where the sky is.
        options: Choices besides the weather, but for multiple scattering and presets.
        splatting: How particles are drawn: "compiled" by the kernels of `render` (CPU only),
            "torch", "gsplat" (CUDA only), or "auto": compiled on a CPU, on CUDA gsplat where it is
            installed and else torch.

    Raises:
        ArgumentError: If an argument has another shape, range, length, dtype or device than stated,
            or the options ask for what only `render` draws.
        MissingExtraError: If gsplat is asked for and it or its CUDA code is missing.
    """
    check_tensors(images, depth_m, labels)
    check_options(options)
    splatting = splatting_on(splatting, images.device)
    count = len(images)
    cameras = one_each("cameras", cameras, Camera, count)
    check_cameras(cameras, images)
    per_picture = zip(
        cameras,
        one_each("weathers", weathers, Weather, count),
        [check_seed("seeds", seed) for seed in one_each("seeds", seeds, object, count)],
        one_each("ambiences", ambiences, Ambience, count),
        [finite("times_s", time_s) for time_s in one_each("times_s", times_s, object, count)],
        one_each("airs", airs, Air, count, optional=True),
        one_each("rigs", rigs, RigMotion, count, optional=True),
        one_each("shelters", shelters, Shelter, count, optional=True),
        strict=True,
    )
    dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
    depth = _clean_depth(depth_m.detach().reshape(-1, *images.shape[2:]).to(dtype), labels)
    shots = []
    for k, (camera, weather, seed, ambience, time_s, air, rig, shelter) in enumerate(per_picture):
        air = air or air_of(weather, time_s, seed)
        job = Job(camera, weather, seed, ambience, time_s, air, rig, shelter, options, splatting)
        label = None if labels is None else labels[k]
        image = images[k].to(dtype).contiguous()
        shots.append(_rendered(image, depth[k], label, job))
    found = [shot.label for shot in shots if shot.label is not None]
    return RenderedBatch(
        image=torch.stack([shot.image for shot in shots]).to(images.dtype),
        label=torch.stack(found) if found else None,
        invalid=torch.stack([shot.invalid for shot in shots]),
        transmittance=torch.stack([shot.transmittance for shot in shots]),
        depth=depth,
    )


class _Shot(NamedTuple):
    """One picture of a RenderedBatch, without its depth."""

    image: Tensor
    label: Tensor | None
    invalid: Tensor
    transmittance: Tensor


def _rendered(image: Tensor, depth: Tensor, label: Tensor | None, job: Job) -> _Shot:
    if job.weather.is_clear:
        invalid = torch.zeros(depth.shape, dtype=torch.uint8, device=depth.device)
        kept = None if label is None else label.clone()
        return _Shot(image.clone(), kept, invalid, torch.ones_like(depth))
    particles = Particles.of(job)
    air = AirColumn.of(particles.medium, particles.optics, particles.carried, image)
    rays = pixel_rays(job.camera, image)
    sky = batch_shade.neighbourhood(torch.isinf(depth)) if label is None else label == SKY
    clear = _clear_share(depth, rays, air, job)
    layer = particle_layer(particles, air, depth.float())
    at_once = ROWS_AT_ONCE if image.device.type == "cpu" else len(depth)
    bands = []
    for top in range(0, len(depth), at_once):
        rows = slice(top, top + at_once)
        tangents = (rays[0], rays[1][rows])
        behind = (image[:, rows], sky[rows], tangents, clear[rows])
        bands.append(_shaded(*behind, layer.rows(rows), air, job))
    shaded, gap = (torch.cat(parts, dim=-2) for parts in zip(*bands, strict=True))
    through = clear * layer.through.to(clear.dtype)
    distinct = gap * through >= least_linear_contrast(job.ambience.airlight)
    honest, invalid = batch_shade.readable(
        label, torch.isinf(depth), through, distinct, layer.covered
    )
    return _Shot(shaded, honest, invalid, through)


def _shaded(
    image: Tensor,
    sky: Tensor,
    rays: tuple[Tensor, Tensor],
    clear: Tensor,
    layer: Layer,
    air: AirColumn,
    job: Job,
) -> tuple[Tensor, Tensor]:
    """Rows of the picture, and how far (linear light) their surfaces are from the airlight."""
    airlight = image.new_tensor(job.ambience.airlight)
    toned = batch_shade.toned_light(image, sky, rays, job.weather.overcast, job.ambience, air)
    seen = layer.over(batch_shade.veiled(toned, clear, airlight))
    gap = (toned.detach() - airlight[:, None, None]).abs().amax(dim=0)
    return batch_shade.encoded(seen), gap


def _clear_share(depth: Tensor, rays: tuple[Tensor, Tensor], air: AirColumn, job: Job) -> Tensor:
    """(H, W) transmittance of the air alone, patches and puffs of the fog included."""
    camera, axes = job.camera, job.ambience.axes_world
    whole = (0, 0, camera.height, camera.width)
    volume = fog_volume_of(job.weather, camera, whole, job.seed, job.air, axes)
    reach_m = air.reach_m(depth, *rays)
    share = fog_shares(volume, reach_m) if len(volume.share) else None
    return torch.exp(-air.optical_depth(reach_m, *rays, share))


def _clean_depth(depth: Tensor, labels: Tensor | None) -> Tensor:
    """(B, H, W) with far, unknown and sky as `inf`."""
    known = (depth > 0) & (depth < FAR_DEPTH_M)
    if labels is not None:
        known = known & (labels != SKY)
    return depth.masked_fill(~known, torch.inf)
