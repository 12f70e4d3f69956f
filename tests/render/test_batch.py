"""render_batch(): the same pictures as render(), in torch, with gradients."""

import sys
from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import torch
from batch_scene import (
    AGREEMENT_DB,
    AMBIENCE,
    MOTIONS,
    WEATHERS,
    Case,
    arguments,
    batch,
    psnr,
    street,
)

from weather_aug.air import Air
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.particles.shelter import Shelter
from weather_aug.render import batch as batch_module
from weather_aug.render import batch_medium, batch_particles, batch_project, batch_shade
from weather_aug.render.background import looked_at
from weather_aug.render.batch import BATCH_OPTIONS, render_batch
from weather_aug.render.batch_checks import NOT_DRAWN, UNDRAWN
from weather_aug.render.fields import RigMotion
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.weather import Weather

WAYS = ("torch", "compiled")
SHARP = replace(BATCH_OPTIONS, without=(*UNDRAWN, "exposure"))
"""With the camera's own exposure: longer ones blur particles, and what may be wrong with them."""


@pytest.mark.parametrize("splatting", WAYS)
@pytest.mark.parametrize(
    ("motion", "labelled", "options"),
    [
        *((motion, True, SHARP) for motion in MOTIONS),
        ("driving", False, SHARP),
        ("driving", True, BATCH_OPTIONS),
    ],
)
def test_agrees_with_the_compiled_renderer(motion, labelled, options, splatting):
    cases = [Case(street(motion, labelled=labelled), weather) for weather in WEATHERS.values()]
    shots = batch(cases, splatting=splatting, options=options)
    for k, (name, case) in enumerate(zip(WEATHERS, cases, strict=True)):
        expected = case.alone(options=options)
        assert psnr(shots.image[k], expected.image) >= AGREEMENT_DB, name
        through = shots.transmittance[k].numpy()
        assert np.abs(through - expected.transmittance).max() < 0.01, name
        np.testing.assert_array_equal(expected.depth, shots.depth[k].numpy())
        assert (shots.invalid[k].numpy() != expected.invalid).mean() <= 1e-3, name
        if labelled:
            assert (shots.label[k].numpy() != expected.label).mean() <= 1e-3, name
        else:
            assert shots.label is None


@pytest.mark.parametrize("splatting", WAYS)
def test_large_flakes_hide_the_same_surfaces(splatting):
    """A long lens and a short exposure: flakes of many pixels, sharp and opaque."""
    frame = street(exposure_s=0.0003, aperture_m=0.0, focal_px=500.0)
    case = Case(frame, Weather(snow_mm_per_h=10.0), seed=9)
    expected, found = case.alone(), batch([case], splatting=splatting)
    assert (expected.label != frame.label).sum() > 100
    assert (found.label[0].numpy() != expected.label).mean() <= 1e-3
    assert (found.invalid[0].numpy() != expected.invalid).mean() <= 1e-3


def without_compensation(monkeypatch):
    wrong = partial(batch_project.project, compensate=False)
    monkeypatch.setattr(batch_particles, "project", wrong)


def in_gamma_space(monkeypatch):
    right = batch_module._background
    encode = batch_shade.encoded
    monkeypatch.setattr(batch_module, "_background", lambda *a: encode(right(*a)))
    monkeypatch.setattr(batch_shade, "encoded", lambda light: light.clamp(0, 1))


def without_spray(monkeypatch):
    monkeypatch.setattr(batch_medium, "spray_share", lambda heights, _: 0 * heights)


def with_even_fog(monkeypatch):
    monkeypatch.setattr(batch_module, "fog_shares", lambda _, z_m: torch.ones_like(z_m))


def in_still_air(monkeypatch):
    still = Weather().wind_m_per_s
    monkeypatch.setattr(batch_module, "air_of", lambda *_: Air(still, still))


