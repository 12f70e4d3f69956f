"""Compression against libjpeg, which writes a file and reads it back."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scene import make_camera

from weather_aug.clip.types import FrameKey
from weather_aug.render import sensor
from weather_aug.render.compression import BLOCK_PX, compress, steps_of
from weather_aug.render.sensor import exposed
from weather_aug.weather import Weather

FULL, HALVED = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420


def through_a_file(image, quality, sampling=FULL):
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)


def compressed(image, quality=82):
    """The sensor's picture with nothing but compression."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sensor, "quality_of", lambda noise: quality)
        return exposed(
            image,
            None,
            window=(0, 0, *image.shape[:2]),
            camera=make_camera(image.shape[1], image.shape[0]),
            weather=Weather.rain("extreme"),
            seed=0,
            frame_key=FrameKey(0, "front"),
            noise=False,
            glare=False,
        )


def picture(height, width, seed, kind):
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    if kind == "hard":
        return np.where(noise > 127, 255, 0).astype(np.uint8)
    if kind == "smooth":
        return cv2.resize(noise[:4, :5], (width, height), interpolation=cv2.INTER_CUBIC)
    return noise


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 40),
    st.one_of(st.integers(1, 40), st.integers(120, 150)),
    st.integers(1, 100),
    st.integers(0, 99),
    st.sampled_from(["noise", "hard", "smooth"]),
)
def test_the_pixels_are_those_of_a_file(height, width, quality, seed, kind):
    image = picture(height, width, seed, kind)
    np.testing.assert_array_equal(through_a_file(image, quality), compressed(image, quality))


def test_another_file_is_seen():
    image = picture(48, 64, 1, "smooth")
    out = compressed(image)
    assert (through_a_file(image, 82, HALVED) != out).any()
    assert (through_a_file(image, 83) != out).any()
    assert (image != out).any()


def test_blocks_know_nothing_of_each_other():
    image = picture(32, 300, 2, "noise")
    changed = image.copy()
    changed[8:16, 136:144] ^= 255
    differs = (compressed(image) != compressed(changed)).any(axis=2)
    assert differs[8:16, 136:144].any()
    differs[8:16, 136:144] = False
    assert not differs.any()


def test_an_even_block_stays_even():
    strip = np.full((3, BLOCK_PX, 24), 77, np.uint8)
    compress(strip.view(np.uint64), steps_of(80))
    assert (strip == strip[:, :1, :1]).all()
    assert abs(int(strip[0, 0, 0]) - 77) <= 2
