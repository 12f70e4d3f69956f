"""A street whose light is known: what its recorded sun did must be found and undone."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.colour import LUMINANCE, SRGB_LEVELS_LINEAR, srgb_from_linear
from weather_aug.edit.physical import relight
from weather_aug.edit.physical.site import site_of
from weather_aug.taxonomy import BUILDING, GROUND, ROAD, SKY, TRAIN_ID, VEGETATION

HEIGHT, WIDTH, HORIZON, FOCAL = 300, 640, 110, 500.0
CAMERA_M = 1.5
AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
ROAD_LIGHT, MARKING_LIGHT, SHADOW = 0.22, 0.66, 0.25
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HORIZON], [0, 0, 1]])


@dataclass(frozen=True)
class Street:
    frame: Frame
    truth: np.ndarray
    """(H, W) linear light without shadow."""
    shade: np.ndarray
    marking: np.ndarray
    z: np.ndarray
    x: np.ndarray


def soft(distance_m):
    return np.clip(0.5 + distance_m / 0.3, 0, 1)


def street(*, shadowed=True, car=False, blue=1.0, seed=0):
    """A level road with a line along it, half of it under a shadow from 7 to 12 m."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    ground = rows > HORIZON
    with np.errstate(divide="ignore"):
        z = np.where(ground, CAMERA_M * FOCAL / np.where(ground, rows - HORIZON, 1), np.inf)
    x = np.where(ground, (columns - WIDTH / 2) / FOCAL * np.where(ground, z, 0), 0)
    label = np.where(ground, ROAD, SKY).astype(np.uint8)
    marking = ground & (np.abs(x) < 0.08)
    rng = np.random.default_rng(seed)
    texture = np.exp(0.06 * rng.standard_normal((HEIGHT, WIDTH)))
    truth = np.where(marking, MARKING_LIGHT, ROAD_LIGHT) * texture
    inside = soft(z - 7) * soft(12 - z) * soft(x + 2.5) if shadowed else np.zeros_like(x)
    shade = 1 - (1 - SHADOW) * np.where(ground, inside, 0)
    light = np.repeat((truth * shade)[..., None], 3, 2)
    light[..., 2] *= 1 + (blue - 1) * (1 - shade) / (1 - SHADOW)
    light[~ground] = np.array([0.25, 0.4, 0.85])
    if car:
        body = (np.abs(x - 2.2) < 0.9) & ground & (z < 6.3) & (z > 5)
        top, bottom = np.nonzero(body)[0].min() - 60, np.nonzero(body)[0].min()
        left, right = np.nonzero(body)[1].min(), np.nonzero(body)[1].max()
        label[top:bottom, left:right] = TRAIN_ID["car"]
        z[top:bottom, left:right] = 6.3
        light[top:bottom, left:right] = 0.02
        near = np.where(np.abs(x - 2.2) < 0.9, np.maximum(6.3 - z, 0), 9.0)
        light[label == ROAD] *= (1 - 0.85 * np.exp(-near / 0.5))[label == ROAD][:, None]
    image = np.round(255 * srgb_from_linear(np.clip(light, 0, 1))).astype(np.uint8)
    camera = Camera(INTRINSICS, np.eye(4), WIDTH, HEIGHT)
    frame = Frame(FrameKey(0, "front"), 0.0, camera, image, label, z.astype(np.float32))
    return Street(frame, truth, shade, marking, z, x)


def full_size(plane, site):
    (height, width), (rows, columns) = site.classes.shape, site.shape
    size = columns * site.step, rows * site.step
    large = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    return large[:height, :width]


def relit(here):
    """(H, W) linear luminance under an even sky, and the log gain."""
    site = site_of(here.frame, AXES, CAMERA_M)
    lines = relight.flattening(site)
    luma = here.frame.image @ LUMINANCE / 255
    slope, offset, least, most = (
        full_size(np.ascontiguousarray(lines.ground[..., k]), site) for k in range(4)
    )
    gain = np.clip(slope * luma + offset, least, most)
    light = SRGB_LEVELS_LINEAR[here.frame.image] @ LUMINANCE
    return np.where(np.isin(site.classes, GROUND), light * np.exp(gain), light), gain