FAULTS = [
    (without_compensation, "rain"),
    (without_compensation, "snow"),
    (without_compensation, "rain and fog"),
    (in_gamma_space, "rain"),
    (in_gamma_space, "snow"),
    (in_gamma_space, "rain and fog"),
    (without_spray, "spray"),
    (with_even_fog, "patchy fog"),
    (with_even_fog, "puffy low fog"),
    (in_still_air, "wet snow"),
    (in_still_air, "snow"),
]


@pytest.mark.parametrize(("fault", "name"), FAULTS)
def test_the_agreement_would_notice(fault, name, monkeypatch):
    case = Case(street("driving"), WEATHERS[name])
    fault(monkeypatch)
    assert psnr(batch([case], options=SHARP).image[0], case.alone(options=SHARP).image) < 45


@pytest.mark.parametrize("splatting", WAYS)
def test_a_picture_does_not_depend_on_its_batch(splatting):
    cases = [
        Case(street("driving", time_s=2.0), WEATHERS["snow"], seed=8),
        Case(street(), Weather.clear()),
        Case(street("turning"), WEATHERS["rain and fog"], seed=2**64 - 1),
    ]
    together, again = (batch(cases, splatting=splatting) for _ in range(2))
    for k, case in enumerate(cases):
        alone = batch([case], splatting=splatting)
        for name in ("image", "label", "invalid", "transmittance", "depth"):
            assert torch.equal(getattr(together, name)[k], getattr(alone, name)[0])
            assert torch.equal(getattr(together, name), getattr(again, name))


def test_a_picture_does_not_depend_on_the_rows_shaded_together(monkeypatch):
    case = Case(street("driving"), WEATHERS["rain and fog"])
    expected = batch([case])
    monkeypatch.setattr(batch_module, "ROWS_AT_ONCE", 7)
    torch.testing.assert_close(batch([case]).image, expected.image, atol=1e-6, rtol=0)


def test_auto_draws_with_the_kernels_on_a_cpu():
    case = Case(street(), WEATHERS["rain and snow"])
    images = [batch([case], splatting=way).image for way in ("auto", *WAYS)]
    assert torch.equal(images[0], images[2])
    assert not torch.equal(images[0], images[1])


def test_clear_weather_gives_the_pictures_back():
    case = Case(street(), Weather.clear())
    inputs = arguments([case])
    shots = render_batch(**inputs)
    assert torch.equal(inputs["images"], shots.image)
    assert torch.equal(inputs["labels"], shots.label)
    assert (shots.transmittance == 1).all()
    assert not shots.invalid.any()
    assert shots.image.data_ptr() != inputs["images"].data_ptr()


def test_inputs_are_untouched():
    inputs = arguments([Case(street(), WEATHERS["rain and snow"])])
    tensors = [inputs[name] for name in ("images", "depth_m", "labels")]
    before = [tensor.clone() for tensor in tensors]
    render_batch(**inputs)
    assert all(torch.equal(a, b) for a, b in zip(before, tensors, strict=True))


@pytest.mark.parametrize("name", ["rain and fog", "rain and snow"])
def test_gradients_are_those_of_finite_differences(name):
    frame = street("driving", width=5, height=4)
    inputs = arguments([Case(frame, WEATHERS[name])], torch.float64)
    # Off the 8-bit levels, where the interpolated tone curve has its kinks.
    images = (inputs.pop("images") + 0.3 / 255).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: render_batch(x, **inputs).image, images)


def test_gradients_are_finite_at_black_and_white():
    inputs = arguments([Case(street(), WEATHERS["snow"])])
    images = inputs.pop("images").round().requires_grad_()
    render_batch(images, **inputs).image.sum().backward()
    assert torch.isfinite(images.grad).all()
    assert (images.grad != 0).any()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_dtype_is_kept(dtype):
    case = Case(street(), WEATHERS["rain and snow"])
    inputs = arguments([case])
    inputs["images"] = inputs["images"].to(dtype)
    coarse = render_batch(**inputs)
    fine = render_batch(**(inputs | {"images": inputs["images"].float()}))
    assert coarse.image.dtype == dtype
    wide = dtype == torch.float64
    assert coarse.transmittance.dtype == (torch.float64 if wide else torch.float32)
    torch.testing.assert_close(coarse.image, fine.image.to(dtype), atol=1e-5, rtol=1e-5)


