"""Check 15: labels say what can be seen, and never more than the recorded label said."""

import numpy as np
import pytest
from oracles import faults
from physics_scene import measured
from render_scene import make_camera, make_frame

from weather_aug.render.compose import render
from weather_aug.render.options import RenderOptions
from weather_aug.taxonomy import BUILDING, IGNORE, PALETTE, ROAD, SIDEWALK, SKY, TRAIN_ID
from weather_aug.weather import Weather

KINDS = ("rain", "snow", "fog")
STOPS = (0.02, 0.25, 0.5, 0.75, 1.0)
GRID = np.linspace(0, 1, 21)
CAR = TRAIN_ID["car"]
WIDTH, HEIGHT = 160, 96


def street(noise_seed=0):
    """A street of 100 m: houses on the left, a sidewalk, a car, the sky; any colours."""
    rng = np.random.default_rng(noise_seed)
    camera = make_camera(WIDTH, HEIGHT)
    depth = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    label = np.full((HEIGHT, WIDTH), SKY, np.uint8)
    rows = np.arange(49, HEIGHT)
    depth[49:] = np.minimum(1.5 * 120 / (rows - 47.5), 100)[:, None]
    label[49:] = ROAD
    left_m = depth[49:] * (79.5 - np.arange(WIDTH)) / 120
    label[49:][left_m > 3.0] = SIDEWALK
    depth[20:49, :70], label[20:49, :70] = np.linspace(100, 15, 70), BUILDING
    depth[46:60, 110:125], label[46:60, 110:125] = 18.0, CAR
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return make_frame(camera, image, depth, label)


def weather_at(kind, severity):
    return getattr(Weather, kind)(severity)


def honest(frame, weather, ambience, seed=1):
    """Labels (H, W) for training, as the renderer gives them."""
    options = RenderOptions(2_000)
    return render(frame, weather, seed=seed, ambience=ambience, options=options).label


def predicted_from_colour(frame, weather, ambience):
    """The fault: the class whose colour in the palette is nearest to the edited picture's."""
    image = render(frame, weather, seed=1, ambience=ambience).image.astype(int)
    away = np.abs(image[:, :, None] - np.array(PALETTE)).sum(-1)
    return away.argmin(-1).astype(np.uint8)


def mixed_ids(frame, weather, ambience):
    """The fault: ids are resized smoothly, so that between road and sky something else lies."""
    label = honest(frame, weather, ambience).astype(float)
    return ((label + np.roll(label, 1, 0)) / 2).astype(np.uint8)


def hidden_by_half(frame, weather, ambience):
    """The fault: what is half hidden counts as hidden."""
    shot = render(frame, weather, seed=1, ambience=ambience)
    far = (shot.transmittance < 0.5) & (shot.label_full != SKY)
    return np.where(far, IGNORE, shot.label)


def relabelled_snow(frame, weather, ambience):
    """The fault: what snow covers becomes another class."""
    label = honest(frame, weather, ambience).copy()
    if weather.snow_cover > 0.5:
        label[label == ROAD] = TRAIN_ID["terrain"]
    return label


def check_ids(labels_of, ambience):
    """Ids are 0 to 18 or 255, and none appears that was absent."""
    frame = street()
    present = {int(v) for v in np.unique(frame.label)} | {IGNORE}
    for kind in KINDS:
        for severity in STOPS:
            found = labels_of(frame, weather_at(kind, severity), ambience)
            ids = {int(v) for v in np.unique(found)}
            assert found.dtype == np.uint8
            assert ids <= {*range(19), IGNORE}
            assert ids <= present


def check_never_from_the_picture(labels_of, ambience):
    """A label is the recorded one or 255, and other colours leave the same classes."""
    frames = [street(0), street(7)]
    before = frames[0].label.copy()
    for kind in KINDS:
        for severity in STOPS:
            found = [labels_of(frame, weather_at(kind, severity), ambience) for frame in frames]
            for label in found:
                kept = label != IGNORE
                assert np.array_equal(label[kept], before[kept])
            both = (found[0] != IGNORE) & (found[1] != IGNORE)
            assert np.array_equal(found[0][both], found[1][both])
    assert np.array_equal(frames[0].label, before)


def ignored_share(label, recorded):
    return float(np.mean(label[recorded != SKY] == IGNORE))


def check_ignored_grows(kind, ambience, weather_of=weather_at, seed_of=lambda s: 1):
    """The ignored share of surfaces never falls along 21 severities, where no wiper runs.

    A wiper makes more of the street visible in heavier rain: that is what it is for.
    """
    frame = street()
    options = RenderOptions(2_000, without=("wipers",))
    shares = []
    for s in GRID:
        weather = weather_of(kind, s)
        shot = render(frame, weather, seed=seed_of(s), ambience=ambience, options=options)
        shares.append(ignored_share(shot.label, frame.label))
    measured(f"15: {kind}: ignored {np.round(shares[::4], 4)}")
    assert shares[0] == 0
    assert (np.diff(shares) >= 0).all()
    assert shares[-1] > 0


def check_moderate_fog_hides_little(labels_of, ambience):
    """Up to moderate fog less than a tenth of what is not sky is ignored on 100 m."""
    frame = street()
    shares = [
        ignored_share(labels_of(frame, Weather.fog(s), ambience), frame.label)
        for s in GRID
        if s <= 0.5
    ]
    measured(f"15: moderate fog: ignored {max(shares):.4f}")
    assert max(shares) < 0.1


def test_15_ids(ambience):
    check_ids(honest, ambience)


@pytest.mark.parametrize("fault", [predicted_from_colour, mixed_ids, relabelled_snow])
def test_15_other_classes_are_found_out(fault, ambience):
    with pytest.raises(AssertionError):
        check_ids(fault, ambience)


def test_15_never_from_the_picture(ambience):
    check_never_from_the_picture(honest, ambience)


@pytest.mark.parametrize("fault", [predicted_from_colour, relabelled_snow])
def test_15_labels_from_the_picture_are_found_out(fault, ambience):
    with pytest.raises(AssertionError):
        check_never_from_the_picture(fault, ambience)


@pytest.mark.parametrize("kind", KINDS)
def test_15_ignored_grows(kind, ambience):
    check_ignored_grows(kind, ambience)


def test_15_a_draw_for_each_severity_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_ignored_grows("rain", ambience, seed_of=faults.seed_of_severity)


def test_15_a_scale_that_turns_back_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_ignored_grows("fog", ambience, lambda kind, s: weather_at(kind, min(s, 1.9 - s)))


def test_15_moderate_fog_hides_little(ambience):
    check_moderate_fog_hides_little(honest, ambience)


def test_15_hiding_what_is_half_hidden_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_moderate_fog_hides_little(hidden_by_half, ambience)
