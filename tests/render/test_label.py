"""Labels say what can be seen: thresholds, the sky, and what never happens."""

import numpy as np
import pytest
from oracles.reference_render import srgb
from render_scene import make_camera, make_frame

from weather_aug.render.compose import render
from weather_aug.render.label import least_linear_contrast, readable_labels
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.weather import Weather

AIRLIGHT = np.full(3, 0.5)


def readable(label, transmittance, gap, covered=0):
    """Labels of a 9 x 9 patch whose surface differs by `gap` (linear) from the airlight."""
    shape = (9, 9)
    gap, through = np.broadcast_to(gap, shape), np.full(shape, transmittance, np.float32)
    distinct = (gap * through >= least_linear_contrast(AIRLIGHT)).astype(np.uint8)
    label = np.full(shape, label, np.uint8)
    return readable_labels(label, through, distinct, np.full(shape, covered, np.uint8))


def test_least_contrast_is_two_and_a_half_levels_at_the_airlight():
    step = least_linear_contrast(AIRLIGHT)
    assert srgb(0.5 + step / 2) - srgb(0.5 - step / 2) == pytest.approx(2.5, rel=1e-3)


@pytest.mark.parametrize(
    ("transmittance", "gap", "label", "invalid"),
    [
        (1.0, 0.5, 3, 0),
        (0.3, 0.5, 3, 0),  # hazy but distinct
        (0.04, 0.9, 3, 1),  # distinct, but beyond the optical range
        (0.019, 0.9, IGNORE, 1),  # too little light, however distinct
        (0.3, 0.01, IGNORE, 1),  # the airlight's own colour, in haze
        (0.6, 0.0, 3, 0),  # the airlight's own colour, in nearly clear air
    ],
)
def test_thresholds(transmittance, gap, label, invalid):
    out, mask = readable(3, transmittance, gap)
    assert (label, invalid) == (out[4, 4], mask[4, 4])


def test_one_distinct_pixel_keeps_its_neighbourhood():
    """An edge within three pixels is enough to see a surface."""
    gap = np.zeros((9, 9))
    gap[4, 4] = 0.5
    out, _ = readable(3, 0.3, gap)
    assert (out[1:8, 1:8] == 3).all()
    assert out[0, 0] == IGNORE


def test_the_sky_stays_the_sky():
    out, mask = readable(SKY, 0.0, 0.0)
    assert (out == SKY).all()
    assert not mask.any()


def test_covered_pixels_are_ignored():
    out, mask = readable(3, 0.9, 0.5, covered=1)
    assert (out == IGNORE).all()
    assert mask.all()


def test_ignored_area_grows_with_fog_and_is_small_up_to_moderate(ambience):
    """On a street of 100 m less than a tenth of what is not sky is lost up to moderate fog."""
    rng = np.random.default_rng(0)
    camera = make_camera(160, 96)
    depth = np.full((96, 160), np.inf, np.float32)
    label = np.full((96, 160), SKY, np.uint8)
    rows = np.arange(49, 96)
    depth[49:] = np.minimum(1.5 * 120 / (rows - 47.5), 100)[:, None]
    label[49:] = 0
    depth[20:49, :70], label[20:49, :70] = np.linspace(100, 15, 70), 2
    image = rng.integers(0, 255, (96, 160, 3), dtype=np.uint8)
    frame = make_frame(camera, image, depth, label)
    before = label.copy()
    shares = []
    for s in np.linspace(0, 1, 11):
        shot = render(frame, Weather.fog(s), seed=0, ambience=ambience)
        assert set(np.unique(shot.label)) <= set(np.unique(label)) | {IGNORE}
        np.testing.assert_array_equal(shot.label_full, before)
        shares.append(np.mean(shot.label[label != SKY] == IGNORE))
    assert (np.diff(shares) >= 0).all()
    assert shares[5] < 0.1
    assert shares[10] > 0.1
    np.testing.assert_array_equal(frame.label, before)


def test_a_frame_without_labels_has_none_and_still_an_invalid_mask(ambience):
    frame = make_frame(make_camera(), 60, 150.0)
    shot = render(frame, Weather.fog("extreme"), seed=0, ambience=ambience)
    assert shot.label is None
    assert shot.label_full is None
    assert shot.invalid.all()