def shadow_error(here):
    """Largest relative error of the restored asphalt's means, in the shadow and on its edge."""
    light, _ = relit(here)
    plain = (np.abs(here.x) > 0.4) & (here.x > -1.8) & (here.x < 2.5)
    ratio = np.log(light / here.truth)
    inner = plain & (here.z > 7.5) & (here.z < 11.2)
    rows = [
        ratio[row][plain[row]].mean()
        for row in range(HORIZON + 50, HEIGHT - 1)
        if 6.3 < here.z[row, 0] < 13.0
    ]
    return abs(np.expm1(ratio[inner].mean())), np.ptp(rows) / -np.log(SHADOW)


def test_a_known_shadow_is_taken_off_with_its_edge():
    inside, edge = shadow_error(street())
    assert inside < 0.15
    assert edge < 0.10


@pytest.mark.parametrize(
    "fault",
    [("MOST_GROUND_GAIN", np.log(2.5)), ("SHADOW_DROP", 2.0), ("EDGE_EPSILON", 1.0)],
    ids=lambda fault: fault[0],
)
def test_a_shadow_left_or_an_edge_is_seen(monkeypatch, fault):
    monkeypatch.setattr(relight, *fault)
    inside, edge = shadow_error(street())
    assert inside > 0.15 or edge > 0.10


def marking_contrast_error(here):
    light, _ = relit(here)
    errors = []
    for low, high in ((3.5, 6.0), (8.0, 11.0), (13.5, 18.0)):
        strip = (here.z > low) & (here.z < high)
        line = strip & (np.abs(here.x) < 0.04)
        beside = strip & (np.abs(here.x) > 0.3) & (np.abs(here.x) < 1.5)
        contrast = np.median(light[line]) / np.median(light[beside])
        errors.append(abs(contrast / (MARKING_LIGHT / ROAD_LIGHT) - 1))
    return max(errors)


def test_a_lane_marking_stays_as_white_as_it_was():
    assert marking_contrast_error(street()) < 0.10


def test_a_marking_taken_for_light_is_seen(monkeypatch):
    monkeypatch.setattr(relight, "MARKING_WIDTH_M", 0.0)
    assert marking_contrast_error(street()) > 0.10


def test_a_road_in_even_light_stays_as_it_is():
    _, gain = relit(street(shadowed=False))
    assert np.abs(gain).max() < 0.03


def test_the_dark_under_a_car_stays():
    here = street(car=True)
    light, gain = relit(here)
    under = (np.abs(here.x - 2.2) < 0.7) & (here.z > 5.95) & (here.z < 6.25)
    under &= here.frame.label == ROAD
    assert under.sum() > 100
    assert np.median(light[under]) < 0.6 * ROAD_LIGHT
    away = (np.abs(here.x) < 0.7) & (here.z < 4.5)
    assert np.abs(gain[away]).max() < 0.05


def test_a_car_without_its_contact_is_seen(monkeypatch):
    monkeypatch.setattr(
        relight, "_contact", lambda site, ground: (np.ones(site.shape), np.zeros(site.shape))
    )
    with pytest.raises(AssertionError):
        test_the_dark_under_a_car_stays()


def test_shadows_lose_their_blue():
    here = street(blue=1.4)
    tint = relight.flattening(site_of(here.frame, AXES, CAMERA_M)).tint
    # Blue must fall by 1.4 where the gain is 4.
    assert abs(tint[2] + np.log(1.4) / np.log(4)) < 0.05
    assert abs(tint[0]) < 0.02 and tint[1] == 0


def test_a_shadow_warmer_than_the_light_keeps_its_colour():
    assert not relight.flattening(site_of(street(blue=0.8).frame, AXES, CAMERA_M)).tint.any()


def test_depth_alone_tells_where_to_relight():
    here = street()
    unlabelled = replace(here, frame=replace(here.frame, label=None))
    inside, edge = shadow_error(unlabelled)
    assert inside < 0.15 and edge < 0.15
    assert matte(unlabelled.frame)[: HORIZON - 6].min() > 0.95


def gain_of_a_manhole():
    here = street(shadowed=False)
    image = here.frame.image.copy()
    hole = np.hypot(here.x - 1.2, here.z - 8.0) < 0.3
    image[hole] //= 2
    return np.abs(relit(replace(here, frame=replace(here.frame, image=image)))[1][hole]).max()


def test_a_manhole_stays_dark():
    assert gain_of_a_manhole() < 0.1


