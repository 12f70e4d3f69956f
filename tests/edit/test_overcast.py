import numpy as np

from weather_aug.colour import LUMINANCE, SRGB_LEVELS_LINEAR
from weather_aug.edit.physical.overcast import MIDDLE_GREY, tone


def test_a_recorded_sky_changes_nothing():
    curve, matrix = tone(0.0)
    np.testing.assert_array_equal(SRGB_LEVELS_LINEAR, curve)
    np.testing.assert_allclose(np.eye(3), matrix, atol=1e-15)


def test_tone_is_continuous_in_the_overcast():
    curves = np.array([tone(o)[0] for o in np.linspace(0, 1, 101)])
    assert np.abs(np.diff(curves, axis=0)).max() < 0.01


def test_overcast_flattens_contrast_about_middle_grey_and_keeps_black():
    curve, _ = tone(1.0)
    assert curve[0] == 0
    assert (np.diff(curve) > 0).all()
    shadows, lights = SRGB_LEVELS_LINEAR < 0.5 * MIDDLE_GREY, SRGB_LEVELS_LINEAR > 0.3
    assert (curve[shadows][1:] > SRGB_LEVELS_LINEAR[shadows][1:]).all()
    assert (curve[lights] < SRGB_LEVELS_LINEAR[lights]).all()


def test_overcast_takes_a_third_of_the_saturation_and_turns_the_white_blue():
    _, matrix = tone(1.0)
    red = np.array([0.6, 0.2, 0.2])
    before, after = np.ptp(red), np.ptp(matrix @ red)
    assert 0.5 < after / before < 0.7
    white = matrix @ np.ones(3)
    assert white[2] > white[1] > white[0]
    assert abs(LUMINANCE @ white - 1) < 0.03
