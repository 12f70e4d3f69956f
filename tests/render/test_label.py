"""Labels say what can be seen: thresholds, the sky, small things, glass, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.reference_render import srgb
from render_scene import make_camera, make_frame

from weather_aug.edit.ambience import Ambience
from weather_aug.render import compose, label, label_runs
from weather_aug.render.compose import render
from weather_aug.render.label import kept_labels, least_linear_contrast, readable_labels
from weather_aug.render.label_runs import small_things
from weather_aug.render.label_weight import loss_weight_of
from weather_aug.render.options import RenderOptions
from weather_aug.taxonomy import CLASSES, IGNORE, ROAD, SIDEWALK, SKY, TRAIN_ID
from weather_aug.weather import Weather

AIRLIGHT = np.full(3, 0.5)
AMBIENCE = Ambience(
    np.eye(3),
    sky=np.array([0.4, 0.6, 0.9]),
    middle=np.full(3, 0.2),
    ground=np.full(3, 0.12),
    airlight=np.array([0.55, 0.56, 0.57]),
)
POLICIES = ("ignore_unseen", "keep", "acdc")


def sight(kind, transmittance, gap, covered=0, small=1, glass=0.0):
    """Sight of a 9 x 9 patch whose surface differs by `gap` (linear) from the airlight."""
    shape = (9, 9)
    gap, air = np.broadcast_to(gap, shape), np.full(shape, transmittance, np.float32)
    distinct = (gap * air >= least_linear_contrast(AIRLIGHT)).astype(np.uint8)
    planes = (np.full(shape, value, np.uint8) for value in (kind, covered, small))
    kind, covered, small = planes
    return readable_labels(kind, air, air * np.float32(1 - glass), distinct, covered, small)


def test_least_contrast_is_two_and_a_half_levels_at_the_airlight():
    step = least_linear_contrast(AIRLIGHT)
    assert srgb(0.5 + step / 2) - srgb(0.5 - step / 2) == pytest.approx(2.5, rel=1e-3)


@pytest.mark.parametrize(
    ("transmittance", "gap", "small", "unseen", "invalid"),
    [
        (1.0, 0.5, 1, 0, 0),
        (0.3, 0.5, 1, 0, 0),  # hazy but distinct
        (0.04, 0.9, 1, 0, 1),  # distinct, but small and beyond the optical range
        (0.04, 0.9, 0, 0, 0),  # as far away, but large
        (0.019, 0.9, 0, 1, 1),  # too little light, however distinct and large
        (0.3, 0.01, 0, 1, 1),  # the airlight's own colour, in haze
        (0.6, 0.0, 1, 0, 0),  # the airlight's own colour, in nearly clear air
    ],
)
def test_thresholds(transmittance, gap, small, unseen, invalid):
    found = sight(3, transmittance, gap, small=small)
    assert (unseen, invalid) == (found.unseen[4, 4], found.invalid[4, 4])


def test_one_distinct_pixel_keeps_its_neighbourhood():
    """An edge within three pixels is enough to see a surface."""
    gap = np.zeros((9, 9))
    gap[4, 4] = 0.5
    unseen = sight(3, 0.3, gap).unseen
    assert not unseen[1:8, 1:8].any()
    assert unseen[0, 0] == 1


def test_the_sky_stays_the_sky():
    found = sight(SKY, 0.0, 0.0)
    assert not found.unseen.any()
    assert not found.invalid.any()


def test_covered_pixels_are_unseen():
    found = sight(3, 0.9, 0.5, covered=1)
    assert found.unseen.all()
    assert found.invalid.all()


def test_glass_is_not_haze():
    """A clear drop hides no surface of the airlight's colour; next to no light does."""
    assert not sight(3, 0.9, 0.0, glass=0.8).unseen.any()
    assert sight(3, 0.9, 0.9, glass=0.99).unseen.all()


def horizon(kind, transmittance):
    """Sight of a patch that is sky above row 10 and something of the airlight's colour below."""
    shape = (20, 9)
    kinds = np.full(shape, SKY, np.uint8)
    kinds[10:] = kind
    air = np.where(kinds == SKY, 0, transmittance).astype(np.float32)
    zero = np.zeros(shape, np.uint8)
    return readable_labels(kinds, air, air, zero, zero)


def test_sky_is_invalid_only_where_what_stood_before_it_has_vanished():
    gone = horizon(3, 0.1)
    assert gone.invalid[7:].all()
    assert not gone.invalid[:7].any()
    assert not gone.unseen[:10].any()
    assert not horizon(3, 0.9).invalid.any()


def test_what_nobody_labelled_does_not_vanish_from_the_horizon():
    """Borders of labels often are unlabelled and without depth, in clear air as in fog."""
    assert not horizon(IGNORE, 0.0).invalid[:10].any()


def columns(label_):
    frame = make_frame(make_camera(*label_.shape[::-1]), 90, 20.0, label_)
    return lambda window: small_things(frame, window)