def test_a_manhole_taken_for_shadow_is_seen(monkeypatch):
    monkeypatch.setattr(relight, "SHADOW_SIDE_M", 0.1)
    assert gain_of_a_manhole() > 0.1


def test_a_noisy_second_look_gives_nearly_the_same_gain():
    (first, one), (_, other) = relit(street(seed=1)), relit(street(seed=2))
    assert np.isfinite(first).all()
    assert np.abs(one - other).mean() < 0.03


def test_albedo_is_light_over_illumination():
    here = street()
    site = site_of(here.frame, AXES, CAMERA_M)
    light = relight.illumination(site, relight.flattening(site))
    assert light.shape == site.shape and light.dtype == np.float32
    np.testing.assert_allclose(ROAD_LIGHT / relight.ROAD_ALBEDO, light, rtol=0.15)


def test_a_picture_without_ground_has_no_gain_there_and_some_light():
    frame = street().frame
    label = np.where(frame.label == ROAD, np.uint8(BUILDING), frame.label)
    site = site_of(replace(frame, label=label), AXES, CAMERA_M)
    lines = relight.flattening(site)
    assert not lines.ground.any() and not lines.tint.any()
    assert np.isfinite(relight.illumination(site, lines)).all()


def test_the_sky_has_no_gain():
    site = site_of(street().frame, AXES, CAMERA_M)
    assert not relight.flattening(site).objects[site.small_classes == SKY].any()


def sky_behind(alpha, label, sky=(0.25, 0.4, 0.85)):
    """Frame of dark things, (1 - alpha) of each pixel, before a sky."""
    base = street().frame
    colours = srgb_from_linear(np.array([sky, [0.03, 0.04, 0.02]]))
    # Cameras mix light, but the matte's feature is of sRGB: the test mixes what the feature sees.
    mixed = alpha[..., None] * colours[0] + (1 - alpha[..., None]) * colours[1]
    image = base.image.copy()
    image[:HORIZON] = np.round(255 * mixed)[:HORIZON]
    full = base.label.copy()
    full[:HORIZON] = label[:HORIZON]
    return replace(base, image=image, label=full)


def matte(frame):
    site = site_of(frame, AXES, CAMERA_M)
    slope, offset = relight.sky_matte(site)
    feature = frame.image @ np.array(relight.SKY_FEATURE) / 255
    return np.clip(full_size(slope, site) * feature + full_size(offset, site), 0, 1)


def wires_and_leaves():
    alpha = np.ones((HEIGHT, WIDTH))
    alpha[20:22] = alpha[50] = 0
    alpha[:HORIZON, 100:103] = 0
    rng = np.random.default_rng(0)
    holes = cv2.blur(rng.random((HORIZON, 200)), (7, 7)) > 0.5
    alpha[:HORIZON, 400:600] = holes
    label = np.full(alpha.shape, SKY, np.uint8)
    label[:, 425:575] = VEGETATION
    return alpha, label


def matte_error(*, sky=(0.25, 0.4, 0.85)):
    alpha, label = wires_and_leaves()
    error = np.abs(matte(sky_behind(alpha, label, sky)) - alpha)[: HORIZON - 8]
    reached = np.ones(WIDTH, bool)
    reached[455:545] = False
    return error[:, reached].mean(), np.quantile(error[:, reached], 0.98)


@pytest.mark.parametrize("sky", [(0.25, 0.4, 0.85), (0.8, 0.82, 0.85)], ids=["blue", "white"])
def test_wires_and_leaves_are_cut_out_of_the_sky(sky):
    mean, most = matte_error(sky=sky)
    assert mean < 0.05
    assert most < 0.05


def test_leaves_by_label_alone_are_seen(monkeypatch):
    monkeypatch.setattr(relight, "LEAVES_RADIUS_CELLS", 0)
    assert matte_error()[1] > 0.05


def test_no_sky_is_cut_out_away_from_it():
    here = street()
    site = site_of(here.frame, AXES, CAMERA_M)
    slope, offset = relight.sky_matte(site)
    below = HORIZON // site.step + 3
    assert not slope[below:].any() and not offset[below:].any()
    roofed = replace(
        here.frame, label=np.where(here.frame.label == SKY, np.uint8(BUILDING), here.frame.label)
    )
    assert not np.any(relight.sky_matte(site_of(roofed, AXES, CAMERA_M)))
