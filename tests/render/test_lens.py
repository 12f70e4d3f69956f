"""The glass before the camera: windows, who is on it and when, lenses, wipers, the veil."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.reference_render import linear
from render_scene import make_camera

from weather_aug.errors import ArgumentError
from weather_aug.render import lens, lens_drops
from weather_aug.render.lens import through_glass, veil_share
from weather_aug.render.lens_drops import drops_on
from weather_aug.render.lens_wiper import GLASS_M, wiper_of
from weather_aug.weather import Weather

SIZE = (120, 240)
WET = Weather(lens_drops=60.0)
WIPED = Weather(lens_drops=60.0, wipers=1.0, rain_mm_per_h=20.0)
FRONT = lens._number_of("front")


def picture(height=SIZE[0], width=SIZE[1]):
    """Bright above, dark below, with coarse texture."""
    coarse = np.random.default_rng(3).integers(0, 60, (6, 12, 3))
    noise = cv2.resize(coarse.astype(np.float32), (width, height))
    shade = np.linspace(190, 40, height)[:, None, None]
    return (shade + noise).astype(np.uint8)


def shrunk(image):
    return cv2.resize(linear(image).astype(np.float32), (64, 32), interpolation=cv2.INTER_AREA)


IMAGE = picture()
WHOLE = shrunk(IMAGE)


def seen(weather=WET, window=(0, 0, *SIZE), image=IMAGE, whole=WHOLE, **changes):
    top, left, height, width = window
    given = {"seed": 5, "time_s": 7.3, "glass": "front", "camera": make_camera(SIZE[1], SIZE[0])}
    part = image[top : top + height, left : left + width]
    return through_glass(part, whole, window=window, weather=weather, **(given | changes))


def pass_s(weather=WIPED, seed=5, share=0.5):
    """A moment at which the blade is so far across the picture."""
    wiper = wiper_of(weather, make_camera(SIZE[1], SIZE[0]), seed, FRONT, 0.0)
    return wiper.start_s + (4 + 0.025 * share) * wiper.period_s


MOMENTS = (7.3, pass_s(), pass_s(share=3.0))
WHOLES = [seen(WIPED, time_s=moment) for moment in MOMENTS]


def window_departs(window, moment):
    top, left, height, width = window
    part = (slice(top, top + height), slice(left, left + width))
    shot = seen(WIPED, window, time_s=MOMENTS[moment])
    return any((a != b[part]).any() for a, b in zip(shot, WHOLES[moment], strict=True))


@settings(max_examples=60)
@given(st.data())
def test_a_windows_pixels_are_those_of_the_whole(data):
    height, width = (data.draw(st.integers(1, side)) for side in SIZE)
    top = data.draw(st.integers(0, SIZE[0] - height))
    left = data.draw(st.integers(0, SIZE[1] - width))
    assert not window_departs((top, left, height, width), data.draw(st.integers(0, 2)))


def test_drops_that_know_only_their_window_are_found(monkeypatch):
    draw = lens.draw_drops

    def wrong(drops, pyramid, levels, scale, veil, window, *rest):
        draw(drops, pyramid, levels, scale, veil, 0 * window, *rest)

    monkeypatch.setattr(lens, "draw_drops", wrong)
    assert window_departs((20, 30, 80, 160), 0)


def test_inputs_stay_as_they_are_and_nothing_is_remembered():
    image, whole = IMAGE.copy(), WHOLE.copy()
    image.flags.writeable = whole.flags.writeable = False
    first = seen(WIPED, image=image, whole=whole, time_s=MOMENTS[1])
    seen(WET, time_s=2.0, seed=9)
    again = seen(WIPED, image=image, whole=whole, time_s=MOMENTS[1])
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    np.testing.assert_array_equal(IMAGE, image)
    np.testing.assert_array_equal(WHOLE, whole)
    assert not np.shares_memory(first.image, image)


@pytest.mark.parametrize(
    ("weather", "off"),
    [
        (Weather(), {}),
        (Weather(wetness=1.0, rain_mm_per_h=30.0), {}),
        (WIPED, {"drops": False, "wipers": False, "veil": False}),
    ],
)
def test_dry_or_left_out_glass_gives_the_same_bytes(weather, off):
    shot = seen(weather, time_s=MOMENTS[1], **off)
    np.testing.assert_array_equal(IMAGE, shot.image)
    assert not shot.alpha.any() and not shot.hidden.any()


def test_without_a_veil_only_pixels_under_drops_change():
    shot = seen(veil=False)
    clear = shot.alpha == 0
    assert 0.5 < clear.mean() < 0.99
    np.testing.assert_array_equal(IMAGE[clear], shot.image[clear])
    assert (IMAGE != shot.image)[~clear].mean() > 0.5


def test_opacity_and_what_is_hidden():
    for shot in (*WHOLES, seen(Weather(lens_drops=500.0))):
        assert shot.alpha.dtype == np.float32 and shot.hidden.dtype == np.uint8
        assert shot.alpha.min() >= 0 and shot.alpha.max() <= 1
        assert (shot.alpha[shot.hidden == 1] > 0.5).all()
    assert shot.hidden.any()


def test_drops_that_do_not_blur_hide_nothing(monkeypatch):
    monkeypatch.setattr(lens, "HIDING_BLUR_PX", 1e6)
    assert seen().alpha.max() > 0.5
    assert not seen().hidden.any()


def landed(weather=WET, seed=5, time_s=7.3, camera=None, glass=FRONT, wiper=None):
    return drops_on(camera or make_camera(1241, 376, 718.0), weather, seed, time_s, glass, wiper)


def rolls_again(drops_of):
    """Whether drops move or vanish when more are asked for."""
    few, many = drops_of(Weather(lens_drops=20.0)), drops_of(Weather(lens_drops=60.0))
    assert len(many.slots) > len(few.slots) > 5
    kept = np.isin(many.slots, few.slots)
    return kept.sum() != len(few.slots) or (many.places_px[kept] != few.places_px).any()


def test_more_drops_are_added_and_none_moves():
    assert not any(rolls_again(lambda w, s=seed: landed(w, seed=s)) for seed in range(5))
    # Planted fault: another draw for each number of drops.
    assert rolls_again(lambda w: landed(w, seed=int(w.lens_drops)))


def counts(inside=True):
    """(600,) drops in the picture for a mean of 30, over seeds and times."""
    found = []
    for seed in range(200):
        for time_s in (0.0, 1e3, 1.7e9):
            x, y = landed(Weather(lens_drops=30.0), seed, time_s + seed).places_px.T
            within = (x >= -0.5) & (x < 1240.5) & (y >= -0.5) & (y < 375.5)
            found.append((within | (not inside)).sum())
    return np.array(found)


def test_as_many_drops_as_the_weather_says():
    found = counts()
    # The mean of 600 Poisson counts of 30 is known to 0.22.
    assert found.mean() == pytest.approx(30.0, abs=1.0)
    assert found.var() == pytest.approx(30.0, rel=0.25)
    # Planted fault: as if all of the glass were in the picture.
    assert abs(counts(inside=False).mean() - 30) > 5


def most_moved_m(time_s, later, **changes):
    """Of the drops that are there at both moments the farthest motion, and their share."""
    before, after = landed(time_s=time_s, **changes), later(time_s + 0.1)
    _, a, b = np.intersect1d(before.slots, after.slots, return_indices=True)
    same = np.abs(after.ages_s[b] - before.ages_s[a] - 0.1) < 1e-6
    moved = np.abs(after.places_px[b[same], 1] - before.places_px[a[same], 1])
    # What leaves below comes in again above.
    moved = np.minimum(moved, 1.3 * 376 - moved)
    return moved.max(initial=0.0) * GLASS_M / 718.0, same.sum() / len(before.slots)


@pytest.mark.parametrize("time_s", [0.0, 3.95, 12.34, 1e6])
def test_drops_stay_and_slide_by_at_most_3_cm_per_s(time_s):
    moved_m, share = most_moved_m(time_s, lambda t: landed(time_s=t))
    assert moved_m < 0.003 + 1e-6
    # Of lives of 2.25 s on average, one in 22 ends within 0.1 s.
    assert share > 0.8
    # Planted fault: new drops in every frame.
    assert most_moved_m(time_s, lambda t: landed(time_s=t, seed=1))[1] < 0.1


def falls(speed_m_per_s):
    """Mean motion of the drops within 0.1 s, pixels down."""
    camera = make_camera(1241, 376, 718.0, velocity=(speed_m_per_s, 0.0, 0.0))
    storm = Weather(lens_drops=400.0)
    a = landed(storm, time_s=5.0, camera=camera)
    b = landed(storm, time_s=5.1, camera=camera)
    _, i, j = np.intersect1d(a.slots, b.slots, return_indices=True)
    same = b.ages_s[j] > a.ages_s[i]
    return np.median(np.sort(b.places_px[j[same], 1] - a.places_px[i[same], 1])[[0, 1, -2, -1]])


def test_fast_cars_drive_drops_upwards():
    slow, fast = falls(10.0), falls(30.0)
    assert slow > 0 > fast and slow == pytest.approx(-fast, rel=1e-6)


def test_a_larger_picture_shows_the_same_drops_larger():
    small = make_camera(620, 188, 359.0)
    drops, halved = landed(), landed(camera=small)
    np.testing.assert_array_equal(drops.slots, halved.slots)
    np.testing.assert_allclose((drops.places_px + 0.5) / (1241 / 620), halved.places_px + 0.5, 0.02)


def test_sizes_are_lognormal():
    """Median 0.8 % of the width for the drop, of which the main disc is three quarters."""
    radii = np.concatenate(
        [d.radii_px[d.ages_s > 0.3] for d in (landed(seed=s, time_s=4.0) for s in range(60))]
    )
    assert np.median(radii) / 1241 == pytest.approx(0.75 * 0.008, rel=0.06)
    assert np.log(radii).std() == pytest.approx(0.5, rel=0.06)


def lower_over_upper(sign=1.0):
    """Light in the lower half of a lone large drop over that in its upper half."""
    camera = make_camera(SIZE[1], SIZE[0])
    rows = landed(WET, camera=camera).rows[:1].copy()
    c = lens_drops.columns
    rows[:, c.X], rows[:, c.Y], rows[:, c.RADIUS], rows[:, c.STRETCH] = 120, 60, 15, 1
    rows[:, c.SLANT], rows[:, c.OPACITY], rows[:, c.SOFT], rows[:, c.SIZE] = 0, 0.9, 2, 18
    rows[:, c.SIZE + 1 :], rows[:, c.REACH] = 0, sign * 60
    grey = np.full_like(IMAGE, 100)
    drops = lens_drops.Drops(np.zeros(1, int), np.ones(1), np.zeros((1, 2)), np.ones(1), rows)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lens, "drops_on", lambda *args: drops)
        shot = seen(image=grey, veil=False)
    light = linear(shot.image).mean(axis=2)
    return light[66:72, 115:126].mean() / light[49:55, 115:126].mean()


def test_the_sky_stands_at_the_bottom_of_a_drop():
    assert lower_over_upper() > 1.5
    # Planted fault: bent with the slope, not against it.
    assert lower_over_upper(-1.0) < 1 / 1.5


def outline_is_cut(share):
    """Whether drops change when the box they are drawn in is larger."""
    storm = Weather(lens_drops=400.0)
    camera = make_camera(SIZE[1], SIZE[0])
    drops = landed(storm, camera=camera)
    shots = []
    for scale in (share, 2.0):
        rows = drops.rows.copy()
        rows[:, lens_drops.columns.SIZE] *= scale
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lens, "drops_on", lambda *args, rows=rows: drops._replace(rows=rows))
            shots.append(seen(storm).alpha)
    return (shots[0] != shots[1]).any()


def test_outlines_fit_into_their_boxes():
    assert not outline_is_cut(1.0)
    # Planted fault.
    assert outline_is_cut(0.7)


def steepest(aperture_m):
    camera = make_camera(SIZE[1], SIZE[0], 200.0, aperture_m=aperture_m)
    alpha = seen(camera=camera, veil=False, time_s=4.0).alpha
    return np.abs(np.diff(alpha, axis=1)).max()


def test_a_wide_aperture_softens_the_outlines():
    assert steepest(0.0005) > 1.5 * steepest(0.01)


def test_cameras_have_drops_of_their_own_and_see_the_same_passes():
    camera = make_camera(SIZE[1], SIZE[0])
    assert (seen(glass="left").alpha != seen(glass="right").alpha).any()
    left, right = (wiper_of(WIPED, camera, 5, lens._number_of(n), 0.0) for n in ("left", "right"))
    assert left.start_s == right.start_s and left.pivot_px != right.pivot_px


def oldest_in_sector_s(reach=None):
    """Age of the oldest drop under the blade's sweep, over the time since the last pass."""
    camera, most = make_camera(1241, 376, 718.0), 0.0
    for seed in range(20):
        wiper = wiper_of(WIPED, camera, seed, FRONT, 0.0)
        time_s = wiper.start_s + 10.7 * wiper.period_s
        wiper = replace(wiper, time_s=time_s)
        cleaning = wiper if reach is None else replace(wiper, outer_px=reach)
        drops = landed(WIPED, seed, time_s, wiper=cleaning)
        away = np.hypot(*(drops.places_px - wiper.pivot_px).T)
        ages = drops.ages_s[away < wiper.outer_px]
        most = max(most, ages.max(initial=0.0) / (0.7 * wiper.period_s))
    return most