def test_depth_and_labels_may_come_in_other_forms():
    case = Case(street(), WEATHERS["fog"])
    inputs = arguments([case])
    plain = render_batch(**inputs)
    other = inputs | {"depth_m": inputs["depth_m"][:, None], "labels": inputs["labels"].long()}
    shots = render_batch(**other)
    assert shots.label.dtype == torch.int64
    assert torch.equal(plain.label.long(), shots.label)
    assert torch.equal(plain.image, shots.image)


def test_depth_that_is_nonsense_means_far():
    inputs = arguments([Case(street(), WEATHERS["rain and fog"])])
    for row, value in enumerate((torch.nan, -3.0, 0.0, 65504.0)):
        inputs["depth_m"][:, 80 + row] = value
    shots = render_batch(**inputs)
    assert torch.isinf(shots.depth[:, 80:84]).all()
    assert torch.isfinite(shots.image).all()
    assert torch.isfinite(shots.transmittance).all()


def test_the_airs_motion_can_be_given():
    case = Case(street(), WEATHERS["snow"])
    air = Air(case.weather.wind_m_per_s, (3.0, -2.0, 0.5), 1.5)
    expected = case.alone(air=air)
    assert psnr(batch([case], airs=[air]).image[0], expected.image) >= AGREEMENT_DB
    assert psnr(batch([case]).image[0], expected.image) < 45


@pytest.mark.parametrize("splatting", WAYS)
def test_no_particles_fall_under_a_roof(splatting):
    case = Case(street(), WEATHERS["snow"])
    roof = Shelter(np.full((200, 200), 6.0, np.float32), np.array([-50.0, -50.0, 0.0]), np.eye(3))
    expected = case.alone(shelter=roof)
    found = batch([case] * 2, shelters=[roof, None], splatting=splatting)
    assert psnr(found.image[0], expected.image) >= AGREEMENT_DB
    assert psnr(found.image[1], expected.image) < 45


def test_options_of_the_particles_are_passed_on():
    frame = street("driving", exposure_s=0.0003, aperture_m=0.0, focal_px=500.0)
    case = Case(frame, Weather(rain_mm_per_h=200.0, snow_mm_per_h=10.0))
    here = case.frame.camera.world_from_camera
    first = here.copy()
    first[:3, 3] -= (14.0, 0.3, 0.0)
    rig = RigMotion(first, here)
    plain = case.alone()
    for choices in (
        {"options": replace(BATCH_OPTIONS, alignment="camera"), "rig": rig},
        {"options": replace(BATCH_OPTIONS, rain_fall_speed="atlas")},
        {"options": replace(BATCH_OPTIONS, max_particles=300)},
    ):
        expected = case.alone(**choices)
        rigs = [choices["rig"]] if "rig" in choices else None
        found = batch([case], options=choices["options"], rigs=rigs)
        assert psnr(found.image[0], expected.image) >= AGREEMENT_DB
        assert psnr(found.image[0], plain.image) < AGREEMENT_DB - 3


