"""A batch of frames in weather, in torch, on the tensors' own device."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.air import Air
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError, printable
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import DEPTH_BINS, FAR_M, Resolved
from weather_aug.render import batch_shade, compose
from weather_aug.render.batch_gsplat import splat_gsplat
from weather_aug.render.batch_medium import AirColumn, pixel_rays
from weather_aug.render.batch_project import concatenated, project
from weather_aug.render.batch_splat import Layer, empty_layer, splat
from weather_aug.render.label import least_linear_contrast
from weather_aug.render.light import Ambience, rain_colour, snow_colour
from weather_aug.render.medium import FAR_DEPTH_M
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.taxonomy import SKY
from weather_aug.weather import Weather

SPLATTING = ("auto", "torch", "gsplat")
NOT_DRAWN = ("fog_patchiness", "fog_puffs", "spray_per_km")
"""Fields of a Weather that `render` draws and this path does not."""


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
    airs: Sequence[Air] | None = None,
    labels: Tensor | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
    splatting: str = "auto",
) -> RenderedBatch:
    """Render each picture of a batch in its own weather, on the images' device.

    The particles are those of `render`: the same field, enumerated on the CPU and uploaded.
    Everything per particle and per pixel is torch. With splatting "torch" the result is the same in
    every run on a device; see `batch_gsplat` for what "gsplat" approximates.

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
        airs: B motions of the air; the weathers' wind since time 0 if None.
        labels: (B, H, W) integer train ids on the same device; they decide where the sky is.
        options: Budget.
        splatting: "torch", "gsplat" (CUDA only), or "auto": gsplat where it is installed and the
            images are on CUDA.

    Raises:
        ArgumentError: If an argument has another shape, range, length, dtype or device than stated,
            or asks for what only `render` draws (patchy fog, fog puffs, spray).
        MissingExtraError: If gsplat is asked for and it or its CUDA code is missing.
    """
    _check_tensors(images, depth_m, labels)
    per_picture = {
        "cameras": (cameras, Camera),
        "weathers": (weathers, Weather),
        "seeds": (seeds, object),
        "ambiences": (ambiences, Ambience),
        "times_s": (times_s, object),
    }
    if airs is not None:
        per_picture["airs"] = (airs, Air)
    for name, (values, kind) in per_picture.items():
        _check_items(name, values, kind, len(images))
    _check_cameras(cameras, images)
    _check_drawable(weathers, options, airs)
    method = _splatting(splatting, images.device)
    dtype = images.dtype if images.dtype in (torch.float32, torch.float64) else torch.float32
    depth = _clean_depth(depth_m.detach().reshape(-1, *images.shape[2:]).to(dtype), labels)
    shots = []
    for k in range(len(images)):
        job = _Job(
            cameras[k],
            weathers[k],
            check_seed("seeds", seeds[k]),
            ambiences[k],
            finite("times_s", times_s[k]),
            None if airs is None else airs[k],
            options,
            method,
        )
        label = None if labels is None else labels[k]
        shots.append(_rendered(images[k].to(dtype), depth[k], label, job))
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


@dataclass(frozen=True, eq=False)
class _Job:
    """What one picture is to become."""

    camera: Camera
    weather: Weather
    seed: int
    ambience: Ambience
    time_s: float
    air: Air | None
    options: RenderOptions
    splatting: str


def _rendered(image: Tensor, depth: Tensor, label: Tensor | None, job: _Job) -> _Shot:
    if job.weather.is_clear:
        invalid = torch.zeros(depth.shape, dtype=torch.uint8, device=depth.device)
        kept = None if label is None else label.clone()
        return _Shot(image.clone(), kept, invalid, torch.ones_like(depth))
    light = job.ambience
    found = _resolved_fields(job)
    air = _air_column(job, found, image)
    rays = pixel_rays(job.camera, image)
    sky = batch_shade.neighbourhood(torch.isinf(depth)) if label is None else label == SKY
    airlight = image.new_tensor(light.airlight)
    toned = batch_shade.toned_light(image, sky, rays, job.weather.overcast, light, air)
    clear = torch.exp(-air.optical_depth(depth, *rays))
    layer = _particle_layer(job, found, air, depth.float())
    seen = layer.over(batch_shade.veiled(toned, clear, airlight))
    through = clear * layer.through.to(clear.dtype)
    gap = (toned.detach() - airlight[:, None, None]).abs().amax(dim=0)
    distinct = gap * through >= least_linear_contrast(light.airlight)
    honest, invalid = batch_shade.readable(label, through, distinct, layer.covered)
    return _Shot(batch_shade.encoded(seen), honest, invalid, through)


def _resolved_fields(job: _Job) -> list[tuple[ParticleField, Resolved]]:
    """The same fields and budgets as `render` takes: the one place that knows how to ask."""
    weather, drift_m = job.weather, None
    if job.air is not None:
        weather = replace(weather, wind_m_per_s=job.air.wind_m_per_s)
        drift_m = job.air.drift_m
    particle_fields = compose._fields(weather, job.seed, job.ambience, drift_m)
    budget = job.options.max_particles // max(len(particle_fields), 1)
    return [(field, field.resolve(job.camera, budget)) for field in particle_fields]


def _records(field: ParticleField, resolved: Resolved, job: _Job) -> NDArray[np.float32]:
    """(N, 13) particles in camera axes; see `batch_project.project`."""
    window = (0, 0, job.camera.height, job.camera.width)
    found = field.particles(job.camera, job.time_s, resolved, window)
    # MERGE: once the field writes (N, 13), return `found` and drop `_records_of_discs`.
    return found if found.shape[1] == 13 else _records_of_discs(found)


def _records_of_discs(discs: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 13) records of (N, 7) position, velocity, diameter: discs as Gaussians of equal area."""
    records = np.zeros((len(discs), 13), np.float32)
    records[:, :6] = discs[:, :6]
    records[:, [6, 9, 11]] = (discs[:, 6:] ** 2) / 8
    records[:, 12] = 1
    return records