def test_the_wiper_clears_what_has_landed_before():
    assert 0.5 < oldest_in_sector_s() <= 1.0
    # Planted fault: a blade that does not reach the picture.
    assert oldest_in_sector_s(reach=1.0) > 2.0


def test_fast_wipers_pass_whenever_slow_ones_do():
    camera = make_camera()
    slow = wiper_of(replace(WIPED, rain_mm_per_h=1.0), camera, 5, FRONT, 0.0)
    fast = wiper_of(WIPED, camera, 5, FRONT, 0.0)
    assert slow.period_s == 2 * fast.period_s
    assert (slow.start_s - fast.start_s) % fast.period_s == 0


def test_wipers_run_in_a_share_of_the_drives():
    camera, some = make_camera(), replace(WIPED, wipers=0.3)
    runs = [wiper_of(some, camera, seed, FRONT, 0.0) is not None for seed in range(1000)]
    assert np.mean(runs) == pytest.approx(0.3, abs=0.05)
    assert wiper_of(WET, camera, 5, FRONT, 0.0) is None


def test_the_blade_is_dark_and_seen_in_few_frames():
    camera = make_camera(SIZE[1], SIZE[0])
    times = 0.1 * np.arange(20_000) + 1e-3 * np.arange(20_000) % 0.1
    visible = [wiper_of(WIPED, camera, 5, FRONT, t).blade is not None for t in times]
    assert 0.01 < np.mean(visible) < 0.03
    shot = seen(WIPED, time_s=MOMENTS[1], drops=False, veil=False)
    under = shot.alpha > 0.3
    assert under.any()
    assert (shot.image[under].astype(int) < IMAGE[under]).mean() > 0.99
    assert not seen(WIPED, time_s=MOMENTS[2], drops=False).alpha.any()


