"""Forward scattering: where it begins, how wide it is, what it leaves alone, windows."""

import numpy as np
import pytest
from oracles.reference_render import linear, srgb
from scipy.ndimage import gaussian_filter

from weather_aug.errors import ArgumentError
from weather_aug.render.scattering import scattered_background, scattering_margin_px

FOCAL_PX = 700.0


@pytest.fixture(scope="module")
def picture():
    rng = np.random.default_rng(8)
    coarse = rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1)


def depths_like(picture, tau):
    return np.full(picture.shape[:2], tau, np.float32)


@pytest.mark.parametrize("tau", [0.0, 0.3, 0.5])
def test_thin_fog_scatters_nothing(picture, tau):
    np.testing.assert_array_equal(
        picture, scattered_background(picture, depths_like(picture, tau), FOCAL_PX)
    )


def test_an_even_picture_stays_as_it_is():
    for level in (0, 1, 60, 255):
        even = np.full((40, 50, 3), level, np.uint8)
        tau = np.random.default_rng(0).uniform(0, 9, (40, 50)).astype(np.float32)
        np.testing.assert_array_equal(even, scattered_background(even, tau, FOCAL_PX))


@pytest.mark.parametrize(("tau", "weight"), [(0.75, 0.035), (1.5, 0.14), (4.5, 0.35), (20.0, 0.35)])
def test_even_fog_is_the_formula(picture, tau, weight):
    """sigma = f theta sqrt(tau - 0.5), capped at tau = 4.5, mixed in linear light."""
    sigma = FOCAL_PX * 0.004 * np.sqrt(min(tau, 4.5) - 0.5)
    light = linear(picture)
    soft = gaussian_filter(light, (sigma, sigma, 0), mode="mirror", truncate=3.0)
    expected = srgb(light + weight * (soft - light))
    actual = scattered_background(picture, depths_like(picture, tau), FOCAL_PX)
    # One rounding, fixed-point weights; between two blurs of the stack the shape is not Gaussian.
    assert np.abs(expected - actual).max() < (1.0 if tau != 0.75 else 1.5)
    assert np.abs(expected - picture).max() > 5


def glow(tau_near):
    """Change of a dark street around a bright, near car; sRGB levels."""
    picture = np.full((60, 60, 3), 40, np.uint8)
    tau = depths_like(picture, 2.0)
    picture[20:40, 20:40], tau[20:40, 20:40] = 250, tau_near
    out = scattered_background(picture, tau, FOCAL_PX).astype(int)
    assert (out[20:40, 20:40] == 250).all() or tau_near > 0.5
    out[20:40, 20:40] = 40
    return np.abs(out - 40).max()


def test_a_near_car_leaves_no_glow_and_a_far_one_does():
    assert glow(0.0) == 0
    assert glow(2.0) > 15


@pytest.mark.parametrize("window", [(10, 20, 40, 60), (0, 0, 30, 31), (50, 100, 46, 44)])
def test_a_window_with_its_margin_is_the_whole(picture, window):
    tau = np.random.default_rng(1).gamma(2.0, 1.0, picture.shape[:2]).astype(np.float32)
    tau[:10] = 1e4  # sky
    margin = scattering_margin_px(FOCAL_PX, np.inf)
    whole = scattered_background(picture, tau, FOCAL_PX)
    assert differs(picture, tau, window, margin, whole) == 0
    assert differs(picture, tau, window, margin // 4, whole) > 0  # planted: too small a margin


def differs(picture, tau, window, margin, whole):
    top, left, rows, columns = window
    y0, x0 = max(top - margin, 0), max(left - margin, 0)
    part = (slice(y0, top + rows + margin), slice(x0, left + columns + margin))
    cut = scattered_background(picture[part], tau[part], FOCAL_PX)
    inner = cut[top - y0 : top - y0 + rows, left - x0 : left - x0 + columns]
    return (inner != whole[top : top + rows, left : left + columns]).sum()


def test_margin_follows_the_fog():
    margins = [scattering_margin_px(FOCAL_PX, tau) for tau in (0.4, 0.6, 1.0, 3.0, 60.0, np.inf)]
    assert margins[0] == 0
    assert margins == sorted(margins)
    assert margins[-1] == int(np.ceil(3 * 2 * 0.004 * FOCAL_PX))


def test_inputs_are_not_changed(picture):
    tau = depths_like(picture, 3.0)
    before = picture.copy()
    picture.flags.writeable = False
    scattered_background(picture, tau, FOCAL_PX)
    picture.flags.writeable = True
    np.testing.assert_array_equal(before, picture)


def test_bad_arguments_are_named(picture):
    with pytest.raises(ArgumentError, match="optical_depth"):
        scattered_background(picture, np.zeros((3, 3), np.float32), FOCAL_PX)
    with pytest.raises(ArgumentError, match="optical_depth"):
        scattered_background(picture, np.zeros(picture.shape[:2]), FOCAL_PX)
    with pytest.raises(ArgumentError, match="focal_px"):
        scattered_background(picture, depths_like(picture, 1.0), 0.0)