def _air_column(job: _Job, found: list[tuple[ParticleField, Resolved]], like: Tensor) -> AirColumn:
    carried = np.zeros(DEPTH_BINS + 1, np.float32)
    for _, resolved in found:
        carried = carried + resolved.optical_depth
    up = job.camera.world_from_camera[:3, :3].T @ job.ambience.axes_world[2]
    return AirColumn(
        fog_per_m=job.weather.fog_per_m,
        inverse_height_per_m=1.0 / job.weather.fog_scale_height_m,
        haze_per_m=job.weather.mist_per_km * 1e-3,
        precipitation_per_m=sum(f.population.extinction_per_m for f, _ in found),
        resolved_depth=torch.from_numpy(carried).to(like.device),
        resolved_step_m=FAR_M / DEPTH_BINS,
        up_camera=(float(up[0]), float(up[1]), float(up[2])),
    )


@torch.no_grad()
def _particle_layer(
    job: _Job, found: list[tuple[ParticleField, Resolved]], air: AirColumn, depth: Tensor
) -> Layer:
    """All particles of the picture, drawn on the depth's device."""
    light = job.ambience.under(job.weather.overcast)
    colours = {"rain": rain_colour, "snow": snow_colour}
    airlight = depth.new_tensor(job.ambience.airlight)
    parts = []
    for field, resolved in found:
        colour = depth.new_tensor(colours[field.population.kind](light))
        particles = torch.from_numpy(_records(field, resolved, job)).to(depth.device)
        parts.append(project(particles, job.camera, air, colour, airlight))
    if not parts:
        return empty_layer(depth)
    draw = splat if job.splatting == "torch" else splat_gsplat
    return draw(concatenated(parts).far_to_near(), depth)


def _clean_depth(depth: Tensor, labels: Tensor | None) -> Tensor:
    """(B, H, W) with far, unknown and sky as `inf`."""
    known = (depth > 0) & (depth < FAR_DEPTH_M)
    if labels is not None:
        known = known & (labels != SKY)
    return depth.masked_fill(~known, torch.inf)