def test_small_is_less_than_twelve_pixels_tall():
    label_ = np.zeros((40, 3), np.uint8)
    label_[10:21, 0] = 11
    label_[10:22, 1] = 11
    label_[0:11, 2] = 11
    found = columns(label_)((0, 0, 40, 3)) == 1
    assert found[10:21, 0].all()
    assert not found[10:22, 1].any()
    assert found[:11, 2].all()
    assert found[:10, 0].all()
    assert not found[21:].any()


@given(seed=st.integers(0, 2**32 - 1), top=st.integers(0, 59), left=st.integers(0, 7))
def test_small_things_of_any_window(seed, top, left):
    rng = np.random.default_rng(seed)
    label_ = np.repeat(rng.integers(0, 2, (20, 8), dtype=np.uint8), 3, 0)
    height, width = int(rng.integers(1, 61 - top)), int(rng.integers(1, 9 - left))
    of = columns(label_)
    whole, part = of((0, 0, 60, 8)), of((top, left, height, width))
    np.testing.assert_array_equal(whole[top : top + height, left : left + width], part)
    for y, x in zip(rng.integers(0, 60, 5), rng.integers(0, 8, 5), strict=True):
        ends = np.flatnonzero(np.diff(label_[:, x], prepend=9, append=9))
        run = np.diff(ends)[np.searchsorted(ends, y, side="right") - 1]
        assert whole[y, x] == (run < 12)


def test_policies():
    """Static classes keep their id for "acdc", moving ones do not; nobody relabels what is seen."""
    ids = np.array([[*range(19), IGNORE]] * 2, np.uint8)
    unseen = np.zeros_like(ids)
    unseen[1] = 1
    found = {policy: kept_labels(ids, unseen, policy) for policy in POLICIES}
    for out in found.values():
        np.testing.assert_array_equal(ids[0], out[0])
    assert (found["ignore_unseen"][1] == IGNORE).all()
    np.testing.assert_array_equal(ids, found["keep"])
    moving = {CLASSES[i] for i in range(19) if found["acdc"][1, i] == IGNORE}
    riders = {"person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"}
    assert riders == moving


