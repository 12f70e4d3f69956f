"""What the road mirrors, against a ray tracer; each check is also shown a planted fault."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mirror_scene import BOXES, SKY_LIGHT, Scene, sunk

from weather_aug.edit.physical import mirror_lines as lines
from weather_aug.edit.physical.mirror import MirrorMap, mirror_map, mirrored
from weather_aug.edit.physical.mirror_lines import View
from weather_aug.errors import ArgumentError, CalibrationError
from weather_aug.taxonomy import TRAIN_ID

TILTS = [(0, 0), (4, 0), (-3, 0), (0, 5), (3, -6)]
SMALL = {"width": 96, "height": 54}
"""For what runs without the compiler."""
ALIKE = 0.02


def sharp(site):
    return mirrored(mirror_map(site), site.light, SKY_LIGHT, sharp_slope=0.0).sharp


def without_compiler(monkeypatch, **faults):
    """Draw in plain Python, with functions replaced."""
    for name in ("draw_lines", "_draw_line", "_fill_line"):
        kernel = getattr(lines, name)
        monkeypatch.setattr(lines, name, getattr(kernel, "py_func", kernel))
    for name, fault in faults.items():
        monkeypatch.setattr(lines, name, fault)
    monkeypatch.setattr("weather_aug.edit.physical.mirror.draw_lines", lines.draw_lines)


def flipped_about_the_horizon(y, z, height, view):
    """The mirror image of something at the horizon's distance, for all."""
    climb = view.nx * 0 + view.ny * y + view.nz
    image = y - 2 * climb * view.ny
    return np.float32(view.fy * image / (1 - 2 * climb * view.nz) + view.cy), z


def without_depth_test(start, end, depth, cell, first, nearest, shown):
    low, high = max(int(np.ceil(min(start, end))), first), int(np.floor(max(start, end)))
    for row in range(low, min(high, len(shown) - 1) + 1):
        nearest[row], shown[row] = depth, cell


def share_right(scene, picture):
    """Share of the road, inside regions that the picture shows, that mirrors what it should."""
    truth, known = scene.mirrored()
    near = np.ones((5, 5))
    truth32 = truth.astype(np.float32)
    inside = (cv2.dilate(truth32, near) - cv2.erode(truth32, near)).max(-1) < ALIKE
    places = known & inside & (scene.frame().label == TRAIN_ID["road"])
    assert places.mean() > 0.04
    return (np.abs(picture - truth).max(-1) < ALIKE)[places].mean()


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), TILTS)
def test_the_road_mirrors_what_a_ray_tracer_sees(pitch_deg, roll_deg):
    scene = Scene(pitch_deg, roll_deg)
    assert share_right(scene, sharp(scene.site())) > 0.99


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), TILTS)
def test_a_road_too_deep_is_found(pitch_deg, roll_deg):
    scene = Scene(pitch_deg, roll_deg)
    assert share_right(scene, sharp(sunk(scene.site(), 0.4))) < 0.9


@pytest.mark.parametrize(
    "faults",
    [{"_image": flipped_about_the_horizon}, {"_span": without_depth_test}],
    ids=["flip about the horizon", "no depth test"],
)
def test_wrong_geometry_is_found(monkeypatch, faults):
    # The wall behind the car is drawn after it.
    wall = ("building", (25.0, 30.0), (-20.0, 12.0), (0.0, 9.0), (0.2, 0.5, 0.4))
    scene = Scene(boxes=(BOXES[0], wall), **SMALL)
    assert share_right(scene, sharp(scene.site())) > 0.97
    without_compiler(monkeypatch)
    assert share_right(scene, sharp(scene.site())) > 0.97
    without_compiler(monkeypatch, **faults)
    assert share_right(scene, sharp(scene.site())) < 0.9