def _check_tensors(images: Any, depth_m: Any, labels: Any) -> None:
    for name, tensor in (("images", images), ("depth_m", depth_m), ("labels", labels)):
        if not isinstance(tensor, Tensor) and not (name == "labels" and tensor is None):
            raise ArgumentError(f"{name} must be a torch tensor, got {type(tensor).__name__}")
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] != 3 or 0 in shape:
        raise ArgumentError(f"images must have shape (B, 3, H, W) without zeros, got {shape}")
    if not images.dtype.is_floating_point:
        raise ArgumentError(f"images must be floating point in [0, 1], got {images.dtype}")
    if images.device.type not in ("cpu", "cuda"):
        raise ArgumentError(f"images must be on a CPU or CUDA device, got {images.device}")
    planes = (shape[0], *shape[2:])
    if tuple(depth_m.shape) not in (planes, (shape[0], 1, *shape[2:])):
        raise ArgumentError(
            f"depth_m must have shape {planes}, with or without an axis of 1 after the first, got "
            f"{tuple(depth_m.shape)}; crop and resize it together with the images"
        )
    if not depth_m.dtype.is_floating_point:
        raise ArgumentError(f"depth_m must be floating point, in metres, got {depth_m.dtype}")
    if labels is not None:
        if tuple(labels.shape) != planes:
            raise ArgumentError(f"labels must have shape {planes}, got {tuple(labels.shape)}")
        if labels.dtype not in (torch.uint8, torch.int16, torch.int32, torch.int64):
            raise ArgumentError(f"labels must be uint8 or a wider integer, got {labels.dtype}")
    for name, tensor in (("depth_m", depth_m), ("labels", labels)):
        if tensor is not None and tensor.device != images.device:
            raise ArgumentError(
                f"{name} must be on the images' device {images.device}, got {tensor.device}"
            )
    low, high = (float(v) for v in torch.aminmax(images.detach()))
    if not (low >= 0.0 and high <= 1.0):
        raise ArgumentError(f"images must be in [0, 1], got [{low:g}, {high:g}]; clamp or rescale")


def _check_items(name: str, values: Any, kind: type, count: int) -> None:
    try:
        items = list(values)
    except TypeError:
        raise ArgumentError(f"{name} must be a sequence, one item a picture") from None
    if len(items) != count:
        raise ArgumentError(
            f"{name} must have one item for each of {count} pictures, got {len(items)}"
        )
    for item in items:
        if not isinstance(item, kind):
            raise ArgumentError(
                f"{name} must hold {kind.__name__} objects, got {type(item).__name__}"
            )


def _check_cameras(cameras: Sequence[Camera], images: Tensor) -> None:
    height, width = images.shape[2:]
    for camera in cameras:
        if (camera.height, camera.width) != (height, width):
            raise ArgumentError(
                f"cameras must be of the images' size {height}x{width}, got "
                f"{camera.height}x{camera.width}; use Camera.resized"
            )


def _check_drawable(
    weathers: Sequence[Weather], options: RenderOptions, airs: Sequence[Air] | None
) -> None:
    """Refuse what would be left out, because a silent difference from `render` is worse."""
    if not isinstance(options, RenderOptions):
        raise ArgumentError(f"options must be RenderOptions, got {type(options).__name__}")
    for field in fields(options):
        drawn = field.name == "max_particles"
        if not drawn and getattr(options, field.name) != getattr(DEFAULT_OPTIONS, field.name, None):
            raise ArgumentError(f"options.{field.name} is not supported in a batch; use render")
    for weather in weathers:
        for name in NOT_DRAWN:
            if getattr(weather, name, 0.0):
                raise ArgumentError(
                    f"weathers: {name} = {getattr(weather, name)!r} is not drawn in a batch; set "
                    "it to 0 or use render"
                )
        for name in ("gustiness", "snow_wetness"):
            if getattr(weather, name, 0.0) and airs is None:
                raise ArgumentError(f"weathers: {name} needs airs, the motion of the air over time")


def _splatting(splatting: str, device: torch.device) -> str:
    if splatting not in SPLATTING:
        raise ArgumentError(
            f"splatting {printable(splatting)!r} is not one of {', '.join(SPLATTING)}"
        )
    if splatting == "gsplat" and device.type != "cuda":
        raise ArgumentError(f"splatting='gsplat' needs images on CUDA, got {device}; use 'torch'")
    if splatting != "auto":
        return splatting
    here = device.type == "cuda" and importlib.util.find_spec("gsplat") is not None
    return "gsplat" if here else "torch"
