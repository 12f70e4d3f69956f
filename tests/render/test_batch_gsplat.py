"""What surrounds gsplat: its arguments, and the scene's depth, which it does not know."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from batch_scene import WEATHERS, Case, arguments, street

from weather_aug.errors import MissingExtraError
from weather_aug.render import batch_gsplat, batch_particles, batch_splat
from weather_aug.render.batch import BATCH_OPTIONS, render_batch
from weather_aug.render.batch_gsplat import splat_in_slabs, surfaces_under
from weather_aug.render.batch_splat import empty_layer, splat


@pytest.fixture(scope="module")
def scene():
    """Splats of a snowfall, far to near, and the depth of the street behind it."""
    case = Case(street("driving"), WEATHERS["rain and snow"])
    caught = {}

    def catch(splats, depth):
        caught["scene"] = (splats, depth)
        return empty_layer(depth)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_particles, "splat", catch)
        # A shutter that stays open in the dark would leave no drop to resolve, and one colour.
        sharp = replace(BATCH_OPTIONS, without=(*BATCH_OPTIONS.without, "exposure"))
        render_batch(**arguments([case]), options=sharp)
    return caught["scene"]


class StandIn(SimpleNamespace):
    """gsplat's three functions in plain torch: near to far, every pixel of every splat.

    Pixel centres are at one half, fainter than 1/255 is skipped, and a tile sees only the splats
    whose radii reach it, so that wrong arguments show.
    """

    def isect_tiles(self, means2d, radii, depths, tile_size, tile_width, tile_height):
        assert means2d.shape == (1, depths.shape[1], 2)
        assert radii.shape == means2d.shape
        assert radii.dtype == torch.int32
        low = torch.floor((means2d - radii) / tile_size)
        high = torch.ceil((means2d + radii) / tile_size)
        self.tiles = [low[0], high[0]]
        self.grid = (tile_height, tile_width)
        order = torch.argsort(depths[0], stable=True)
        return None, order, order

    def isect_offset_encode(self, isect_ids, n_images, tile_width, tile_height):
        assert (tile_height, tile_width) == self.grid
        return torch.zeros((n_images, tile_height, tile_width), dtype=torch.int32)

    def rasterize_to_pixels(
        self, means2d, conics, colors, opacities, width, height, tile_size, offsets, flatten_ids
    ):
        assert offsets.shape[1] * tile_size >= height
        assert offsets.shape[2] * tile_size >= width
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        light, through = torch.zeros(height, width, 3), torch.ones(height, width)
        for i in flatten_ids.tolist():
            dx, dy = u + 0.5 - means2d[0, i, 0], v + 0.5 - means2d[0, i, 1]
            a, b, c = conics[0, i]
            alpha = opacities[0, i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            low, high = self.tiles[0][i], self.tiles[1][i]
            inside = (u // tile_size >= low[0]) & (u // tile_size < high[0])
            inside &= (v // tile_size >= low[1]) & (v // tile_size < high[1])
            alpha = torch.where(inside & (alpha >= 1 / 255), alpha, 0.0)
            light += (alpha * through)[..., None] * colors[0, i]
            through = through * (1 - alpha)
        return light[None], (1 - through)[None, ..., None]


def torch_twin(splats, height, width):
    layer = splat(splats, torch.full((height, width), torch.inf))
    return layer.light, layer.through


def difference(layer, expected):
    light = (layer.light - expected.light).square().mean().sqrt()
    return float(light), float((layer.through - expected.through).abs().max())


def test_bounds_hold_the_surfaces_under_a_footprint(scene):
    splats, depth = scene
    nearest, farthest = surfaces_under(splats, depth)
    for i in range(0, len(splats), 7):
        u, v, (half_u, half_v) = float(splats.u[i]), float(splats.v[i]), splats.half[i].tolist()
        rows = slice(max(int(np.ceil(v - half_v)), 0), max(int(np.floor(v + half_v)) + 1, 0))
        columns = slice(max(int(np.ceil(u - half_u)), 0), max(int(np.floor(u + half_u)) + 1, 0))
        under = depth[rows, columns]
        if under.numel():
            assert nearest[i] <= under.min()
            assert farthest[i] >= under.max()


def test_slabs_agree_with_exact_order(scene):
    splats, depth = scene
    # Each slab's large splats are drawn behind its others; without any there is no approximation.
    splats = replace(splats, large=splats.half.amax(dim=1) > 3)
    exact = splat(splats, depth)
    assert exact.through.min() < 0.7
    light, through = difference(splat_in_slabs(splats, depth, torch_twin, 4), exact)
    assert light > 1e-7
    assert light < 1e-3
    assert through < 1e-5
    one, _ = difference(splat_in_slabs(splats, depth, torch_twin, 1), exact)
    assert one >= light


def test_large_splats_cover_as_in_exact_order(scene, monkeypatch):
    splats, depth = scene
    monkeypatch.setattr(batch_splat, "HIDING_ALPHA", 0.2)
    splats = replace(splats, large=splats.half.amax(dim=1) > 3)
    exact = splat(splats, depth)
    assert exact.covered.any()
    assert torch.equal(exact.covered, splat_in_slabs(splats, depth, torch_twin, 4).covered)


def test_most_splats_go_to_the_rasteriser(scene):
    splats, depth = scene
    sent = []

    def count(splats, height, width):
        sent.append(len(splats))
        return torch_twin(splats, height, width)

    splat_in_slabs(splats, depth, count, 4)
    assert sum(sent) > 0.5 * len(splats)


def test_without_the_depth_test_particles_shine_through_walls(scene, monkeypatch):
    splats, depth = scene
    far = torch.full_like(splats.z_m, torch.inf)
    monkeypatch.setattr(batch_gsplat, "surfaces_under", lambda *_: (far, far))
    _, through = difference(splat_in_slabs(splats, depth, torch_twin, 4), splat(splats, depth))
    assert through > 0.01


def test_gsplat_gets_what_it_expects(scene, monkeypatch):
    splats, _ = scene
    few = splats.take(torch.arange(len(splats) - 150, len(splats)))
    monkeypatch.setitem(sys.modules, "gsplat", StandIn())
    light, through = batch_gsplat.rasterise(few, 96, 160)
    expected_light, expected_through = torch_twin(few, 96, 160)
    assert (expected_through < 0.9).any()
    torch.testing.assert_close(through, expected_through, atol=0.01, rtol=0)
    torch.testing.assert_close(light, expected_light, atol=0.01, rtol=0)
    assert (through - expected_through).abs().mean() < 1e-4


def test_gsplat_without_its_cuda_code_is_named(scene, monkeypatch):
    """As gsplat 1.5.3 ends where it could not compile itself."""
    splats, _ = scene
    broken = SimpleNamespace(isect_tiles=lambda *_: None.intersect_tile)
    monkeypatch.setitem(sys.modules, "gsplat", broken)
    with pytest.raises(MissingExtraError, match="CUDA code"):
        batch_gsplat.rasterise(splats, 96, 160)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gsplat_agrees_with_torch():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    inputs = arguments([Case(street("driving"), weather) for weather in WEATHERS.values()])
    for name in ("images", "depth_m", "labels"):
        inputs[name] = inputs[name].cuda()
    exact = render_batch(**inputs)
    fast = render_batch(**(inputs | {"splatting": "gsplat"}))
    error = (fast.image - exact.image).square().mean(dim=(1, 2, 3))
    assert (10 * torch.log10(1 / error) >= 45).all()
    assert (fast.transmittance - exact.transmittance).abs().max() < 0.01
    assert (fast.label != exact.label).float().mean() <= 1e-3