def test_smears_are_faint_and_dry():
    def change(time_s):
        shot = seen(WIPED, time_s=time_s, drops=False, veil=False)
        return np.abs(shot.image.astype(int) - IMAGE).max()

    fresh, late = change(pass_s(share=1.5)), change(pass_s(share=39.0))
    assert 3 < fresh < 80 and late == 0


def test_the_veil_adds_its_share_of_the_mean_light():
    expected = linear(IMAGE) + veil_share(WET) * WHOLE.mean(axis=(0, 1))
    actual = linear(seen(drops=False).image)
    # Rounding to 8 bits.
    assert np.abs(expected - actual).max() < 0.006
    assert (actual - linear(IMAGE)).mean() > 0.005


def test_the_veil_grows_from_one_to_four_percent():
    shares = [veil_share(Weather.rain(s)) for s in ("light", "moderate", "heavy", "extreme")]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(0.01, abs=0.002)
    assert 0.035 < shares[-1] <= 0.045
    assert veil_share(Weather(wetness=1.0)) == 0


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"whole": WHOLE.astype(np.float64)}, "whole"),
        ({"whole": WHOLE[..., 0]}, "whole"),
        ({"whole": np.full_like(WHOLE, np.nan)}, "whole"),
        ({"camera": make_camera(100, 100)}, "window"),
        ({"glass": 3}, "glass"),
        ({"time_s": np.inf}, "time_s"),
        ({"seed": 0.5}, "seed"),
    ],
)
def test_refusals_name_the_argument(changes, names):
    with pytest.raises(ArgumentError, match=names):
        seen(**changes)


@pytest.mark.parametrize("window", [(0, 0, 10, 11), (0, 0.5, *SIZE), None])
def test_windows_that_do_not_fit_are_refused(window):
    camera = make_camera(SIZE[1], SIZE[0])
    with pytest.raises(ArgumentError, match="window"):
        through_glass(
            IMAGE,
            WHOLE,
            window=window,
            camera=camera,
            weather=WET,
            seed=5,
            time_s=0.0,
            glass="front",
        )