def dim_street(width=97, height=61, velocity=(8.0, 0.5, 0)):
    """Things of all classes and sizes at all distances, some of the airlight's colour."""
    rng = np.random.default_rng(3)
    camera = make_camera(width, height, velocity=velocity, exposure_s=0.003)
    shape = (-(-height // 5), -(-width // 7))
    blocks = [rng.choice(19, shape).astype(np.uint8), 3.0 * 40.0 ** rng.random(shape)]
    label_, depth = (b.repeat(5, 0).repeat(7, 1)[:height, :width] for b in blocks)
    rows = np.arange(height // 2, height)
    label_[height // 2 :] = np.where(np.arange(width) < width // 3, SIDEWALK, ROAD)
    label_[-9:-6, 50:60] = IGNORE
    depth[height // 2 :] = (110.0 / (rows - 0.45 * height))[:, None]
    depth[label_ == SKY] = np.inf
    label_ = np.ascontiguousarray(label_)
    image = rng.integers(150, 220, (height, width, 3), dtype=np.uint8)
    return make_frame(camera, image, depth, label_)


DEEP = {"snow_cover": 1.0, "road_snow_cover": 1.0, "snow_depth_m": 0.2}
WEATHERS = (
    Weather.fog("extreme"),
    Weather(visibility_m=30.0, lens_drops=60.0, **DEEP),
    Weather.mix(Weather.rain("extreme"), Weather.snow("extreme")),
)


@settings(max_examples=30)
@given(
    weather=st.sampled_from(WEATHERS),
    policy=st.sampled_from(POLICIES),
    window=st.tuples(
        st.integers(0, 60), st.integers(0, 96), st.integers(1, 61), st.integers(1, 97)
    ),
)
def test_labels_of_any_window_are_those_of_the_whole(weather, policy, window):
    top, left, height, width = window
    window = (top, left, min(height, 61 - top), min(width, 97 - left))
    check_window(weather, policy, window)


def check_window(weather, policy, window):
    frame, options = dim_street(), RenderOptions(500, labels=policy)
    shots = [
        render(frame, weather, seed=2, ambience=AMBIENCE, window=w, options=options)
        for w in (None, window)
    ]
    part = np.s_[window[0] : window[0] + window[2], window[1] : window[1] + window[3]]
    for name in ("label", "label_full", "invalid", "transmittance", "loss_weight"):
        whole, cut = (getattr(shot, name) for shot in shots)
        np.testing.assert_array_equal(whole[part], cut)


def test_a_margin_too_small_is_found_out(monkeypatch):
    """The fault: the sky looks at surfaces within 3 pixels, those at their own 3 are forgotten."""
    monkeypatch.setattr(compose, "MARGIN_PX", 0)
    options = ("compression",)
    frame = dim_street()
    found = [
        render(
            frame,
            WEATHERS[0],
            seed=2,
            ambience=AMBIENCE,
            window=window,
            options=RenderOptions(500, without=options),
        ).invalid
        for window in ((0, 0, 61, 97), *((y, 0, 1, 97) for y in range(61)))
    ]
    assert not np.array_equal(found[0], np.concatenate(found[1:]))


@pytest.mark.parametrize("policy", POLICIES)
def test_policies_of_a_render(policy):
    frame = dim_street()
    fog = Weather.fog("extreme")
    shot = render(frame, fog, seed=1, ambience=AMBIENCE, options=RenderOptions(labels=policy))
    other = render(frame, fog, seed=1, ambience=AMBIENCE)
    np.testing.assert_array_equal(other.invalid, shot.invalid)
    np.testing.assert_array_equal(other.label_full, shot.label_full)
    lost = (other.label == IGNORE) & (frame.label != IGNORE)
    moving = frame.label >= TRAIN_ID["person"]
    assert (lost & moving).any()
    assert (lost & ~moving).any()
    expected = {"ignore_unseen": lost, "keep": lost & False, "acdc": lost & moving}[policy]
    np.testing.assert_array_equal(expected, shot.label != frame.label)
    assert shot.invalid[lost].all()


def test_a_frame_without_labels_has_none_and_still_an_invalid_mask(ambience):
    frame = make_frame(make_camera(), 60, 150.0)
    shot = render(frame, Weather.fog("extreme"), seed=0, ambience=ambience)
    assert shot.label is None
    assert shot.label_full is None
    assert shot.invalid.all()
    assert not shot.loss_weight.any()


def test_where_nobody_labelled_all_that_is_doubtful_is_invalid(ambience):
    """Nobody knows how tall it is."""
    road = np.zeros((96, 160), np.uint8)
    weather = Weather(visibility_m=42.0)
    frame = make_frame(make_camera(focal_px=2_000.0), 10, 45.0)
    assert render(frame, weather, seed=0, ambience=ambience).invalid.all()
    labelled = replace(frame, label=road)
    assert not render(labelled, weather, seed=0, ambience=ambience).invalid.any()


def test_drops_on_the_glass_turn_labels_into_ignore():
    """Where they are more than half opaque and blur by more than 4 pixels, and nowhere else."""
    frame = make_frame(make_camera(640, 360), 60, 20.0, np.zeros((360, 640), np.uint8))
    rain = Weather(lens_drops=60.0)
    shot = render(frame, rain, seed=1, ambience=AMBIENCE)
    lost = shot.label == IGNORE
    assert 0.001 < lost.mean() < 0.1
    assert shot.transmittance[lost].max() < 0.5
    np.testing.assert_array_equal(lost, shot.invalid == 1)
    dry = RenderOptions(without=("drops",))
    assert not render(frame, rain, seed=1, ambience=AMBIENCE, options=dry).invalid.any()


def test_loss_weight_follows_the_transmittance_and_forgets_no_sky():
    through = np.array([0.0, 0.02, 0.06, 0.1, 0.9, 0.0, 0.0, 0.5], np.float32)
    invalid = np.array([1, 1, 1, 0, 0, 0, 1, 1], np.uint8)
    sky = np.array([0, 0, 0, 0, 0, 1, 1, 0], bool)
    lost = np.array([1, 0, 0, 0, 0, 0, 0, 1], bool)
    weight = loss_weight_of(through, invalid, sky, lost)
    assert weight.dtype == np.float32
    np.testing.assert_allclose([0, 0, 0.5, 1, 1, 1, 0, 0], weight, atol=1e-6)


def test_loss_weight_of_a_render():
    frame = dim_street()
    shot = render(frame, Weather.fog("extreme"), seed=1, ambience=AMBIENCE)
    weight = shot.loss_weight
    assert weight.dtype == np.float32
    assert (weight[shot.label != shot.label_full] == 0).all()
    assert (weight[(frame.label == SKY) & (shot.invalid == 0)] == 1).all()
    assert 0 < weight.mean() < 1
    clear = render(frame, Weather.clear(), seed=1, ambience=AMBIENCE)
    assert (clear.loss_weight == 1).all()


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (label, "LEAST_TRANSMITTANCE", 0.5),
        (label, "HAZY_TRANSMITTANCE", 0.0),
        (label, "DOUBTFUL_TRANSMITTANCE", 0.0),
    ],
)
def test_other_thresholds_are_found_out(monkeypatch, module, name, value):
    """The tables above and below would notice: each limit decides about some pixel of fog."""
    frame, fog = dim_street(), Weather.fog("extreme")
    right = render(frame, fog, seed=1, ambience=AMBIENCE)
    monkeypatch.setattr(module, name, value)
    wrong = render(frame, fog, seed=1, ambience=AMBIENCE)
    same = [np.array_equal(getattr(right, n), getattr(wrong, n)) for n in ("label", "invalid")]
    assert not all(same)


def test_another_least_height_is_found_out(monkeypatch):
    label_ = np.zeros((40, 1), np.uint8)
    label_[10:21] = 11
    monkeypatch.setattr(label_runs, "LEAST_HEIGHT_PX", 11)
    assert not columns(label_)((0, 0, 40, 1))[10:21].any()