def contact_gap(scene, picture, *, rows=(0, 1, 2, 3)):
    """Greatest difference to the car's own light in the rows below its foot, and one above."""
    car = scene.frame().label == TRAIN_ID["car"]
    columns = np.nonzero(car[scene.height // 2 :].any(0))[0]
    columns = columns[(np.diff(columns, prepend=-9) == 1) & (np.diff(columns, append=999) == 1)]
    light, worst = scene.site().light, 0.0
    for column in columns:
        foot = np.nonzero(car[:, column])[0].max()
        own = light[foot, column]
        for row in rows:
            worst = max(worst, np.abs(picture[foot + row, column] - own).max())
    return worst


@pytest.mark.parametrize("depth_share", [1.0, 0.98, 1.02])
@pytest.mark.parametrize("kerb_m", [0.0, 0.12])
def test_a_car_stands_on_its_mirror_image(depth_share, kerb_m):
    """No gap, where depth is a little wrong and where it stands on a kerb."""
    car = ("car", (8.0, 12.0), (-1.0, 1.0), (0.0, 1.5), (0.6, 0.1, 0.1))
    scene = Scene(boxes=(car,))
    site = scene.site()
    site = sunk(site, kerb_m)
    site.__dict__["depth_m"] = site.depth_m * np.float32(depth_share)
    assert contact_gap(scene, sharp(site)) < 0.01


def test_a_gap_below_a_car_is_found(monkeypatch):
    car = ("car", (8.0, 12.0), (-1.0, 1.0), (0.0, 1.5), (0.6, 0.1, 0.1))
    scene = Scene(boxes=(car,), **SMALL)
    site = sunk(scene.site(), 0.12)
    assert contact_gap(scene, sharp(site), rows=(0, 1)) < 0.01
    without_compiler(monkeypatch, CONTACT_M=1e-9, CONTACT_PER_M=0.0, OVERLAP=-1.0)
    assert contact_gap(scene, sharp(site), rows=(0, 1)) > 0.1


def test_houses_go_on_above_the_picture():
    """A house that the upper border cuts is not mirrored as sky."""
    house = ("building", (10.0, 30.0), (-30.0, 30.0), (0.0, 40.0), (0.2, 0.3, 0.1))
    scene = Scene(boxes=(house,))
    assert (mirror_map(scene.site()).source[scene.height // 2 + 2 :] >= 0).all()


def test_the_ground_is_not_mirrored():
    scene = Scene(3)
    source, label = mirror_map(scene.site()).source, scene.frame().label.ravel()
    mirrored_classes = label[source[source >= 0]]
    assert not (mirrored_classes == TRAIN_ID["sky"]).any()
    # Where a line leaves a side of a box and meets it again, the road between looks like a gap.
    assert (mirrored_classes == TRAIN_ID["road"]).mean() < 0.01


def test_the_gap_below_a_car_shows_the_ground_in_its_shade():
    hovering = ("car", (8.0, 12.0), (-1.0, 1.0), (0.5, 1.5), (0.6, 0.1, 0.1))
    scene = Scene(boxes=(hovering,))
    site = scene.site()
    label = scene.frame().label
    lowest = np.nonzero(label[:, 160] == TRAIN_ID["car"])[0].max()
    source = mirror_map(site).source[:, 160]
    assert (source[lowest + 1 : lowest + 8] == (lowest + 1) * scene.width + 160).all()
    own = np.nonzero(source == lowest * scene.width + 160)[0]
    # Half a metre over the road at 8 m mirrors twice as far below.
    assert abs(own.min() - lowest - 2 * 0.5 / 8 * 0.8 * 320) <= 2


def test_an_open_road_mirrors_the_skys_gradient():
    scene = Scene(2, 3, boxes=())
    truth, known = scene.mirrored()
    picture = sharp(scene.site())
    assert np.abs(picture - truth)[known].max() < 2e-3
    assert np.abs(picture[:10] - picture[0]).max() < 0.01


def test_the_way_before_the_road_is_a_share_of_all():
    """0 at a wall's foot, growing by the similar triangles of camera and mirrored height."""
    wall = ("building", (20.0, 30.0), (-60.0, 60.0), (0.0, 40.0), (0.2, 0.3, 0.1))
    scene = Scene(boxes=(wall,))
    site = scene.site()
    spread = mirror_map(site).spread[:, 160]
    _, rays = scene.rays()
    rows = np.nonzero(site.is_ground[:, 160])[0][2:]
    to_road = 1.5 / -rays[rows, 160, 2]
    np.testing.assert_allclose(1 - to_road / 20.0, spread[rows], atol=0.03)


def unrest(noise):
    """Mean changes of the sharp and the rough picture between two draws of the depth's error."""
    pictures = []
    for seed in range(2):
        site = Scene().site()
        errors = np.random.default_rng(seed).normal(size=site.shape)
        site.__dict__["depth_m"] = (site.depth_m * (1 + noise * errors)).astype(np.float32)
        pictures.append(mirrored(mirror_map(site), site.light, SKY_LIGHT))
    below = site.is_ground
    return [
        np.abs(getattr(pictures[0], name) - getattr(pictures[1], name))[below].mean()
        for name in ("sharp", "rough")
    ]


def test_noisy_depth_hardly_changes_the_picture():
    sharp_change, rough_change = unrest(0.02)
    assert sharp_change < 0.012
    assert rough_change < 0.004
    assert unrest(0.2)[0] > 0.012


LEVEL = View(*(np.float32(v) for v in (200, 250, 60, -0.5, 0, -1, 0, 1.5)))
"""The horizon is the picture's upper border."""


def smeared(light, spread, slope, view=LEVEL):
    source = np.arange(light.shape[0] * light.shape[1], dtype=np.int32).reshape(light.shape[:2])
    spreads = np.full(light.shape[:2], spread, np.float32)
    mirror = MirrorMap(source, spreads, view)
    return mirrored(mirror, light, SKY_LIGHT, sharp_slope=0.0, rough_slope=slope).rough


def deviation(weights):
    places = np.arange(len(weights))
    mean = (weights * places).sum() / weights.sum()
    return np.sqrt((weights * (places - mean) ** 2).sum() / weights.sum())


@pytest.mark.parametrize("spread", [0.3, 1.0])
@pytest.mark.parametrize("slope", [0.01, 0.03])
def test_smears_are_as_long_as_slopes_make_them(spread, slope):
    light = np.zeros((160, 121, 3), np.float32)
    light[80] = 1.0
    column = smeared(light, spread, slope)[:, 60, 0].astype(float)
    expected = 2 * slope * 250 * spread
    assert abs(deviation(column) - expected) < 0.05 * expected
    assert abs(deviation(column) - expected / 2) > 0.3 * expected
    assert abs(column.sum() - 1) < 1e-3


def test_smears_are_narrower_across_by_the_sine_of_the_grazing_angle():
    light = np.zeros((160, 121, 3), np.float32)
    light[:, 60] = 1.0
    row = smeared(light, 1.0, 0.03)[150, :, 0].astype(float)
    tangent = 150.5 / 250
    expected = 2 * 0.03 * 200 * tangent / np.hypot(1, tangent)
    assert abs(deviation(row) - expected) < 0.05 * expected


def plain_smear(light, sigma):
    """Mean under a tent of the rows there are, each by itself."""
    rows = np.arange(len(light))
    radius = np.sqrt(1 + 6 * sigma**2)
    narrow = int(radius) if radius < 24 else round(radius)
    share = radius - narrow if radius < 24 else 0.0
    out = np.empty_like(light)
    for row in rows:
        weights = sum(
            part * np.clip(1 - np.abs(rows - row) / reach, 0, 1) / reach
            for part, reach in ((1 - share, narrow), (share, narrow + 1))
        )
        out[row] = weights @ light / weights.sum()
    return out


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.3))
def test_smears_are_those_of_a_plain_sum(seed, slope):
    column = np.random.default_rng(seed).random((90, 3))
    light = np.repeat(column[:, None].astype(np.float32), 40, 1)
    sigma = 2 * slope * 250 * 0.5
    np.testing.assert_allclose(
        plain_smear(column, sigma), smeared(light, 0.5, slope)[:, 20], atol=2e-5
    )


@settings(max_examples=10, deadline=None)
@given(st.floats(-8, 8), st.floats(-8, 8))
def test_even_light_stays_even_at_any_tilt(pitch_deg, roll_deg):
    site = Scene(pitch_deg, roll_deg, **SMALL).site()
    grey = np.full((*site.shape, 3), 0.4, np.float32)
    mirror = mirrored(mirror_map(site), grey, np.full((2, 3), 0.4))
    for picture in (mirror.sharp, mirror.rough):
        np.testing.assert_allclose(picture, 0.4, atol=1e-4)


def test_inputs_stay_and_maps_are_read_only():
    site = Scene(**SMALL).site()
    light = site.light.copy()
    mirror = mirror_map(site)
    mirrored(mirror, light, SKY_LIGHT)
    np.testing.assert_array_equal(site.light, light)
    assert not mirror.source.flags.writeable
    assert not mirror.spread.flags.writeable


def test_wrong_shapes_and_slopes_are_refused():
    site = Scene(**SMALL).site()
    mirror = mirror_map(site)
    with pytest.raises(ArgumentError, match="light must have shape"):
        mirrored(mirror, site.light[1:], SKY_LIGHT)
    with pytest.raises(ArgumentError, match="sky_light"):
        mirrored(mirror, site.light, SKY_LIGHT[0])
    with pytest.raises(ArgumentError, match="rough_slope"):
        mirrored(mirror, site.light, SKY_LIGHT, rough_slope=2.0)


def test_a_picture_on_its_side_is_refused():
    with pytest.raises(CalibrationError, match="upright"):
        mirror_map(Scene(roll_deg=80, boxes=BOXES[:1], **SMALL).site())
