"""Rendering over stored backgrounds: how much of which, blended in light, with honest labels."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gaussian_clip import GaussianClip, known, street
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tinting_editor import TINTS, Tinting
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.colour import linear_from_srgb, srgb_from_linear
from weather_aug.edit.background import STYLES
from weather_aug.errors import ArgumentError, SceneError
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import RenderOptions
from weather_aug.scene import backdrop, reconstruct, rendering
from weather_aug.scene.backgrounds_record import background_path
from weather_aug.scene.policy import WeatherPolicy, weather_of
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.styles import CARRIED, STYLE_SEVERITY, carried_options, style_amounts
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.taxonomy import IGNORE
from weather_aug.timeline import WeatherTimeline
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.weather import Weather
from weather_aug.writers.sample import render_recipe

CLIP = TinyClip(frames=2)
KEY = FrameKey(1, "front")
SEVERITIES = st.floats(0, 1)
CALM = RenderOptions(without=("drops", "wipers", "lens_veil", "noise", "glare", "compression"))
"""What an sRGB level of the background is still told by."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    return WeatherScene.build(CLIP, tmp_path_factory.mktemp("tinted") / "scene", editor=Tinting())


@pytest.fixture(scope="module")
def unedited(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    return WeatherScene.build(CLIP, tmp_path_factory.mktemp("none") / "scene", editor="none")


def on_the_ground(kind: str, severity: float | str = STYLE_SEVERITY) -> Weather:
    """A weather's ground with nothing in the air, not even a lamp."""
    return replace(weather_of(kind, severity, falling=False), lamps=0.0, mist_per_km=0.0)


def same(one: RenderedFrame, other: RenderedFrame) -> bool:
    planes = ("image", "label", "label_full", "invalid", "transmittance")
    return all((getattr(one, name) == getattr(other, name)).all() for name in planes)


# How much of which style


@pytest.mark.parametrize("kind", STYLES)
def test_the_styles_own_weather_asks_for_all_of_it(kind: str) -> None:
    for falling in (True, False):
        whole = weather_of(kind, STYLE_SEVERITY, falling=falling)
        assert style_amounts(whole, STYLES) == pytest.approx({kind: 1.0})
        assert style_amounts(weather_of(kind, "extreme"), STYLES) == pytest.approx({kind: 1.0})
    assert style_amounts(whole, [name for name in STYLES if name != kind]) == {}


def test_what_leaves_the_ground_alone_asks_for_nothing() -> None:
    for weather in (
        Weather.clear(),
        Weather(rain_mm_per_h=30.0, mist_per_km=2.0, spray_per_km=5.0, lamps=1.0),
        Weather(snow_mm_per_h=2.0, overcast=1.0),
        *(weather_of(kind, 0.0) for kind in STYLES),
    ):
        assert style_amounts(weather, STYLES) == {}
    with pytest.raises(ArgumentError, match="must be a Weather"):
        style_amounts("rain", STYLES)  # type: ignore[arg-type]


@given(kind=st.sampled_from(STYLES), one=SEVERITIES, other=SEVERITIES)
def test_amounts_rise_with_the_severity(kind: str, one: float, other: float) -> None:
    low, high = sorted((one, other))
    amounts = [style_amounts(weather_of(kind, s), STYLES) for s in (low, high)]
    assert all(set(found) <= {kind} for found in amounts), "one weather, one style"
    assert amounts[0].get(kind, 0.0) <= amounts[1].get(kind, 0.0) + 1e-12


@given(
    parts=st.lists(st.tuples(st.sampled_from(STYLES), SEVERITIES), min_size=1, max_size=3),
    step=st.floats(1e-7, 1e-5),
    styles=st.sets(st.sampled_from(STYLES)),
)
def test_amounts_are_shares_and_do_not_jump(
    parts: list[tuple[str, float]], step: float, styles: set[str]
) -> None:
    def amounts(more: float) -> dict[str, float]:
        weather = Weather.clear()
        for kind, severity in parts:
            weather = Weather.mix(weather, weather_of(kind, min(severity + more, 1.0)))
        return style_amounts(weather, styles)

    here, there = amounts(0.0), amounts(step)
    assert set(here) <= styles
    assert all(0 < share <= 1 for share in here.values()) and sum(here.values()) <= 1 + 1e-9
    for style in styles:
        assert abs(here.get(style, 0.0) - there.get(style, 0.0)) < 100 * step + 1e-8


def test_snow_comes_before_rain_and_rain_before_fog() -> None:
    rain, snow, fog = (weather_of(kind, STYLE_SEVERITY) for kind in ("rain", "snow", "fog"))
    everything = Weather.mix(Weather.mix(rain, snow), fog)
    assert style_amounts(everything, STYLES) == pytest.approx({"snow": 1.0})
    some = Weather.mix(rain, Weather(snow_cover=0.45))
    assert style_amounts(some, STYLES)["snow"] == pytest.approx(0.5)
    assert sum(style_amounts(some, STYLES).values()) <= 1
    wet = style_amounts(Weather.mix(rain, fog), STYLES)
    assert wet["rain"] > wet["fog"] and sum(wet.values()) == pytest.approx(1)


def test_drawn_weathers_have_shares() -> None:
    policy = WeatherPolicy(types={"rain": 1, "snow": 1, "fog": 1, "rain+fog": 1, "rain+snow": 1})
    for item in range(300):
        amounts = style_amounts(policy.draw(3, 0, item).weather, STYLES)
        assert 0 <= sum(amounts.values()) <= 1 + 1e-9


# The picture


def reference(scene: WeatherScene, key: FrameKey, weights: dict[str, float]) -> NDArray[np.uint8]:
    """The blend in float64."""
    light = (1 - sum(weights.values())) * linear_from_srgb(scene.frame(key).image / 255)
    for style, share in weights.items():
        light = light + share * linear_from_srgb(scene.background(key, style) / 255)
    return np.rint(255 * srgb_from_linear(light)).astype(np.uint8)


@given(shares=st.lists(st.floats(0, 1), min_size=3, max_size=3), scale=st.floats(0, 1))
def test_blends_are_of_light(scene: WeatherScene, shares: list[float], scale: float) -> None:
    total = sum(shares) or 1.0
    weights = {s: scale * share / total for s, share in zip(STYLES, shares, strict=True)}
    image = scene.render(KEY, Weather.clear(), style=weights).image
    difference = np.abs(image.astype(int) - reference(scene, KEY, weights))
    assert difference.max() <= 1


def test_a_blend_of_levels_would_be_seen(
    scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: sRGB taken for light."""
    half = reference(scene, KEY, {"snow": 0.5})

    def off() -> int:
        image = scene.render(KEY, Weather.clear(), style="snow", amount=0.5).image
        return int(np.abs(image.astype(int) - half).max())

    assert off() <= 1
    monkeypatch.setattr(backdrop, "SRGB_LEVELS_LINEAR", np.arange(256) / 255)
    monkeypatch.setattr(
        backdrop, "srgb_of_16_bits", lambda: (np.arange(65536) // 257).astype(np.uint8)
    )
    assert off() > 10


def test_a_blend_of_a_picture_with_itself_is_the_picture() -> None:
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    for share in (0.1, 1 / 3, 0.5, 0.999):
        assert (backdrop.blended(levels, [(share, levels)]) == levels).all()
        both = [(share / 2, levels), (share / 2, levels)]
        assert (backdrop.blended(levels, both) == levels).all()
    assert backdrop.blended(levels, []) is levels
    other = levels[::-1].copy()
    assert backdrop.blended(levels, [(1.0, other)]) is other


def test_inputs_are_not_changed() -> None:
    levels = np.arange(192, dtype=np.uint8).reshape(8, 8, 3)
    other = levels[::-1].copy()
    for array in (levels, other):
        array.flags.writeable = False
    assert backdrop.blended(levels, [(0.4, other)]).flags.writeable


@pytest.mark.parametrize("kind", STYLES)
def test_a_weather_shows_its_style_by_itself(scene: WeatherScene, kind: str) -> None:
    weather = on_the_ground(kind)
    weather = replace(weather, visibility_m=np.inf) if kind == "fog" else weather
    named = scene.render(KEY, weather, style=kind, options=CALM)
    assert (named.image == scene.background(KEY, kind)).all()
    if kind != "fog":
        assert same(scene.render(KEY, weather, options=CALM), named)


def test_the_fog_is_before_its_style(scene: WeatherScene) -> None:
    fog = Weather.fog("heavy")
    assert same(
        scene.render(KEY, fog, options=CALM), scene.render(KEY, fog, style="fog", options=CALM)
    )
    clear = scene.render(KEY, Weather.clear(), style="fog").image
    assert (scene.render(KEY, fog, options=CALM).image != clear).any()


def test_half_a_weather_shows_half(scene: WeatherScene) -> None:
    weather = Weather(snow_cover=0.45)
    assert (
        scene.render(KEY, weather, options=CALM).image == reference(scene, KEY, {"snow": 0.5})
    ).all()
    less = scene.render(KEY, weather, amount=0.5, options=CALM).image
    assert np.abs(less.astype(int) - reference(scene, KEY, {"snow": 0.25})).max() <= 1
    none = scene.render(KEY, weather, amount=0, options=CALM).image
    assert (none == scene.frame(KEY).image).all()


def test_falling_snow_falls_before_the_style(scene: WeatherScene) -> None:
    """Particles, air, glass and sensor are those of a render of the edited frame itself."""
    snow = Weather.snow("heavy")
    record = scene.manifest.by_key[KEY]
    frame = replace(scene.frame(KEY), image=scene.background(KEY, "snow"))
    layers = backdrop.with_picture(scene.layers(KEY), frame.image)
    asked = dict(seed=5, ambience=scene.ambience(KEY), shelter=scene.shelter, layers=layers)
    alone = render(frame, snow, **asked, options=carried_options(RenderOptions()))
    shot = scene.render(KEY, snow, seed=5)
    assert (shot.image == alone.image).all()
    assert record.layers is not None and (shot.frame.image == scene.frame(KEY).image).all()


def test_glass_shows_the_edited_street(
    scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: drops that still mirror the recorded one."""
    drops = replace(Weather(), wetness=1.0, lens_drops=400.0)
    right = scene.render(KEY, drops)
    monkeypatch.setattr(rendering, "with_picture", lambda layers, image: layers)
    assert (scene.render(KEY, drops).image != right.image).any()


def test_nothing_is_dressed_twice(scene: WeatherScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A planted fault: the physical editor dresses the edited street once more."""
    rain = on_the_ground("rain")
    right = scene.render(KEY, rain, options=CALM)
    named = CALM.without
    without = replace(CALM, without=(*named, *CARRIED))
    assert same(scene.render(KEY, rain, options=without), right)
    monkeypatch.setattr(rendering, "carried_options", lambda options: options)
    twice = scene.render(KEY, rain, options=CALM)
    assert np.abs(twice.image.astype(int) - right.image).mean() > 3


@pytest.mark.parametrize("window", [(0, 0, 24, 32), (10, 20, 30, 40), (47, 63, 1, 1)])
@pytest.mark.parametrize("kind", ["rain", "snow", "fog"])
def test_a_window_has_the_bytes_of_the_whole(
    scene: WeatherScene, window: tuple[int, int, int, int], kind: str
) -> None:
    weather = weather_of(kind, 0.6)
    whole, part = (
        scene.render(KEY, weather, seed=2),
        scene.render(KEY, weather, seed=2, window=window),
    )
    top, left, height, width = window
    for name in ("image", "label", "label_full", "invalid", "transmittance", "depth"):
        cut = getattr(whole, name)[top : top + height, left : left + width]
        assert (getattr(part, name) == cut).all(), name


def test_timelines_show_the_weather_of_the_moment(scene: WeatherScene) -> None:
    line = WeatherTimeline(((0.0, Weather.clear()), (0.2, on_the_ground("snow"))))
    time_s = scene.frame(KEY).time_s
    moment = scene.render(KEY, line.at(time_s), air=line.air(time_s, 0))
    assert same(scene.render(KEY, line), moment)
    first = scene.render(FrameKey(0, "front"), line)
    assert (first.image == scene.frame(FrameKey(0, "front")).image).all()


def test_the_physical_editor_can_still_be_asked_for(scene: WeatherScene, tmp_path: Path) -> None:
    plain = WeatherScene.build(CLIP, tmp_path / "plain")
    for weather in (Weather.snow("heavy"), Weather.rain("light")):
        wanted = plain.render(KEY, weather, seed=4)
        assert same(scene.render(KEY, weather, seed=4, style="physical"), wanted)
        assert same(plain.render(KEY, weather, seed=4, style="physical"), wanted)
        assert not same(scene.render(KEY, weather, seed=4), wanted)


@pytest.mark.parametrize(
    ("choices", "says"),
    [
        ({"style": "dusk"}, "style 'dusk' is unknown; there is rain, snow, fog"),
        ({"style": {"snow": 0.7, "rain": 0.7}}, "at most 1"),
        ({"style": {"snow": -0.1}}, "weight of style 'snow'"),
        ({"style": "snow", "amount": 1.5}, "amount"),
        ({"amount": -0.5}, "amount"),
        ({"viewpoint": Viewpoint(lateral_m=1)}, "reconstruct=True"),
        ({"without_actors": (3,)}, "reconstruct=True"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    scene: WeatherScene, choices: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        scene.render(KEY, Weather.snow("heavy"), **choices)
    with pytest.raises(ArgumentError, match="must be a Weather"):
        scene.render(KEY, "snow")  # type: ignore[arg-type]


def test_a_picture_that_is_gone_is_a_scene_error(tmp_path: Path) -> None:
    built = WeatherScene.build(TinyClip(frames=1), tmp_path / "s", editor=Tinting())
    key = built.keys[0]
    (built.path / background_path("snow", key)).unlink()
    with pytest.raises(SceneError, match="cannot be read"):
        built.render(key, Weather.snow("heavy"))
    assert built.render(key, Weather.rain("heavy")).image.shape == (48, 64, 3)
    (built.path / background_path("snow", key)).write_bytes(b"GIF89a")
    with pytest.raises(SceneError, match="not a readable PNG of 64x48"):
        built.render(key, Weather.snow("heavy"))


# Labels


def test_labels_are_buried_under_the_styles_snow(
    scene: WeatherScene, unedited: WeatherScene
) -> None:
    """As of a style of Gaussians: what lies in the picture hides borders, whatever the weather."""
    deep = dict(snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2)
    patch = pytest.MonkeyPatch()
    with patch.context() as context:
        lying = replace(Weather.clear(), **deep)
        context.setattr(
            backdrop, "lying_in", lambda weights, amount: lying if weights else Weather()
        )
        shot = scene.render(KEY, Weather.clear(), style="snow")
        plain = render(
            scene.frame(KEY),
            lying,
            seed=0,
            ambience=scene.ambience(KEY),
            layers=scene.layers(KEY),
            options=RenderOptions(),
        )
        assert (shot.label == plain.label).all() and (shot.label == IGNORE).any()
        assert (shot.invalid == plain.invalid).all()
        kept = scene.render(
            KEY, Weather.clear(), style="snow", options=RenderOptions(labels="keep")
        )
        assert (kept.label == scene.frame(KEY).label).all()
        # What is not in the picture hides nothing.
        bare = unedited.render(KEY, Weather.clear(), style="snow")
        assert (bare.label == scene.frame(KEY).label).all() and not bare.invalid.any()
    dry = scene.render(KEY, Weather.clear(), style="rain")
    assert (dry.label == scene.frame(KEY).label).all()


def test_unlabelled_frames_have_backgrounds_too(tmp_path: Path) -> None:
    clip = TinyClip(frames=1, labelled=False)
    built = WeatherScene.build(clip, tmp_path / "s", editor=Tinting())
    shot = built.render(built.keys[0], Weather.snow("heavy"))
    assert shot.label is None and shot.image.shape == (48, 64, 3)


# Without editing


def test_no_editing_leaves_particles_and_air_alone(unedited: WeatherScene) -> None:
    plain = partial(unedited.render, KEY, seed=3, options=carried_options(RenderOptions()))
    for weather in (Weather.rain("heavy"), Weather.fog("moderate"), Weather.snow("heavy")):
        assert same(unedited.render(KEY, weather, seed=3), plain(weather, style="physical"))


# Through the loader


def test_a_data_set_draws_over_backgrounds(scene: WeatherScene) -> None:
    dataset = WeatherDataset([scene], WeatherPolicy(types={"snow": 1}), seed=1, crop=(24, 32))
    item = dataset[2]
    shot = render_recipe(scene, json.loads(item["recipe"]))
    assert (item["image"].permute(1, 2, 0).numpy() == shot.image).all()


# Gaussians


@pytest.fixture(scope="module")
def gaussians(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """With stored backgrounds, and Gaussians of all styles."""
    folder = tmp_path_factory.mktemp("both") / "scene"
    with known():
        return WeatherScene.build(GaussianClip(), folder, editor=Tinting(), reconstruct=True)


def test_gaussians_learn_the_stored_pictures(tmp_path: Path) -> None:
    """The physical ones only where nothing is stored."""
    seen: dict[str, list[NDArray[np.uint8]]] = {}

    def fitted(model: Any, edited: Any, **_: Any) -> Any:
        seen.update({name: [frame.image for frame in frames] for name, frames in edited.items()})
        return replace(model, styles={name: street().styles[name] for name in edited})

    with known() as patch:
        patch.setattr("weather_aug.gaussians.styles.fit_styles", fitted)
        built = WeatherScene.build(
            GaussianClip(),
            tmp_path / "s",
            editor=Tinting(),
            weathers=("snow",),
            reconstruct=True,
            styles=("snow", "rain"),
        )
    for key, image in zip(built.keys, seen["snow"], strict=True):
        assert (image == built.background(key, "snow")).all()
    record = built.manifest.frames[0]
    frame = built.frame(record.key)
    bare = replace(built.manifest, backgrounds=None)
    physical = reconstruct.styled_frame(built.path, bare, record, frame, "rain")
    assert (seen["rain"][0] == physical.image).all()
    assert (seen["rain"][0] != frame.image).any()


def test_gaussians_of_other_backgrounds_are_fitted_again(tmp_path: Path) -> None:
    """A build that was cut before the styles goes on with another editor's pictures."""
    out = tmp_path / "s"

    def cut(*_: Any, **__: Any) -> Any:
        raise RuntimeError("power cut")

    with known() as patch:
        patch.setattr("weather_aug.gaussians.styles.fit_styles", cut)
        with pytest.raises(RuntimeError, match="power cut"):
            WeatherScene.build(GaussianClip(), out, editor=Tinting(), reconstruct=True)
    with known():
        other = WeatherScene.build(GaussianClip(), out, editor="none", reconstruct=True)
    assert other.manifest.editor == "none" and other.damaged_files() == []
    assert (other.background(other.keys[0], "snow") == other.frame(other.keys[0]).image).all()


def test_recorded_places_show_pictures_and_others_gaussians(gaussians: WeatherScene) -> None:
    key = gaussians.keys[1]
    snow = on_the_ground("snow")
    here = gaussians.render(key, snow, options=CALM)
    assert (here.image == gaussians.background(key, "snow")).all()
    aside = Viewpoint(lateral_m=0.5)
    asked = gaussians.render(key, snow, viewpoint=aside)
    named = gaussians.render(key, snow, viewpoint=aside, style="snow")
    dressed = gaussians.render(key, snow, viewpoint=aside, style="physical")
    assert same(asked, named)
    assert not same(asked, dressed)
    light = Weather(snow_cover=0.45)
    half = gaussians.render(key, light, viewpoint=aside, style="snow", amount=0.5)
    assert same(gaussians.render(key, light, viewpoint=aside), half)


def test_tints_are_what_the_editor_wanted(scene: WeatherScene) -> None:
    """The fixtures' pictures differ by what they should."""
    means = {style: scene.background(KEY, style).mean() for style in STYLES}
    assert sorted(means, key=means.__getitem__) == sorted(STYLES, key=lambda s: sum(TINTS[s]))