def test_refusals():
    cases = [Case(street(width=20, height=12), WEATHERS["rain"])] * 2
    right = arguments(cases)
    images = right["images"]
    wrong = {
        "images": (None, images[0], images[:, :2], images[:0], images.byte(), images * 1.2),
        "depth_m": (None, right["depth_m"][:1], right["depth_m"][:, :5], images[:, 0].byte()),
        "labels": ("sky", right["labels"][:1], right["labels"].float()),
        "cameras": (right["cameras"][:1], ["a", "b"], [c.resized(10, 6) for c in right["cameras"]]),
        "weathers": ("rain", ["rain", "rain"], right["weathers"] * 2, 3),
        "seeds": ([1], [1, 2**64], [1, "a"]),
        "ambiences": ([AMBIENCE], [None, None]),
        "times_s": ([0.0], [0.0, np.nan], 0.0),
        "airs": ([0, None], [Air((0, 0, 0), (0, 0, 0))]),
        "shelters": (["roof", None], [None]),
        "rigs": ([np.eye(4), None], [None], 3),
        "layers": ([None], ["seen", None], [looked_at(street(), AMBIENCE), None]),
        "options": (None,),
        "splatting": ("cuda", "gsplat"),
    }
    images_nan = images.clone()
    images_nan[0, 0, 0, 0] = torch.nan
    wrong["images"] += (images_nan, images.to("meta"))
    for name, values in wrong.items():
        for k, value in enumerate(values):
            with pytest.raises(ArgumentError, match=name):
                render_batch(**(right | {name: value}))
                pytest.fail(f"{name} {k} was accepted")


def test_what_is_not_drawn_is_refused():
    inputs = arguments([Case(street(width=20, height=12), WEATHERS["fog"])])
    for name, value in (("multiple_scattering", True), ("preset", "weatheredit")):
        with pytest.raises(ArgumentError, match=rf"options\.{name}"):
            render_batch(**(inputs | {"options": RenderOptions(**{name: value})}))


@pytest.mark.parametrize("effect", UNDRAWN)
def test_an_effect_that_is_not_drawn_must_be_left_out_by_name(effect):
    inputs = arguments([Case(street(width=20, height=12), WEATHERS["fog"])])
    others = tuple(name for name in UNDRAWN if name != effect)
    with pytest.raises(ArgumentError, match=rf"options\.without .*add {effect}, start"):
        render_batch(**inputs, options=RenderOptions(without=others))


def test_every_option_is_drawn_or_refused():
    """A new option of `render` has to be thought of here; `ablation` needs a preset."""
    drawn = {"max_particles", "alignment", "rain_fall_speed", "without", "labels"}
    assert {f.name for f in fields(RenderOptions)} == drawn | {*NOT_DRAWN, "ablation"}


def test_every_effect_is_drawn_or_left_out():
    """A new effect of `render` has to be thought of here."""
    drawn = {"relight", "sky", "film", "mirror", "puddles"} | {
        *("ripples", "snow_cover", "tracks", "exposure")
    }
    assert drawn.isdisjoint(UNDRAWN)
    assert drawn | set(UNDRAWN) == set(EFFECTS)
    assert BATCH_OPTIONS == RenderOptions(without=UNDRAWN)


def test_the_shutter_is_open_longer_in_the_dark():
    case = Case(street("driving", exposure_s=0.005), Weather(snow_mm_per_h=10.0, overcast=1.0))
    own, kept = case.alone(), case.alone(options=SHARP)
    assert psnr(batch([case]).image[0], own.image) >= AGREEMENT_DB
    assert psnr(batch([case], options=SHARP).image[0], kept.image) >= AGREEMENT_DB
    assert psnr(batch([case]).image[0], kept.image) < AGREEMENT_DB - 3


def test_gsplat_is_named_when_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(batch_module, "splatting_on", lambda *_: "gsplat")
    with pytest.raises(MissingExtraError, match=r"weather-aug\[gsplat\]"):
        batch([Case(street(), WEATHERS["snow"])])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_pictures_agree_with_the_cpus():
    cases = [Case(street("driving"), weather) for weather in WEATHERS.values()]
    inputs = arguments(cases)
    expected = render_batch(**inputs)
    for name in ("images", "depth_m", "labels"):
        inputs[name] = inputs[name].cuda()
    found, again = render_batch(**inputs), render_batch(**inputs)
    assert torch.equal(found.image, again.image)
    torch.testing.assert_close(found.image.cpu(), expected.image, atol=2e-3, rtol=0)
    torch.testing.assert_close(found.transmittance.cpu(), expected.transmittance, atol=2e-3, rtol=0)
    assert (found.label.cpu() != expected.label).float().mean() <= 1e-3
