"""The sensor's pixels: noise, glare and blocks, of the whole picture and of its windows."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.reference_render import linear, srgb
from render_scene import make_camera

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render import sensor
from weather_aug.render.compression import BLOCK_PX
from weather_aug.render.sensor import (
    block_window,
    daylight_share,
    exposed,
    exposure_s_in,
    gain_noise,
    quality_of,
)
from weather_aug.weather import Weather

HEIGHT, WIDTH = 75, 101  # no multiple of a block
CAMERA = make_camera(WIDTH, HEIGHT)
BIG = make_camera(512, 256)
KEY = FrameKey(3, "front")
STORM = Weather.rain("extreme")
BAD = [Weather.rain("heavy"), Weather.snow("heavy"), Weather.fog("heavy")]


@pytest.fixture(scope="module")
def picture():
    coarse = np.random.default_rng(5).integers(0, 256, (10, 13, 3), dtype=np.uint8)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def whole(picture):
    return cv2.resize(linear(picture).astype(np.float32), (50, 37), interpolation=cv2.INTER_AREA)


def shot(image, whole=None, window=None, camera=CAMERA, weather=STORM, seed=7, key=KEY, **parts):
    window = window or (0, 0, camera.height, camera.width)
    parts = {"glare": whole is not None, "compression": False} | parts
    arguments = {"window": window, "camera": camera, "weather": weather, "seed": seed}
    return exposed(image, whole, **arguments, frame_key=key, **parts)


def grain(level=118, draw=shot, **arguments):
    """(256, 512, 3) change of an even grey by noise alone."""
    even = np.full((256, 512, 3), level, np.uint8)
    return draw(even, camera=BIG, **arguments).astype(float) - level


def test_clear_weather_changes_nothing(picture, whole):
    for weather in (Weather.clear(), Weather(wetness=1.0, puddles=0.3, wind_m_per_s=(9, 0, 0))):
        out = shot(picture, whole, (0, 0, HEIGHT, WIDTH), weather=weather, compression=True)
        np.testing.assert_array_equal(picture, out)
        assert not np.shares_memory(picture, out)
        assert daylight_share(weather) == 1.0
        assert exposure_s_in(0.003, weather) == 0.003
        assert gain_noise(weather).sigma_levels.max() == 0.0


# noise ---------------------------------------------------------------------------------------


def sigma_by_the_formula(weather, level):
    """sqrt(shot L + read) dS/dL in levels, the slope by differences; and room before the ends."""
    light = linear(np.array([level - 0.01, level, level + 0.01]))
    slope = 0.02 / (light[2] - light[0])
    gain = 1.0 / (daylight_share(weather) * exposure_s_in(0.005, weather) / 0.005)
    variance = (gain - 1) / 5300 * light[1] + (gain**2 - 1) * 9e-8
    return min(slope * np.sqrt(variance), level / 3, (255 - level) / 3)


def wrong_sigmas(weather, levels=(6, 20, 60, 118, 180, 235, 250)):
    """Levels of grey whose noise is not the formula's; rounding adds a twelfth to the variance."""
    wrong = []
    for level in levels:
        expected = np.sqrt(sigma_by_the_formula(weather, level) ** 2 + 1 / 12)
        measured = grain(level, weather=weather).std(axis=(0, 1))
        if np.abs(measured / expected - 1).max() > 0.02:
            wrong.append(level)
    return wrong


@pytest.mark.parametrize("weather", [*BAD, STORM, Weather.rain("light")])
def test_sigma_by_level_is_the_formula(weather):
    assert wrong_sigmas(weather) == []


def test_a_wrong_law_of_noise_is_seen(monkeypatch):
    for name, value in (("SHOT_VARIANCE", 1 / 4000), ("READ_VARIANCE", 1e-6)):
        with monkeypatch.context() as planted:
            planted.setattr(sensor, name, value)
            assert wrong_sigmas(STORM) != []


