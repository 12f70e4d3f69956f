"""A batch of frames in weather, in torch, on the tensors' own device.

The same pictures as `render`'s with the same options, which must leave out what is drawn after the
particles and beside them (`UNDRAWN`: lamps, what vehicles raise, wet glass and the sensor). What
has the same bits: depth; what the editor knows of a picture; the particles' records; on a CPU the
shares of uneven fog; with splatting "compiled" also the particles' shapes and their order. What has
not: background, air and encoding are computed with the exact exp and powers here, by polynomials
there; with "torch" and "gsplat" footprints are, too, and particles are sorted by their exact depth
rather than by 4096 keys. Neither the background nor the picture is quantised here. A picture
differs by less than a level nearly everywhere (above 45 dB, and 50 dB as a rule), and its
transmittance by less than 0.01.

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
from weather_aug.clip.types import FAR_DEPTH_M, Camera, Frame
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.edit.physical.look import changes_background
from weather_aug.particles.shelter import Shelter
from weather_aug.render import batch_shade
from weather_aug.render.background import looked_at
from weather_aug.render.batch_checks import (
    BATCH_OPTIONS,
    check_cameras,
    check_layers,
    check_options,
    check_tensors,
    one_each,
)
from weather_aug.render.batch_dress import Dressing
from weather_aug.render.batch_fog import fog_shares
from weather_aug.render.batch_label import frame_of, honest
from weather_aug.render.batch_medium import AirColumn, pixel_rays
from weather_aug.render.batch_particles import Job, Particles, particle_layer, splatting_on
from weather_aug.render.batch_splat import Layer
from weather_aug.render.fields import RigMotion
from weather_aug.render.fog import fog_volume_of
from weather_aug.render.label import least_linear_contrast
from weather_aug.render.options import RenderOptions
from weather_aug.render.taken import camera_in
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
    """(B, H, W) train ids, by `RenderOptions.labels` 255 where the surface cannot be seen; None
    where none were given."""
    invalid: Tensor
    """(B, H, W) uint8, 1 where a surface cannot be told; see `RenderedFrame.invalid`."""
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
    layers: Sequence[Layers | None] | None = None,
    labels: Tensor | None = None,
    options: RenderOptions = BATCH_OPTIONS,
    splatting: str = "auto",
) -> RenderedBatch:
    """Render each picture of a batch in its own weather, on the images' device.

    What the editor knows of a picture, the particles and the uneven fog are those of `render`, made
    on the CPU and uploaded; all light is torch. Labels are judged on the CPU. See the module's text
    for what is equal to `render` bit by bit.

    Convention:
        Gradients flow from `image` to `images`, also through the edited background, and nowhere
        else: what the editor finds out by looking (`layers`) is constant. The tone curve is
        interpolated between 8-bit levels, and at a level its slope is that of the interval above.
        Where a background is brighter than white its slope is 0. float16 and
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
        layers: What the editor knows of each picture, as in `render`; where None it looks at the
            picture now, on the CPU and rounded to 8-bit levels, which takes longer than all else.
        labels: (B, H, W) integer train ids on the same device; they decide where the sky is, and
            what holds water and snow.
        options: Choices besides the weather, but for multiple scattering and presets; `without`
            must hold `UNDRAWN`. Pass the same ones to `render` for the same picture.
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
        check_layers(one_each("layers", layers, Layers, count, optional=True), images),
        strict=True,
    )
    dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
    depth = _clean_depth(depth_m.detach().reshape(-1, *images.shape[2:]).to(dtype), labels)
    shots = []
    for k, (camera, weather, seed, ambience, time_s, air, rig, shelter, known) in enumerate(
        per_picture
    ):
        air = air or air_of(weather, time_s, seed)
        camera = camera_in(camera, weather, options)
        job = Job(camera, weather, seed, ambience, time_s, air, rig, shelter, options, splatting)
        label = None if labels is None else labels[k]
        image = images[k].to(dtype).contiguous()
        shots.append(_rendered(image, depth[k], label, known, job))
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


def _rendered(
    image: Tensor, depth: Tensor, label: Tensor | None, layers: Layers | None, job: Job
) -> _Shot:
    if job.weather.is_clear:
        invalid = torch.zeros(depth.shape, dtype=torch.uint8, device=depth.device)
        kept = None if label is None else label.clone()
        return _Shot(image.clone(), kept, invalid, torch.ones_like(depth))
    particles = Particles.of(job)
    air = AirColumn.of(particles.medium, particles.optics, particles.carried, image)
    rays = pixel_rays(job.camera, image)
    frame = frame_of(image, depth, label, job.camera, job.time_s)
    dressing = _dressing(frame, depth, layers, job)
    clear = _clear_share(depth, rays, air, job)
    layer = particle_layer(particles, air, depth.float())
    at_once = ROWS_AT_ONCE if image.device.type == "cpu" else len(depth)
    bands = []
    for top in range(0, len(depth), at_once):
        rows = slice(top, min(top + at_once, len(depth)))
        light = _background(image[:, rows], depth[rows], (rays[0], rays[1][rows]), rows, dressing)
        bands.append(_shaded(light, clear[rows], layer.rows(rows), job))
    shaded, gap = (torch.cat(parts, dim=-2) for parts in zip(*bands, strict=True))
    through = clear * layer.through.to(clear.dtype)
    distinct = gap * through >= least_linear_contrast(job.ambience.airlight)
    read, invalid = honest(label, frame, through, distinct, layer.covered, job.weather, job.options)
    return _Shot(shaded, read, invalid, through)


def _dressing(frame: Frame, depth: Tensor, layers: Layers | None, job: Job) -> Dressing | None:
    """How the weather changes the background, or None where it leaves it as it is."""
    if not changes_background(job.weather, job.options.without):
        return None
    camera, weather, ambience = job.camera, job.weather, job.ambience
    if layers is None:
        layers = looked_at(frame, ambience)
    numbers = (depth, camera, weather, ambience, job.time_s, job.options.without)
    return Dressing.of(layers, *numbers, labelled=frame.label is not None)


def _background(
    image: Tensor,
    depth: Tensor,
    rays: tuple[Tensor, Tensor],
    rows: slice,
    dressing: Dressing | None,
) -> Tensor:
    """Linear light (3, R, W) of rows of the picture before there is weather in the air."""
    if dressing is None:
        return batch_shade.decoded(image, image.new_tensor(SRGB_LEVELS_LINEAR))
    return dressing.light(image, depth, rays, rows)


def _shaded(light: Tensor, clear: Tensor, layer: Layer, job: Job) -> tuple[Tensor, Tensor]:
    """Rows of the picture, and how far (linear light) their surfaces are from the airlight."""
    airlight = light.new_tensor(job.ambience.airlight)
    seen = layer.over(batch_shade.veiled(light, clear, airlight))
    gap = (light.detach() - airlight[:, None, None]).abs().amax(dim=0)
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
