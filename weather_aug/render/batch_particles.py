"""The particles of one picture of a batch: which ones, and by which of three ways they are drawn.

They are enumerated on the CPU by the field that `render` asks, with the same budget; a record has
the same bits. "compiled" hands them to the kernels of `render` (CPU only), "torch" to
`batch_splat`, "gsplat" to `batch_gsplat`.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.air import Air
from weather_aug.clip.types import Camera
from weather_aug.edit.ambience import Ambience
from weather_aug.errors import ArgumentError, printable
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import Resolved
from weather_aug.particles.shelter import Shelter, exposed
from weather_aug.render.batch_gsplat import splat_gsplat
from weather_aug.render.batch_medium import AirColumn
from weather_aug.render.batch_project import concatenated, project
from weather_aug.render.batch_splat import Layer, empty_layer, splat
from weather_aug.render.fields import RigMotion, fields_of, resolved_of, splats_of
from weather_aug.render.light import particle_colour
from weather_aug.render.medium import Medium, Optics
from weather_aug.render.options import RenderOptions
from weather_aug.render.project import BAND_ROWS, LARGE, split_by_band
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.render.tile import TILE_FLOATS, blend_band, cover_splat
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]

SPLATTING = ("auto", "compiled", "torch", "gsplat")


@dataclass(frozen=True, eq=False)
class Job:
    """What one picture is to become."""

    camera: Camera
    weather: Weather
    seed: int
    ambience: Ambience
    time_s: float
    air: Air
    rig: RigMotion | None
    shelter: Shelter | None
    options: RenderOptions
    splatting: str


@dataclass(frozen=True, eq=False)
class Particles:
    """What falls in one picture and what the camera resolves of it."""

    job: Job
    fields: list[ParticleField]
    resolved: list[Resolved]
    carried: Float32
    """Optical depth of drawn particles by depth."""
    optics: Optics
    medium: Medium

    @classmethod
    def of(cls, job: Job) -> Particles:
        """As `render` takes them."""
        weather, axes = job.weather, job.ambience.axes_world
        fields = fields_of(weather, job.seed, job.air, axes, job.options, job.rig)
        resolved, carried = resolved_of(fields, job.camera, job.options.max_particles)
        optics = optics_of(job.camera, axes[2])
        medium = medium_of(weather, fields, job.ambience)
        return cls(job, fields, resolved, carried, optics, medium)

    @property
    def light(self) -> Ambience:
        """What the particles are lit by: the light under the weather's sky."""
        return self.job.ambience.under(self.job.weather.overcast)

    def records(self, index: int) -> Float32:
        """(N, 13) particles of one field that the sky has let fall, in camera axes."""
        job, field = self.job, self.fields[index]
        window = (0, 0, job.camera.height, job.camera.width)
        found = field.particles(job.camera, job.time_s, self.resolved[index], window)
        return exposed(found, job.camera, field.air.wind_m_per_s, job.shelter)


def splatting_on(splatting: str, device: torch.device) -> str:
    """How particles are drawn on a device: "compiled", "torch" or "gsplat".

    Raises:
        ArgumentError: If there is no such way, or not on this device.
    """
    if splatting not in SPLATTING:
        raise ArgumentError(
            f"splatting must be one of {', '.join(SPLATTING)}, got {printable(splatting)!r}"
        )
    if splatting == "auto":
        if device.type == "cpu":
            return "compiled"
        return "torch" if importlib.util.find_spec("gsplat") is None else "gsplat"
    needed = {"gsplat": "cuda", "compiled": "cpu"}.get(splatting, device.type)
    if device.type != needed:
        raise ArgumentError(
            f"splatting={splatting!r} needs images on {needed}, got {device}; use 'torch'"
        )
    return splatting


@torch.no_grad()
def particle_layer(particles: Particles, air: AirColumn, depth_m: Tensor) -> Layer:
    """All particles of the picture, drawn on the depth's device.

    Args:
        particles: Of the picture.
        air: In front of them.
        depth_m: (H, W) float32 depth of the surfaces, `inf` for the sky.
    """
    job = particles.job
    if not particles.fields:
        return empty_layer(depth_m)
    if job.splatting == "compiled":
        return _compiled_layer(particles, depth_m)
    airlight = depth_m.new_tensor(job.ambience.airlight)
    parts = []
    for index, field in enumerate(particles.fields):
        colour = depth_m.new_tensor(particle_colour(field.population.kind, particles.light))
        records = torch.from_numpy(particles.records(index)).to(depth_m.device)
        parts.append(project(records, job.camera, air, colour, airlight))
    draw = splat if job.splatting == "torch" else splat_gsplat
    return draw(concatenated(parts).far_to_near(), depth_m)


def _compiled_layer(particles: Particles, depth_m: Tensor) -> Layer:
    """The particles as the kernels of `render` blend them, over black."""
    job, depth = particles.job, depth_m.numpy()
    height, width = depth.shape
    window = (0, 0, height, width)
    splats = splats_of(
        job.camera,
        job.time_s,
        particles.fields,
        particles.resolved,
        particles.light,
        particles.optics,
        particles.medium,
        particles.carried,
        window,
        job.shelter,
    )
    splats, starts = split_by_band(splats, window, -(-height // BAND_ROWS))
    # As `shade` lays a band out: red, green, blue, transmittance and depth of a row side by side.
    stride = (width + 15) // 16 * 16 + 80
    planes = np.zeros((BAND_ROWS, 5, stride), np.float32)
    tiles = np.empty((BAND_ROWS // 4, stride // 4, TILE_FLOATS), np.float32)
    layer = empty_layer(depth_m)
    light, through = layer.light.numpy(), layer.through.numpy()
    covered = np.zeros((height, width), np.uint8)
    for band, top in enumerate(range(0, height, BAND_ROWS)):
        mine = splats[starts[band] : starts[band + 1]]
        rows = slice(top, min(top + BAND_ROWS, height))
        drawn = planes[: rows.stop - top, :, :width]
        drawn[:, :3], drawn[:, 3], drawn[:, 4] = 0.0, 1.0, depth[rows]
        blend_band(mine, window, top, planes, tiles)
        for large in mine[mine[:, LARGE] > 0]:
            cover_splat(large, (top, rows.stop), window, planes, covered)
        light[:, rows], through[rows] = drawn[:, :3].transpose(1, 0, 2), drawn[:, 3]
    return Layer(layer.light, layer.through, torch.from_numpy(covered).bool())