def most_bias(draw):
    levels = (0, 1, 3, 8, 30, 118, 220, 250, 254, 255)
    return max(np.abs(grain(level, draw).mean(axis=(0, 1))).max() for level in levels)


def test_noise_keeps_the_mean():
    assert most_bias(shot) < 0.1

    def truncating(image, **arguments):
        return np.maximum(shot(image, **arguments), 1) - 1 * (image > 100)

    assert most_bias(truncating) > 0.1  # planted

    def clipping(image, **arguments):
        noise = np.random.default_rng(0).normal(0, 3, image.shape)
        return np.clip(np.rint(image + noise), 0, 255)

    assert most_bias(clipping) > 0.1  # planted: noise that does not fade towards black


def developed(seed):
    """An oracle: colours of white noise behind a mosaic, brightness of other, smoothed noise."""
    rng = np.random.default_rng(seed)
    raw, fine = rng.normal(size=(256, 512)), rng.normal(size=(256, 512))
    y, x = np.mgrid[:256, :512]
    line = np.array([1 / 6, 1 / 2, 2 / 3, 1 / 2, 1 / 6])
    cross = np.array([[0.15, 0.25, 0.15], [0.25, 0.4, 0.25], [0.15, 0.25, 0.15]])
    masks = ((y % 2 == 0) & (x % 2 == 0), (y + x) % 2 == 1, (y % 2 == 1) & (x % 2 == 1))
    kernels = (np.outer(line, line), cross, np.outer(line, line))
    planes = [2 * cv2.filter2D(raw * m, -1, k) for m, k in zip(masks, kernels, strict=True)]
    grey = planes[0] / 4 + planes[1] / 2 + planes[2] / 4
    plus = np.array([[0, 0.1, 0], [0.1, 0.6, 0.1], [0, 0.1, 0]])
    bright = cv2.filter2D(fine, -1, plus) / np.sqrt(0.4)
    return np.stack([bright + 0.8 * (plane - grey) for plane in planes], axis=2)


def correlations(noise):
    """At a few steps (dy, dx) for each colour, then between colours."""
    noise = (noise - noise.mean(axis=(0, 1))) / noise.std(axis=(0, 1))
    found = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (0, 3), (0, 5), (6, 0)):
        a, b = noise[dy:, dx:], noise[: 256 - dy, : 512 - dx]
        found += [*(a * b).mean(axis=(0, 1))]
    found += [(noise[..., a] * noise[..., b]).mean() for a, b in ((0, 1), (0, 2), (1, 2))]
    return np.array(found)


def test_grain_is_that_of_developed_colours():
    noise = grain()
    expected = correlations(developed(0))
    actual = correlations(noise)
    assert np.abs(expected - actual).max() < 0.03  # two samples of 130,000 correlated pixels
    assert actual[0] == pytest.approx(0.47, abs=0.02)  # red, one pixel to the side
    assert actual[1] == pytest.approx(0.38, abs=0.02)  # green
    white = np.random.default_rng(0).normal(size=noise.shape)
    assert np.abs(expected - correlations(white)).max() > 0.4  # planted: salt


def test_grain_has_no_pattern_of_two_pixels():
    noise = grain()
    by_place = np.array([noise[i::2, j::2].std(axis=(0, 1)) for i in (0, 1) for j in (0, 1)])
    assert np.abs(by_place / by_place.mean(axis=0) - 1).max() < 0.02


def test_grain_is_nearly_gaussian():
    noise = grain() / grain().std()
    assert abs((noise**3).mean()) < 0.03
    assert abs((noise**4).mean() - 3.0) < 0.2
    assert 3.8 < np.abs(noise).max() < 6.0


def likeness(**other):
    a, b = grain(), grain(**other)
    return abs(float((a * b).mean() / (a.std() * b.std())))


OTHERS = ({"key": FrameKey(4, "front")}, {"key": FrameKey(3, "left")}, {"seed": 8})


