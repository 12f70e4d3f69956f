"""A picture's background in the weather, in torch; the formulas of `edit.physical.dress`.

What the editor knows of the picture (its classes, its maps, the noise) is constant; gradients flow
through the light, the luma and the feature of the sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug._compiled import compiled
from weather_aug.clip.types import Camera
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.dress import MAPS, OBJECT_GAINS
from weather_aug.edit.physical.edit import geometry_of, tone_tables
from weather_aug.edit.physical.layer_rows import load_row
from weather_aug.edit.physical.layers import GROUND_GAIN, MATTE, OBJECT_GAIN, Layers
from weather_aug.edit.physical.look import look_of
from weather_aug.edit.physical.materials import GROUND, POROSITY, material_table
from weather_aug.edit.physical.noise_rows import OTHER_M
from weather_aug.edit.physical.relight import SKY_FEATURE
from weather_aug.edit.surface import shared
from weather_aug.render.batch_dress_grid import Grid, Pixels, plain
from weather_aug.render.batch_dress_ground import dressed_ground, luminance
from weather_aug.render.batch_dress_noise import noise_of_rows
from weather_aug.render.batch_dress_standing import (
    below_top_m,
    holds_snow,
    snowed_standing,
    wet_standing,
)
from weather_aug.render.batch_shade import decoded
from weather_aug.weather import Weather


@compiled
def _under_tone(layers: Any, by_root: Any, matrix: Any, look: Any, out: Any) -> None:
    """All rows of `load_row`."""
    _, rows, columns = layers.shape
    scratch = np.empty((4, columns), np.float32)
    for row in range(rows):
        cells = (row, np.uint64(0), np.uint64(columns))
        load_row(layers, cells, by_root, matrix, look, scratch, out[:, row])


@dataclass(frozen=True, eq=False)
class Dressing:
    """All that a weather does to one picture's surfaces, on the picture's device."""

    look: SimpleNamespace
    """Of the weather, see `edit.physical.look.Look`."""
    geometry: SimpleNamespace
    """See `edit.physical.dress.Geometry`."""
    classes: Tensor
    """(H, W) uint8 train ids, guessed where nobody labelled."""
    table: Tensor
    """(256, 9) materials."""
    maps: Tensor
    """(18, h, w) under the weather's light."""
    sky_cells: NDArray[np.bool_]
    """(h,) whether a row of cells may show sky; on the CPU, where it is asked."""
    step: float
    tint: Tensor
    """(3,) of the ground's gain."""
    curve: Tensor
    """(256,) toned light by sRGB level."""
    matrix: Tensor
    """(3, 3) of the colours after it, with the exposure."""
    below_top_m: Tensor | None
    """(H, W) for snow's caps; None where no snow lies."""

    @classmethod
    def of(
        cls,
        layers: Layers,
        depth_m: Tensor,
        camera: Camera,
        weather: Weather,
        ambience: Ambience,
        time_s: float,
        without: tuple[str, ...],
        *,
        labelled: bool,
    ) -> Dressing:
        """What `edit.physical.edit.edited` gives to its kernels, in the depth's dtype."""
        look = look_of(weather, ambience, layers.illumination, time_s, without)
        curve, by_root, matrix = tone_tables(0.0 if "relight" in without else weather.overcast)
        maps = np.zeros((MAPS, *layers.maps.shape[1:]), np.float32)
        _under_tone(shared(layers.maps.view(np.uint16)), by_root, matrix, look, maps)
        classes = torch.tensor(np.asarray(layers.classes), device=depth_m.device)
        geometry = geometry_of(camera, ambience.axes_world, layers.plane, labelled=labelled)
        tops = below_top_m(classes, depth_m, float(geometry.fy)) if look.snow > 0 else None
        return cls(
            plain(look),
            plain(geometry),
            classes,
            depth_m.new_tensor(material_table(labelled=labelled)),
            depth_m.new_tensor(maps),
            (maps[MATTE : MATTE + 2] != 0).any(axis=(0, 2)),
            layers.step,
            depth_m.new_tensor(layers.tint),
            depth_m.new_tensor(curve),
            depth_m.new_tensor(matrix * float(look.exposure)),
            tops,
        )

    def light(
        self, image: Tensor, depth_m: Tensor, rays: tuple[Tensor, Tensor], rows: slice
    ) -> Tensor:
        """Linear light (3, R, W) in [0, 1] of the picture's rows `rows` in the weather.

        Args:
            image: (3, R, W) sRGB in [0, 1] of these rows.
            depth_m: (R, W), `inf` for what is far.
            rays: Tangents (1, W) and (R, 1).
            rows: With a start and a stop.
        """
        pixels = self._pixels(depth_m, rays, rows)
        grid = Grid.of(self.maps, self.step, rows, image.shape[2])
        recorded, srgb = decoded(image, self.curve).flatten(1), image.flatten(1)
        is_ground = pixels.material[:, GROUND] > 0
        ground = pixels.at(torch.nonzero(is_ground)[:, 0])
        other = pixels.at(torch.nonzero(~is_ground)[:, 0])
        parts = (
            self._on_ground(recorded, srgb, ground, grid),
            self._standing(recorded, srgb, other, grid, rows),
        )
        places = torch.cat((ground.place, other.place))
        light = torch.empty_like(recorded).index_copy(1, places, torch.cat(parts, dim=1))
        if self.look.sky > 0 and self._shows_sky(rows):
            light = self._under_sky(light, srgb, pixels, grid)
        return light.clamp(0.0, 1.0).view_as(image)

    def _pixels(self, depth_m: Tensor, rays: tuple[Tensor, Tensor], rows: slice) -> Pixels:
        count, width = depth_m.shape
        look = self.look
        place = torch.arange(count * width, device=depth_m.device)
        row, column = place[:count, None], place[None, :width]
        material = self.table.index_select(0, self.classes[rows].flatten().int())
        is_ground = (material[:, GROUND] > 0).view_as(depth_m)
        seen = depth_m, is_ground, rays, self.geometry
        noise = lie = torch.full_like(depth_m, 0.5)
        if max(look.snow, look.road_snow) > 0:
            noise = noise_of_rows(*seen, 0.0)
        if min(look.puddles, look.mirror) > 0:
            lie = noise_of_rows(*seen, OTHER_M)
        row, column, depth, ray_x, ray_y = (
            part.expand(count, width).reshape(-1) for part in (row, column, depth_m, *rays)
        )
        noise, lie = noise.flatten(), lie.flatten()
        return Pixels(place, row, column, depth, ray_x, ray_y, material, noise, lie)

    def _on_ground(self, recorded: Tensor, srgb: Tensor, pixels: Pixels, grid: Grid) -> Tensor:
        """(3, N) of road, sidewalk and terrain."""
        light, look = recorded.index_select(1, pixels.place), self.look
        if look.flattening > 0:
            slope, offset, least, most = grid.at(GROUND_GAIN, 4, pixels)
            gain = slope * luminance(srgb.index_select(1, pixels.place)) + offset
            gain = look.flattening * torch.minimum(torch.maximum(gain, least), most)
            light = light * torch.exp(gain + self.tint[:, None] * gain.clamp(min=0.0))
        light = self._toned(light)
        if max(look.film, look.mirror, look.snow, look.road_snow) > 0:
            return dressed_ground(light, pixels, grid, self.geometry, look)
        return light

    def _standing(
        self, recorded: Tensor, srgb: Tensor, pixels: Pixels, grid: Grid, rows: slice
    ) -> Tensor:
        """(3, N) of all else."""
        light, look = recorded.index_select(1, pixels.place), self.look
        if look.flattening > 0:
            slope, offset = grid.at(OBJECT_GAIN, 2, pixels)
            gain = slope * luminance(srgb.index_select(1, pixels.place)) + offset
            least, most = (float(limit) for limit in OBJECT_GAINS)
            light = light * torch.exp(look.flattening * gain.clamp(least, most))
        light = self._toned(light)
        if look.film > 0:
            wet = torch.nonzero(pixels.material[:, POROSITY] > 0)[:, 0]
            new = wet_standing(light.index_select(1, wet), pixels.at(wet), grid, look)
            light = light.index_copy(1, wet, new)
        if self.below_top_m is not None:
            white = torch.nonzero(holds_snow(pixels.material))[:, 0]
            mine = pixels.at(white)
            below_m = self.below_top_m[rows].flatten().index_select(0, mine.place)
            old = light.index_select(1, white)
            new = snowed_standing(old, mine, below_m, grid, self.geometry, look)
            light = light.index_copy(1, white, new)
        return light

    def _toned(self, light: Tensor) -> Tensor:
        """Saturation, white and exposure of light (3, N)."""
        # Not as a matrix product: CUDA and autocast may round what goes into one to 10 bits.
        red, green, blue = self.matrix.unbind(1)
        toned = red[:, None] * light[0] + green[:, None] * light[1]
        return toned + blue[:, None] * light[2]

    def _shows_sky(self, rows: slice) -> bool:
        first = max(int(rows.start / self.step) - 1, 0)
        return bool(self.sky_cells[first : int(rows.stop / self.step) + 2].any())

    def _under_sky(self, light: Tensor, srgb: Tensor, pixels: Pixels, grid: Grid) -> Tensor:
        """Light (3, N) with an overcast sky where the sky is, also between leaves."""
        look, geometry = self.look, self.geometry
        slope, offset = grid.at(MATTE, 2, pixels)
        feature = SKY_FEATURE[0] * srgb[0] + SKY_FEATURE[2] * srgb[2]
        weight = look.sky * (slope * feature + offset).clamp(0.0, 1.0)
        ray_x, ray_y = pixels.ray_x, pixels.ray_y
        climb = pixels.towards(geometry.climb_x, geometry.climb_y, geometry.climb_z)
        sine = climb / torch.sqrt(1.0 + ray_y * ray_y + ray_x * ray_x)
        airlight = light.new_tensor((look.red, look.green, look.blue))
        closed = airlight[:, None] * (1.0 + look.zenith_gain * sine.clamp(min=0.0))
        return light + weight * (closed - light)
