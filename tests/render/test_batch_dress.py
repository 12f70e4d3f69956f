"""The edited background in torch: that of the compiled editor, with gradients."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from batch_scene import AGREEMENT_DB, AMBIENCE, BACKGROUNDS, Case, arguments, batch, psnr, yard
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scene import make_camera, make_frame

from weather_aug._compiled import compiled
from weather_aug.edit.physical.buffer import BELOW_TOP
from weather_aug.edit.physical.fresnel import film_ratio, fresnel
from weather_aug.edit.physical.noise import PERIOD_M, noise_tile
from weather_aug.edit.physical.noise import ground_noise as noise_of_kernel
from weather_aug.edit.physical.standing_rows import caps_row
from weather_aug.errors import ArgumentError
from weather_aug.render import batch as batch_module
from weather_aug.render import (
    batch_dress,
    batch_dress_ground,
    batch_dress_noise,
    batch_dress_ripples,
    batch_dress_standing,
)
from weather_aug.render.background import looked_at
from weather_aug.render.batch import BATCH_OPTIONS, render_batch
from weather_aug.render.batch_dress import Dressing
from weather_aug.render.batch_dress_noise import ground_noise
from weather_aug.render.batch_dress_standing import below_top_m
from weather_aug.render.batch_label import frame_of
from weather_aug.render.options import RenderOptions
from weather_aug.taxonomy import BUILDING, ROAD
from weather_aug.weather import Weather

DRAWN = ("relight", "sky", "film", "mirror", "puddles", "ripples", "snow_cover", "tracks")
ALL_AT_ONCE = Weather(
    overcast=0.9,
    wetness=0.8,
    puddles=0.3,
    snow_cover=0.6,
    road_snow_cover=0.5,
    snow_depth_m=0.06,
)


RAIN = Weather(wetness=1.0, puddles=0.9, rain_mm_per_h=10.0)


def puddle():
    """A road so near that its pixels show rings, mirroring what stands at its end."""
    camera = make_camera(focal_px=4000.0)
    pose = camera.world_from_camera.copy()
    down = np.deg2rad(14.0)
    pose[:3, 1] = (-np.sin(down), 0.0, -np.cos(down))
    pose[:3, 2] = (np.cos(down), 0.0, -np.sin(down))
    camera = replace(camera, world_from_camera=pose)
    v, u = np.mgrid[:96, :160]
    rays = np.stack([(u - 79.5) / 4000.0, (v - 47.5) / 4000.0, np.ones((96, 160))], axis=-1)
    depth = 1.5 / -(rays @ pose[2, :3])
    label = np.full((96, 160), ROAD, np.uint8)
    label[:10] = BUILDING
    image = np.random.default_rng(6).integers(60, 90, (96, 160, 3)).astype(np.uint8)
    image[:10] = 230
    return make_frame(camera, image, depth, label)


@pytest.mark.parametrize("labelled", [True, False])
def test_agrees_with_the_compiled_editor(labelled):
    cases = [Case(yard(labelled=labelled), weather) for weather in BACKGROUNDS.values()]
    shots = batch(cases, splatting="compiled")
    for k, (name, case) in enumerate(zip(BACKGROUNDS, cases, strict=True)):
        expected = case.alone()
        assert psnr(shots.image[k], expected.image) >= AGREEMENT_DB, name
        assert psnr(shots.image[k], case.frame.image) < 40, name
        np.testing.assert_array_equal(expected.invalid, shots.invalid[k].numpy())


@pytest.mark.parametrize("effect", DRAWN)
def test_leaves_out_what_the_compiled_editor_leaves_out(effect):
    options = replace(BATCH_OPTIONS, without=(*BATCH_OPTIONS.without, effect))
    case = Case(puddle(), RAIN) if effect == "ripples" else Case(yard(), ALL_AT_ONCE)
    shot = batch([case], options=options).image[0]
    assert psnr(shot, case.alone(options=options).image) >= AGREEMENT_DB
    assert psnr(shot, case.alone().image) < AGREEMENT_DB - 3


def dry(monkeypatch):
    monkeypatch.setattr(batch_dress_ground, "film", lambda light, *_: light)


def dry_walls(monkeypatch):
    monkeypatch.setattr(batch_dress, "wet_standing", lambda light, *_: light)


def without_mirror(monkeypatch):
    monkeypatch.setattr(batch_dress_ground, "fresnel_of_sine", torch.zeros_like)


def with_other_noise(monkeypatch):
    wrong = lambda along, left, *rest: ground_noise(left, along, *rest)  # noqa: E731
    monkeypatch.setattr(batch_dress_noise, "ground_noise", wrong)


def with_finest_noise(monkeypatch):
    wrong = lambda along, left, size, offset: ground_noise(along, left, 0 * size, offset)  # noqa: E731
    monkeypatch.setattr(batch_dress_noise, "ground_noise", wrong)


def with_knots_of_eight(monkeypatch):
    monkeypatch.setattr(batch_dress_noise, "KNOT_PX", 8)


def without_rings(monkeypatch):
    monkeypatch.setattr(batch_dress_ground, "rippled", lambda shown, *_: shown)


def with_rings_of_another_time(monkeypatch):
    right = batch_dress_ripples.rings

    def wrong(along_m, left_m, look):
        return right(along_m, left_m, SimpleNamespace(**vars(look) | {"time_s": 0.1}))

    monkeypatch.setattr(batch_dress_ripples, "rings", wrong)


def with_white_slush(monkeypatch):
    monkeypatch.setattr(batch_dress_ground, "SLUSH", batch_dress_ground.CLEAN)


def without_tracks(monkeypatch):
    wrong = lambda lateral_m, _: torch.zeros_like(lateral_m)  # noqa: E731
    monkeypatch.setattr(batch_dress_ground, "tracks_at", wrong)


def without_caps(monkeypatch):
    wrong = lambda classes, depth_m, _: torch.full_like(depth_m, 99.0)  # noqa: E731
    monkeypatch.setattr(batch_dress, "below_top_m", wrong)


def with_bare_leaves(monkeypatch):
    wrong = lambda _, amount, __: 0 * amount  # noqa: E731
    monkeypatch.setattr(batch_dress_standing, "_on_leaves", wrong)


def with_white_leaves_as_bright_as_fields(monkeypatch):
    right = batch_dress_standing.snow_light
    monkeypatch.setattr(batch_dress_standing, "snow_light", lambda *a: 1.5 * right(*a))


def with_recorded_sky(monkeypatch):
    monkeypatch.setattr(Dressing, "_shows_sky", lambda *_: False)


def with_sky_by_luma(monkeypatch):
    monkeypatch.setattr(batch_dress, "SKY_FEATURE", (0.3, 0.6, 0.1))


def with_shadows(monkeypatch):
    monkeypatch.setattr(batch_dress, "GROUND_GAIN", batch_dress.OBJECT_GAIN)


def half_a_cell_off(monkeypatch):
    right = batch_dress.Grid.of
    wrong = lambda maps, step, *rest: right(maps.roll(3, dims=2), step, *rest)  # noqa: E731
    monkeypatch.setattr(batch_dress.Grid, "of", wrong)


FAULTS = [
    (dry, "wet"),
    (dry_walls, "wet"),
    (without_mirror, "wet"),
    (with_other_noise, "wet"),
    (with_other_noise, "snowed on"),
    (with_finest_noise, "road snow"),
    (with_knots_of_eight, "snowed on"),
    (with_white_slush, "road snow"),
    (without_tracks, "road snow"),
    (without_caps, "snowed on"),
    (with_bare_leaves, "snowed on"),
    (with_white_leaves_as_bright_as_fields, "after snow"),
    (with_recorded_sky, "overcast"),
    (with_sky_by_luma, "overcast"),
    (with_shadows, "overcast"),
    (half_a_cell_off, "after rain"),
]


@pytest.mark.parametrize(("fault", "name"), FAULTS)
def test_the_agreement_would_notice(fault, name, monkeypatch):
    case = Case(yard(), BACKGROUNDS[name])
    fault(monkeypatch)
    assert psnr(batch([case]).image[0], case.alone().image) < AGREEMENT_DB - 3


def test_rings_are_those_of_the_compiled_editor():
    case = Case(puddle(), RAIN)
    assert psnr(batch([case]).image[0], case.alone().image) >= AGREEMENT_DB


@pytest.mark.parametrize("fault", [without_rings, with_rings_of_another_time])
def test_the_agreement_of_rings_would_notice(fault, monkeypatch):
    case = Case(puddle(), RAIN)
    fault(monkeypatch)
    assert psnr(batch([case]).image[0], case.alone().image) < AGREEMENT_DB - 3


def test_what_the_editor_knows_may_be_given():
    case = Case(yard(), BACKGROUNDS["after snow"])
    known = looked_at(case.frame, AMBIENCE)
    given_, found = (batch([case], layers=layers).image for layers in ([known], None))
    assert torch.equal(given_, found)
    other = looked_at(replace(case.frame, label=np.full_like(case.frame.label, 2)), AMBIENCE)
    assert not torch.equal(batch([case], layers=[other]).image, found)


def test_nobody_looks_at_a_picture_whose_background_stays(monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(batch_module, "looked_at", refuse)
    batch([Case(yard(), Weather(visibility_m=100.0))])
    with pytest.raises(AssertionError):
        batch([Case(yard(), Weather(overcast=0.5))])


def directional(weather, labelled):
    """Slope of the picture's weighted sum along a direction: by autograd, and by differences."""
    inputs = arguments([Case(yard(labelled=labelled), weather)], torch.float64)
    # Off the 8-bit levels, where the interpolated tone curve has its kinks.
    images = (inputs.pop("images") * (254 / 255) + 0.3 / 255).requires_grad_()
    label = None if inputs["labels"] is None else inputs["labels"][0]
    frame = frame_of(images[0], inputs["depth_m"][0], label, inputs["cameras"][0], 0.0)
    inputs["layers"] = [looked_at(frame, AMBIENCE)]
    draw = torch.Generator().manual_seed(4)
    step, weight = (torch.rand(images.shape, generator=draw).double() for _ in range(2))

    def score(pictures):
        return (render_batch(pictures, **inputs).image * weight).sum()

    (gradient,) = torch.autograd.grad(score(images), images)
    with torch.no_grad():
        rise = score(images + 1e-6 * step) - score(images - 1e-6 * step)
    return float((gradient * step).sum()), float(rise / 2e-6)