@pytest.mark.parametrize("other", OTHERS)
def test_frames_cameras_and_seeds_have_noise_of_their_own(other):
    assert likeness(**other) < 0.02


@pytest.mark.parametrize("other", OTHERS)
def test_noise_shared_by_frames_is_seen(monkeypatch, other):
    monkeypatch.setattr(sensor, "noise_key", lambda *key: 1)
    assert likeness(**other) > 0.9


def most_repeated(rows):
    """Largest correlation of a row with any other one, shifted by any number of pixels."""
    spectrum = np.fft.rfft((rows - rows.mean()) / rows.std())
    found = [
        np.abs(np.fft.irfft(spectrum * np.conj(np.roll(spectrum, step, axis=0)))).max()
        for step in range(6, 123)
    ]
    return max(found) / rows.shape[1]


def test_rows_are_no_shifted_copies_of_each_other():
    rows = grain().mean(axis=2)[:128]
    assert most_repeated(rows) < 0.6
    copies = rows.copy()
    copies[70] = np.roll(rows[10], 33)
    assert most_repeated(copies) > 0.9  # planted: one key for a row and a counter in it


# glare ---------------------------------------------------------------------------------------


def street_under_a_bright_sky():
    picture = np.full((256, 512, 3), 40, np.uint8)
    picture[:100] = 225
    light = linear(picture).astype(np.float32)
    return picture, cv2.resize(light, (256, 128), interpolation=cv2.INTER_AREA)


def test_a_bright_sky_bleeds_over_what_is_below_it():
    picture, light = street_under_a_bright_sky()
    out = shot(picture, light, camera=BIG, noise=False).astype(int)
    gain = (out - picture)[100:, 256, 1]
    assert 6 <= gain[0] <= 20
    assert (np.diff(gain) <= 0).all()
    assert gain[12] >= 2
    assert gain[-1] == 0
    assert (out[:40] == picture[:40]).all()


def test_glare_is_mixed_in_linear_light(picture, whole):
    out = shot(picture, whole, noise=False)
    blurs = [cv2.GaussianBlur(whole, (0, 0), 50 * s, borderType=1) for s in (0.012, 0.07)]
    veil = cv2.resize((blurs[0] + blurs[1]) / 2, (WIDTH, HEIGHT))
    expected = srgb(0.94 * linear(picture) + 0.06 * veil)
    assert np.abs(expected - out).max() < 1.5  # a rounding; the wide blur is made of less pixels
    in_srgb = 0.94 * picture + 0.06 * srgb(veil)
    assert np.abs(in_srgb - out).max() > 3.0  # planted


def test_an_even_picture_stays_as_it_is():
    for level in (0, 1, 9, 11, 12, 60, 180, 255):
        even = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
        light = np.full((37, 50, 3), linear(np.array(float(level))), np.float32)
        np.testing.assert_array_equal(even, shot(even, light, noise=False))
        assert (shot(even, 1.3 * light, noise=False) != even).any() or level in (
            0,
            1,
            9,
            11,
            12,
            255,
        )


def test_glare_needs_the_weathers_sky(picture, whole):
    dry = Weather(rain_mm_per_h=5.0)
    np.testing.assert_array_equal(picture, shot(picture, whole, weather=dry, noise=False))
    change = [
        np.abs(shot(picture, whole, weather=w, noise=False).astype(int) - picture).sum()
        for w in (Weather(overcast=0.3), Weather(overcast=0.6), Weather(overcast=1.0))
    ]
    assert 0 < change[0] < change[1] < change[2]


# windows, blocks, purity ---------------------------------------------------------------------


@st.composite
def windows(draw):
    top, left = draw(st.integers(0, HEIGHT - 1)), draw(st.integers(0, WIDTH - 1))
    return (
        top,
        left,
        draw(st.integers(1, HEIGHT - top)),
        draw(st.integers(1, WIDTH - left)),
    )


