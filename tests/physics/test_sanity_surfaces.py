"""Check 14: how much water mirrors and darkens, and both on a road in a picture."""

import numpy as np
import pytest
from edit.edit_scene import flat_street, painted, plain_layers
from physics_scene import measured

from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.physical import edit as editor
from weather_aug.edit.physical import fresnel as water
from weather_aug.edit.physical import look
from weather_aug.weather import Weather

N = 1.333
TABLE = {1: 0.90, 2: 0.80, 3: 0.72, 5: 0.58, 7: 0.47, 10: 0.35, 15: 0.21, 20: 0.13, 30: 0.06}
"""Mirrored share by grazing angle in degrees, to two figures."""
ALBEDOS = (0.05, 0.12, 0.3, 0.5, 0.8)
FLOODED = Weather(wetness=1.0, puddles=1.0)
FILM = Weather(wetness=1.0)
LEVEL, LIGHT = 96, 0.8
"""Of the dry road, sRGB and its illumination."""
MIRRORED = 0.8
"""Linear light of all that a road mirrors, before the camera exposes for a wet street."""


def snell(grazing_rad):
    """Fresnel's equations in angles on both sides."""
    outside = 0.5 * np.pi - grazing_rad
    inside = np.arcsin(np.sin(outside) / N)
    if outside < 1e-9:
        return ((N - 1) / (N + 1)) ** 2
    across = np.sin(outside - inside) / np.sin(outside + inside)
    along = np.tan(outside - inside) / np.tan(outside + inside)
    return 0.5 * (across**2 + along**2)


def check_fresnel(function):
    """Snell's law to 0.002 from 1 to 90 degrees, and the published table as far as it is told."""
    for degrees, share in TABLE.items():
        assert abs(float(function(np.radians(degrees))) - share) < 0.005 + 0.002
    worst = max(abs(float(function(np.radians(d))) - snell(np.radians(d))) for d in range(1, 91))
    measured(f"14: Fresnel: worst of 90 angles off by {worst:.1e}")
    assert worst < 0.002


def schlick(grazing_rad):
    normal = ((N - 1) / (N + 1)) ** 2
    return normal + (1 - normal) * (1 - np.sin(grazing_rad)) ** 5


def test_14_fresnel():
    check_fresnel(water.fresnel)


def test_14_schlicks_approximation_is_found_out():
    with pytest.raises(AssertionError):
        check_fresnel(schlick)


def check_film(function):
    """Lekner and Dorf's ratio to 1 %: darker, and the more so the darker the dry surface is."""
    outside, inside = 0.066, 1 - (1 - 0.066) / N**2
    ratios = [float(function(albedo)) for albedo in ALBEDOS]
    for albedo, ratio in zip(ALBEDOS, ratios, strict=True):
        expected = (1 - outside) * (1 - inside) / (1 - inside * albedo)
        assert abs(ratio / expected - 1) < 0.01
        assert ratio < 1
    assert ratios == sorted(ratios)
    measured(f"14: film ratios {np.round(ratios, 3)} at albedos {ALBEDOS}")


def test_14_film():
    check_film(water.film_ratio)


def test_14_a_fixed_darkening_is_found_out():
    with pytest.raises(AssertionError):
        check_film(lambda albedo: 0.55)


def road():
    return flat_street(LEVEL, width=8, height=240, focal_px=120.0)


def picture(weather, mirrored, without=()):
    """Linear light (H,) of a road's column; all that it mirrors is of one light."""
    here = road()
    kinds = {
        f"{kind}_{c}": mirrored for kind in ("sharp", "rough") for c in ("red", "green", "blue")
    }
    image = painted(here, plain_layers(here, illumination=LIGHT, **kinds), weather, None, without)
    return SRGB_LEVELS_LINEAR[image[:, 4, 1]], here.frame.depth_m[:, 4]


def check_diffuse(weather, wet=picture):
    """What is not mirrored is darker than dry at every distance, by more than the film alone."""
    dry, depth = picture(Weather(), 0.0)
    lit, _ = wet(weather, 0.0)
    near = depth < 60
    assert (lit[near] < 0.75 * dry[near]).all()
    measured(f"14: wet over dry, without its mirror: {(lit / dry)[near].mean():.2f}")


def check_mirror(weather, share_of, wet=picture):
    """Mirrored light rises with distance and is Fresnel's share of what there is to mirror."""
    black, depth = wet(weather, 0.0)
    white, _ = wet(weather, MIRRORED)
    near = (depth > 3) & (depth < 60)
    share = ((white - black) / (MIRRORED * (1 + look.WET_EXPOSURE)))[near]
    sine = 1.5 / np.hypot(depth[near], (np.arange(240)[near] - 119.5) * depth[near] / 120.0)
    expected = np.array([share_of(s) for s in sine])
    measured(
        f"14: mirrored at 60 m {share[0]:.3f}, at 3 m {share[-1]:.3f},"
        f" off {np.abs(share - expected).max():.3f}"
    )
    assert (np.diff(share[::6]) < 0).all()
    assert np.abs(share - expected).max() < 0.02


def flooded(sine):
    """All of it a puddle."""
    return snell(np.arcsin(sine))


def filmed(sine):
    """A film: calm where it covers the stones, half as much from the stones' slopes."""
    calm = look.FILM_FLOODED
    return calm * flooded(sine) + (1 - calm) * 0.5 * snell(np.arcsin(np.hypot(sine, 0.25)))


@pytest.mark.parametrize("weather", [FILM, FLOODED], ids=["film", "puddle"])
def test_14_wet_roads_are_darker(weather):
    check_diffuse(weather)


def test_14_a_dry_film_is_found_out():
    with pytest.raises(AssertionError):
        check_diffuse(FILM, lambda *args: picture(*args, ("film", "mirror")))


@pytest.mark.parametrize(
    ("weather", "share_of"), [(FILM, filmed), (FLOODED, flooded)], ids=["film", "puddle"]
)
def test_14_mirrors_brighten_with_distance(weather, share_of):
    check_mirror(weather, share_of)


def test_14_angles_to_the_normal_are_found_out(monkeypatch):
    def wrong(*args, **kwargs):
        found = right(*args, **kwargs)
        return found._replace(climb_y=np.float32(0.0), climb_z=np.float32(-1.0))

    right = editor.geometry_of
    monkeypatch.setattr(editor, "geometry_of", wrong)
    with pytest.raises(AssertionError):
        check_mirror(FLOODED, flooded)


def test_14_an_even_share_is_found_out():
    with pytest.raises(AssertionError):
        check_mirror(FLOODED, lambda sine: 0.4)
