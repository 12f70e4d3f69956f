"""render(): its contract, whatever the weather."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import air_only
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scene import make_camera, make_frame

from weather_aug.air import Air
from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience, airlight_from_sky, ambience_of
from weather_aug.edit.physical.layers import SHARP
from weather_aug.edit.surface import depth_of, surface_of
from weather_aug.errors import ArgumentError
from weather_aug.render.background import looked_at
from weather_aug.render.compose import checked_window, render
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import weather_of
from weather_aug.taxonomy import SKY
from weather_aug.weather import Weather

AMBIENCE = Ambience(
    np.eye(3),
    sky=np.array([0.4, 0.6, 0.9]),
    middle=np.full(3, 0.2),
    ground=np.full(3, 0.12),
    airlight=np.array([0.55, 0.56, 0.57]),
)
KINDS = ("clear", "rain", "snow", "fog")


def street_frame(width=97, height=61, time_s=1.0):
    rng = np.random.default_rng(1)
    camera = make_camera(width, height, velocity=(8.0, 0.5, 0), exposure_s=0.003)
    depth = rng.uniform(1.5, 80, (height, width)).astype(np.float32)
    label = rng.integers(0, 19, (height, width), dtype=np.uint8)
    depth[: height // 4], label[: height // 4] = np.inf, SKY
    image = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
    return make_frame(camera, image, depth, label, time_s)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("severity", [0.02, 0.5, 1.0])
def test_outputs_are_whole_fresh_and_inputs_untouched(kind, severity):
    frame = street_frame()
    arrays = (frame.image, frame.label, frame.depth_m)
    before = [a.copy() for a in arrays]
    for array in arrays:
        array.flags.writeable = False
    shot = render(frame, weather_of(kind, severity), seed=3, ambience=AMBIENCE)
    for array, old in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, old)
    assert (61, 97, 3) == shot.image.shape
    assert np.isfinite(shot.transmittance).all()
    assert shot.transmittance.min() >= 0
    assert shot.transmittance.max() <= 1
    assert set(np.unique(shot.invalid)) <= {0, 1}
    assert set(np.unique(shot.label)) <= {*range(19), 255}
    for out in (shot.image, shot.label, shot.label_full, shot.invalid, shot.transmittance):
        assert out.flags.c_contiguous
        assert not any(np.shares_memory(out, a) for a in arrays)


def test_clear_weather_gives_the_picture_back():
    frame = street_frame()
    windy = Weather(wind_m_per_s=(3.0, 0, 0))
    for weather in (Weather.clear(), Weather.rain(0.0), Weather.fog(0.0), windy):
        shot = render(frame, weather, seed=1, ambience=AMBIENCE)
        np.testing.assert_array_equal(shot.image, frame.image)
        np.testing.assert_array_equal(shot.label, frame.label)
        assert (shot.transmittance == 1).all()
        assert not shot.invalid.any()


@pytest.mark.parametrize("kind", KINDS[1:])
def test_weather_fades_in_from_the_clear_picture(kind):
    """The smallest severity changes next to nothing: no jump at 0.

    Compression is a step, and a large one for a picture of noise: test_sensor looks at it.
    """
    frame = street_frame()
    options = RenderOptions(without=("compression",))
    shot = render(frame, weather_of(kind, 0.001), seed=1, ambience=AMBIENCE, options=options)
    near = np.isfinite(shot.depth)
    change = np.abs(shot.image.astype(int) - frame.image)[near]
    assert np.quantile(change, 0.99) <= (4 if kind == "fog" else 1)


@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    severity=st.floats(0, 1),
    seed=st.integers(-(2**63), 2**64 - 1),
    window=st.tuples(
        st.integers(0, 50), st.integers(0, 80), st.integers(1, 61), st.integers(1, 97)
    ),
)
def test_a_window_is_a_part_of_the_whole(kind, severity, seed, window):
    top, left, height, width = window
    height, width = min(height, 61 - top), min(width, 97 - left)
    frame, weather = street_frame(), weather_of(kind, severity)
    options = RenderOptions(2_000)
    whole = render(frame, weather, seed=seed, ambience=AMBIENCE, options=options)
    part = render(
        frame,
        weather,
        seed=seed,
        ambience=AMBIENCE,
        window=(top, left, height, width),
        options=options,
    )
    for name in ("image", "label", "label_full", "invalid", "transmittance", "depth"):
        expected = getattr(whole, name)[top : top + height, left : left + width]
        np.testing.assert_array_equal(expected, getattr(part, name))


def test_a_window_of_an_unlabelled_frame_is_a_part_of_the_whole():
    """There the sky is found from depth, which looks at more neighbours."""
    rng = np.random.default_rng(0)
    camera = make_camera(60, 40)
    for seed in range(20):
        depth = np.where(rng.random((40, 60)) < 0.02, np.inf, rng.uniform(20, 90, (40, 60)))
        level = np.full((40, 60, 3), 196, np.uint8)
        frame = make_frame(camera, level, depth)
        weather = Weather.fog("moderate")
        whole = render(frame, weather, seed=seed, ambience=AMBIENCE)
        part = render(frame, weather, seed=seed, ambience=AMBIENCE, window=(9, 13, 20, 30))
        np.testing.assert_array_equal(whole.invalid[9:29, 13:43], part.invalid)
        np.testing.assert_array_equal(whole.image[9:29, 13:43], part.image)


def test_a_window_of_a_turning_camera_is_a_part_of_the_whole():
    frame = street_frame()
    camera = replace(
        frame.camera,
        exposure_s=0.03,
        angular_velocity_rad_per_s=np.array([0.3, -1.0, 0.2]),
        velocity_m_per_s=np.array([25.0, 1.0, 0.0]),
    )
    frame = replace(frame, camera=camera)
    for weather in (Weather.rain("extreme"), Weather.snow("extreme")):
        whole = render(frame, weather, seed=2, ambience=AMBIENCE)
        for window in ((0, 0, 20, 20), (30, 60, 31, 37), (10, 5, 3, 90)):
            top, left, height, width = window
            part = render(frame, weather, seed=2, ambience=AMBIENCE, window=window)
            expected = whole.transmittance[top : top + height, left : left + width]
            np.testing.assert_array_equal(expected, part.transmittance)


def test_a_severity_sweep_at_equal_drift_keeps_its_drops():
    """Heavier rain with the wind that comes with it: at equal drift nothing is drawn anew."""
    frame = street_frame(time_s=9.0)

    def drops(severity, held):
        weather = replace(Weather.rain(severity), mist_per_km=0.0)
        through = [
            render(
                frame,
                weather,
                seed=2,
                ambience=AMBIENCE,
                air=Air.held(weather) if held else None,
                options=air_only(budget),
            ).transmittance
            for budget in (0, 2_000)
        ]
        return np.log(through[0] / through[1])

    first, kept, anew = drops(0.75, True), drops(0.76, True), drops(0.76, False)
    assert np.abs(kept - first).mean() < 0.5 * np.abs(anew - first).mean()


def test_a_frame_alone_is_the_frame_in_sequence():
    weather = Weather.snow("heavy")
    sequence = [
        render(street_frame(time_s=0.1 * k), weather, seed=5, ambience=AMBIENCE).image
        for k in range(6)
    ]
    alone = render(street_frame(time_s=0.1 * 4), weather, seed=5, ambience=AMBIENCE).image
    np.testing.assert_array_equal(sequence[4], alone)
    assert not np.array_equal(sequence[3], sequence[4])


def test_seed_chooses_the_particles():
    frame, weather = street_frame(), Weather.snow("heavy")
    first, second = (render(frame, weather, seed=s, ambience=AMBIENCE).image for s in (1, 2))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (17, 31)])
@pytest.mark.parametrize("kind", KINDS)
def test_odd_sizes(shape, kind):
    frame = street_frame(width=shape[1], height=shape[0])
    shot = render(frame, weather_of(kind, 1.0), seed=0, ambience=AMBIENCE)
    assert (*shape, 3) == shot.image.shape


def test_a_picture_of_the_sky_and_the_tops_of_houses_is_whole():
    """Nothing below the horizon: there is no road, and nothing to mirror."""
    frame = street_frame()
    camera = frame.camera
    intrinsics = camera.intrinsics.copy()
    intrinsics[1, 2] += 500.0
    frame = replace(frame, camera=replace(camera, intrinsics=intrinsics))
    first, again = (
        render(frame, Weather.rain("heavy"), seed=0, ambience=AMBIENCE).image for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)
    layers = looked_at(frame, AMBIENCE)
    assert not layers.maps[SHARP:].any()


def test_depth_that_is_missing_or_nonsense_means_far():
    frame = street_frame()
    frame.depth_m[40:45] = np.nan
    frame.depth_m[45:50] = -3
    frame.depth_m[50:55] = 0
    shot = render(frame, Weather.fog("heavy"), seed=0, ambience=AMBIENCE)
    assert np.isinf(shot.depth[40:55]).all()
    assert (shot.transmittance[40:55] < 1e-3).all()
    assert np.isfinite(shot.transmittance).all()


def test_refusals():
    frame = street_frame()
    for window in ((0, 0, 0, 5), (-1, 0, 5, 5), (0, 0, 62, 5), (0, 90, 5, 10)):
        with pytest.raises(ArgumentError, match="window"):
            checked_window(window, 61, 97)
    without_depth = make_frame(frame.camera, frame.image, 1.0)
    object.__setattr__(without_depth, "depth_m", None)
    with pytest.raises(ArgumentError, match="no depth"):
        render(without_depth, Weather.fog(0.5), seed=0, ambience=AMBIENCE)
    with pytest.raises(ArgumentError, match="seed"):
        render(frame, Weather.fog(0.5), seed=2**64, ambience=AMBIENCE)
    with pytest.raises(ArgumentError, match="max_particles"):
        RenderOptions(10**9)
    with pytest.raises(ArgumentError, match="whole"):
        RenderOptions(1.5)
    with pytest.raises(ArgumentError, match="four integers"):
        checked_window((0, 0, 5), 61, 97)
    with pytest.raises(ArgumentError, match="four integers"):
        checked_window((0, 0, 5.5, 5), 61, 97)
    with pytest.raises(ArgumentError, match="must be a Weather"):
        render(frame, "rain", seed=0, ambience=AMBIENCE)


def test_airlight_is_nearly_grey_and_neither_night_nor_burnt_out():
    for sky in ([0.01, 0.02, 0.05], [0.3, 0.6, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]):
        light = airlight_from_sky(np.array(sky))
        assert 0.3 < light.min()
        assert light.max() < 0.85
        assert light.max() / light.min() < 1.25


def test_ambience_measures_sky_ground_and_the_rest():
    camera = make_camera(90, 60)
    image = np.zeros((60, 90, 3), np.uint8)
    label = np.full((60, 90), 2, np.uint8)
    image[:20], label[:20] = (100, 150, 250), SKY
    image[20:40], image[40:], label[40:] = 90, 40, 0
    light = ambience_of(make_frame(camera, image, 10.0, label), np.eye(3))
    assert light.sky[2] > light.sky[0]
    assert light.middle[0] > light.ground[0]
    depth = np.where(label == SKY, np.inf, 10.0)
    unlabelled = ambience_of(make_frame(camera, image, depth), np.eye(3))
    np.testing.assert_allclose(light.sky, unlabelled.sky)


def test_half_precision_depth_is_widened_exactly():
    """Every float16 there is: positive finite ones up to the far limit keep their value."""
    half = np.arange(2**16, dtype=np.uint16).view(np.float16).reshape(256, 256)
    frame = street_frame()
    camera = replace(frame.camera, width=256, height=256)
    picture = np.zeros((256, 256, 3), np.uint8)
    frame = Frame(frame.key, 0.0, camera, picture, None, half)
    window = (0, 0, 256, 256)
    expected = half.astype(np.float32)
    far = ~((expected > 0) & (expected < 60000))
    expected[far] = np.inf
    single = replace(frame, depth_m=half.astype(np.float32))
    for candidate in (frame, single):
        np.testing.assert_array_equal(expected, depth_of(surface_of(candidate), window))


def test_the_sky_of_an_unlabelled_frame_is_not_invalid():
    """However thick the air: the sky is what the airlight looks like."""
    frame = street_frame()
    unlabelled = replace(frame, label=None)
    sky = np.isinf(np.asarray(frame.depth_m))
    assert 0 < sky.sum() < sky.size
    shot = render(unlabelled, Weather.fog("extreme"), seed=0, ambience=AMBIENCE)
    assert not shot.invalid[sky].any()
    assert shot.invalid[~sky].any()


@pytest.mark.parametrize(
    "given", [{"alignment": "camera"}, {"rain_fall_speed": "atlas"}, {"multiple_scattering": True}]
)
def test_options_that_a_preset_would_ignore_are_refused(given):
    with pytest.raises(ArgumentError, match="means nothing with preset"):
        RenderOptions(preset="weatheredit", **given)
    assert RenderOptions(**given) != RenderOptions()


def test_options_of_another_type_are_refused():
    with pytest.raises(ArgumentError, match="options must be RenderOptions, got dict"):
        render(street_frame(), Weather.fog(0.5), seed=0, ambience=AMBIENCE, options={})