def part(image, window):
    top, left, rows, columns = window
    return image[top : top + rows, left : left + columns]


@settings(max_examples=60)
@given(windows())
def test_a_window_has_the_pixels_of_the_whole(picture, whole, window):
    expected = part(shot(picture, whole), window)
    np.testing.assert_array_equal(expected, shot(part(picture, window), whole, window))


def test_noise_keyed_by_the_windows_own_pixels_is_seen(picture):
    inner = part(picture, (16, 24, 40, 40))
    wrong = shot(inner, window=(0, 0, 40, 40))
    assert (wrong != part(shot(picture), (16, 24, 40, 40))).mean() > 0.3


def compressed_window(picture, whole, window):
    """As a caller asks for it: extended to whole blocks, then cut."""
    outer = block_window(window, CAMERA)
    out = shot(part(picture, outer), whole, outer, compression=True)
    return part(out, (window[0] - outer[0], window[1] - outer[1], *window[2:]))


@settings(max_examples=60)
@given(windows())
def test_a_window_has_the_blocks_of_the_whole(picture, whole, window):
    outer = block_window(window, CAMERA)
    expected = shot(picture, whole, compression=True)
    np.testing.assert_array_equal(part(expected, window), compressed_window(picture, whole, window))
    before = (window[0] - outer[0], window[1] - outer[1])
    after = (outer[2] - window[2] - before[0], outer[3] - window[3] - before[1])
    assert 0 <= min(*before, *after) <= max(*before, *after) < BLOCK_PX
    assert block_window(outer, CAMERA) == outer


def test_compression_is_light(picture):
    for weather, most in ((Weather.rain("light"), 3.0), (STORM, 4.2)):
        plain = shot(picture, weather=weather)
        loss = shot(picture, weather=weather, compression=True).astype(float) - plain
        assert 0.3 < loss.std() < most
        assert np.abs(loss.mean(axis=(0, 1))).max() < 0.25
        assert 80 <= quality_of(gain_noise(weather)) <= 95


def test_inputs_are_not_changed_and_outputs_are_the_same_again(picture, whole):
    image, light = picture.copy(), whole.copy()
    image.flags.writeable = light.flags.writeable = False
    first = shot(image, light, compression=True)
    np.testing.assert_array_equal(first, shot(image, light, compression=True))
    np.testing.assert_array_equal(picture, image)
    np.testing.assert_array_equal(whole, light)
    turned = np.asfortranarray(picture)
    np.testing.assert_array_equal(first, shot(turned, light, compression=True))


def test_bad_arguments_are_named(picture, whole):
    with pytest.raises(ArgumentError, match="whole is needed"):
        shot(picture, None, glare=True)
    with pytest.raises(ArgumentError, match="float32"):
        shot(picture, whole.astype(float))
    with pytest.raises(ArgumentError, match="whole must have shape"):
        shot(picture, whole[..., 0])
    with pytest.raises(ArgumentError, match="finite"):
        shot(picture, whole * np.float32(np.nan))
    with pytest.raises(ArgumentError, match="leaves the picture"):
        shot(picture, whole, (1, 0, HEIGHT, WIDTH))
    with pytest.raises(ArgumentError, match="is not the window"):
        shot(picture, whole, (0, 0, 8, 8))
    with pytest.raises(ArgumentError, match="block_window"):
        shot(picture[4:, 4:], whole, (4, 4, HEIGHT - 4, WIDTH - 4), compression=True)
    with pytest.raises(ArgumentError, match="seed"):
        shot(picture, whole, seed=0.5)
    with pytest.raises(ArgumentError, match="frame_key"):
        shot(picture, whole, key=(0, "front"))
    with pytest.raises(ArgumentError, match="weather"):
        shot(picture, whole, weather="rain")
    with pytest.raises(ArgumentError, match="camera_exposure_s"):
        exposure_s_in(0.0, STORM)