@pytest.mark.parametrize("labelled", [True, False])
def test_gradients_flow_through_the_editor(labelled):
    found, expected = directional(ALL_AT_ONCE, labelled)
    assert found == pytest.approx(expected, rel=1e-4)


def with_constant_luma(monkeypatch):
    right = batch_dress.luminance
    monkeypatch.setattr(batch_dress, "luminance", lambda srgb: right(srgb).detach())


def with_constant_albedo(monkeypatch):
    right = batch_dress_ground.film
    wrong = lambda light, *a: light * (right(light, *a) / light).detach()  # noqa: E731
    monkeypatch.setattr(batch_dress_ground, "film", wrong)


@pytest.mark.parametrize("fault", [with_constant_luma, with_constant_albedo])
def test_the_gradients_test_would_notice(fault, monkeypatch):
    fault(monkeypatch)
    found, expected = directional(ALL_AT_ONCE, True)
    assert found != pytest.approx(expected, rel=1e-3)


@compiled
def noises(tile, along, left, size, offset, out):
    for k in range(out.shape[0]):
        out[k] = noise_of_kernel(tile, along[k], left[k], size[k], offset)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.0, 11.3]))
def test_noise_is_that_of_the_kernel(seed, offset):
    draw = np.random.default_rng(seed)
    along, left = draw.uniform(-PERIOD_M, PERIOD_M, (2, 200)).astype(np.float32)
    size = np.exp(draw.uniform(np.log(1e-3), np.log(1e3), 200)).astype(np.float32)
    expected = np.empty(200, np.float32)
    noises(noise_tile(), along, left, size, np.float32(offset), expected)
    found = ground_noise(*(torch.from_numpy(v) for v in (along, left, size)), offset)
    # A cell's slope times what float32 leaves of places 2 km off.
    np.testing.assert_allclose(expected, found.numpy(), atol=0.02)
    assert np.abs(expected - found.numpy()).mean() < 1e-3


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_upper_edges_are_those_of_the_kernel(seed):
    draw = np.random.default_rng(seed)
    classes = np.repeat(draw.choice(np.array([2, 8, 10, 13], np.uint8), (20, 9)), 5, axis=0)
    depth = np.repeat(draw.choice([3.0, 6.0, 6.5, 40.0, np.inf], (25, 9)), 4, axis=0)
    depth = depth.astype(np.float32)
    buffer = np.zeros((24, 9 + 16), np.float32)
    buffer[BELOW_TOP] = 99.0
    class_above = np.full(9, 255, np.uint8)
    expected = np.empty_like(depth)
    for row in range(len(depth)):
        caps_row(classes[row], depth[row], np.float32(700.0), buffer, class_above)
        expected[row] = buffer[BELOW_TOP, :9]
    found = below_top_m(torch.from_numpy(classes), torch.from_numpy(depth), 700.0)
    np.testing.assert_allclose(expected, found.numpy(), rtol=1e-5)


def test_water_mirrors_and_darkens_as_published():
    angle = np.linspace(0.0, np.pi / 2, 50)
    found = batch_dress_ground.fresnel_of_sine(torch.from_numpy(np.sin(angle)))
    np.testing.assert_allclose(fresnel(angle), found, rtol=1e-9)
    albedo = np.linspace(0.01, 0.95, 50)
    one = torch.ones(50, dtype=torch.float64)
    wet = batch_dress_ground.film(torch.from_numpy(albedo)[None], one, one)[0]
    np.testing.assert_allclose(albedo * film_ratio(albedo), wet, rtol=1e-9)


def test_layers_of_another_size_are_refused():
    case = Case(yard(), BACKGROUNDS["wet"])
    small = looked_at(yard(width=80, height=48), AMBIENCE)
    with pytest.raises(ArgumentError, match=r"layers must be of pictures of the images' size"):
        batch([case], layers=[small])


def test_the_default_options_are_those_of_a_batch():
    case = Case(yard(), ALL_AT_ONCE)
    inputs = arguments([case])
    named = RenderOptions(without=BATCH_OPTIONS.without)
    assert torch.equal(render_batch(**inputs).image, render_batch(**inputs, options=named).image)
