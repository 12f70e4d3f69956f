"""Check 13: contrast at the visibility, height fog against quadrature, and no sky in fog."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import AIR_ONLY
from oracles import faults
from oracles import reference_render as reference
from physics_scene import measured
from render_scene import make_camera, make_frame

from weather_aug.render.compose import render
from weather_aug.render.froxels import even_fog
from weather_aug.render.medium import optical_depth
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.weather import Weather

UP = np.array([0.0, 0, 1])
NOTHING_RESOLVED = np.zeros(1025, np.float32)


def rendered(frame, weather, ambience):
    """Linear light (H, W, 3) of the picture."""
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    return reference.linear(shot.image)


def check_contrast(ambience, draw=rendered):
    """A black and a white step at the optical range differ by 0.05 +- 0.003 of the clear step.

    In dark airlight, where a level of the picture is 0.0005 of the light.
    """
    ambience = replace(ambience, airlight=np.full(3, 0.004))
    for visibility_m in (30.0, 50.0, 150.0, 300.0, 600.0):
        camera = make_camera(41, 31, 400.0)
        weather = Weather(visibility_m=visibility_m)
        slant = np.sqrt(1 + (reference.rays(camera) ** 2).sum(-1))
        # The range is along the ray.
        black, white = (
            draw(make_frame(camera, level, visibility_m / slant), weather, ambience)
            for level in (0, 255)
        )
        contrast = white - black
        measured(f"13: MOR {visibility_m}: {contrast.min():.4f} to {contrast.max():.4f}")
        assert np.abs(contrast - 0.05).max() < 0.003


def unrounded(frame, weather, ambience):
    """Linear light by the renderer's own transmittance, without rounding to levels."""
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    through = shot.transmittance[..., None]
    return through * reference.linear(frame.image) + (1 - through) * ambience.airlight


def test_13_contrast(ambience):
    check_contrast(ambience)
    check_contrast(ambience, unrounded)


@pytest.mark.parametrize("fault", faults.FOGS.values(), ids=faults.FOGS)
def test_13_another_fog_is_found_out(ambience, fault):
    with pytest.raises(AssertionError):
        check_contrast(ambience, fault(rendered))


def quadrature(ray, depth_m, up, fog_per_m, scale_height_m):
    """Optical depth by 1e5 steps of the midpoint rule."""
    norm = np.sqrt(1 + ray @ ray)
    sine = (ray @ up[:2] + up[2]) / norm
    path = depth_m * norm
    s = (np.arange(100_000) + 0.5) * 1e-5 * path
    return float((fog_per_m * np.exp(-s * sine / scale_height_m)).sum() * 1e-5 * path)


def closed_form(ray, depth_m, up, fog_per_m, scale_height_m):
    """The formula of the renderer's medium, in float64."""
    z, ray = np.array([depth_m]), ray[None]
    nothing = np.zeros_like
    args = fog_per_m, 1 / scale_height_m, 0.0, 0.0, nothing
    return float(reference.optical_depth(z, ray, up, *args)[0])


RAYS = [(x, y) for x in (-0.6, 0.0, 0.3) for y in (-0.4, -0.05, -1e-3, 0.0, 1e-3, 0.1)]


def check_height_fog(form):
    """Closed form against quadrature, to 1e-6, up, level and down, for thin and thick layers."""
    worst = 0.0
    for scale_height_m in (3.0, 15.0, 60.0, 1e4):
        for depth_m in (2.0, 30.0, 60.0):
            for tilt in (0.0, 0.1):
                up = np.array([0, -np.cos(tilt), np.sin(tilt)])
                for ray in np.array(RAYS):
                    rise = depth_m * (ray @ up[:2] + up[2])
                    if rise < -8 * scale_height_m:
                        continue
                    exact = quadrature(ray, depth_m, up, 0.02, scale_height_m)
                    off = abs(form(ray, depth_m, up, 0.02, scale_height_m) / exact - 1)
                    worst = max(worst, off)
    measured(f"13: height fog within {worst:.1e}")
    assert worst < 1e-6


def test_13_height_fog():
    check_height_fog(closed_form)


@pytest.mark.parametrize("fault", faults.LAYERS.values(), ids=faults.LAYERS)
def test_13_another_layer_is_found_out(fault):
    with pytest.raises(AssertionError):
        check_height_fog(fault(closed_form))


def kernel_optical_depths(camera, depth_m, weather, ambience):
    """(H, W) of the compiled medium, float32."""
    depth = np.full((camera.height, camera.width), depth_m, np.float32)
    return optical_depth(
        depth,
        (0, 0, camera.height, camera.width),
        optics_of(camera, UP),
        medium_of(weather, (), ambience),
        NOTHING_RESOLVED,
        even_fog(),
    )


def check_kernel(ambience, kernel=kernel_optical_depths, tolerance=2e-4):
    """The compiled medium against the same quadrature, at the precision of its exponential."""
    worst = 0.0
    camera = make_camera(61, 41)
    up = np.array([0.0, -1, 0])
    for scale_height_m in (3.0, 15.0, 60.0, 1e4):
        for depth_m in (2.0, 30.0, 60.0):
            weather = Weather(visibility_m=150.0, fog_scale_height_m=scale_height_m)
            found = kernel(camera, depth_m, weather, ambience)
            for v, u in ((0, 0), (10, 45), (19, 30), (20, 0), (21, 31), (25, 7), (40, 60)):
                ray = reference.rays(camera)[v, u]
                if -ray[1] * depth_m < -8 * scale_height_m:
                    continue
                exact = quadrature(ray, depth_m, up, weather.fog_per_m, scale_height_m)
                worst = max(worst, abs(found[v, u] / exact - 1))
    measured(f"13: kernel within {worst:.1e}")
    assert worst < tolerance


def test_13_the_kernel_of_height_fog(ambience):
    check_kernel(ambience)
    with pytest.raises(AssertionError):
        check_kernel(ambience, faults.without_slant(kernel_optical_depths))


def check_sky(ambience, transmittance):
    """No light of the sky comes through fog without a top, whatever its elevation."""
    camera = make_camera(60, 40)
    for visibility_m in (50.0, 150.0, 300.0):
        through = transmittance(camera, Weather(visibility_m=visibility_m), ambience)
        measured(f"13: sky at MOR {visibility_m}: {through.max():.1e}")
        assert through.max() < 1e-9


def sky_transmittance(camera, weather, ambience):
    frame = make_frame(camera, 200, np.inf)
    return render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY).transmittance


def test_13_sky(ambience):
    check_sky(ambience, sky_transmittance)
    with pytest.raises(AssertionError):
        check_sky(ambience, faults.sky_at_80_m)
