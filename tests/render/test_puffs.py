"""Puffs: line integrals, Beer's law for Poisson puffs, how much fog they carry, who sees them."""

from dataclasses import replace

import numpy as np
import pytest
from render_scene import make_camera
from scipy.integrate import quad

from weather_aug.render import fog, puffs
from weather_aug.render.froxels import NEAR_SLICES, slice_depths_m

SIGMA_M, REACH = 1.5, 6.0


def transmittances(peak, z_m, beta, *, grows=False, rays=20_000):
    """T of rays through Poisson splats of opacity peak exp(-rho^2 / 2), composited."""
    rng = np.random.default_rng(4)
    density = beta / (2 * np.pi * SIGMA_M**2 * peak)
    counts = rng.poisson(density * np.pi * (REACH * SIGMA_M) ** 2 * z_m, rays)
    rho2 = rng.uniform(0, REACH**2, counts.sum())
    height = np.full(len(rho2), peak)
    if grows:
        # The paper's opacity: 1 - exp(-beta d), whatever the density. Scaled to agree at 30 m.
        depth = rng.uniform(0, z_m, len(rho2))
        height = peak * np.expm1(-beta * depth) / np.expm1(-beta * 30.0)
    log_t = np.log1p(-np.minimum(height * np.exp(-0.5 * rho2), 0.999))
    ray = np.repeat(np.arange(rays), counts)
    return np.exp(np.bincount(ray, weights=log_t, minlength=rays))


def departs_from_beer(beta=0.02, **changes):
    """Largest relative distance of the mean transmittance from exp(-beta z)."""
    return max(
        abs(transmittances(0.1, z, beta, **changes).mean() / np.exp(-beta * z) - 1)
        for z in (15.0, 30.0, 60.0, 100.0)
    )


def test_poisson_puffs_keep_beers_law():
    assert departs_from_beer() < 0.03


def test_opacity_that_grows_with_depth_breaks_beers_law():
    """Planted fault: the published opacity makes optical depth grow with the depth squared."""
    assert departs_from_beer(grows=True) > 0.2


@pytest.mark.parametrize(("peak", "tau"), [(0.02, 2.0), (0.2, 2.0), (0.4, 1.0)])
def test_poisson_puffs_vary_as_campbell_says(peak, tau):
    through = transmittances(peak, 50.0, tau / 50.0)
    expected = np.sqrt(np.expm1(tau * peak / 2))
    assert through.std() / through.mean() == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("fog_per_m", [0.002, 0.02, 0.06, 0.6])
def test_classes_carry_their_share(fog_per_m):
    """Campbell's extinction n 2 pi sigma^2 tau0, within the optical depths a puff may have."""
    classes = fog._puff_classes(fog_per_m, 0.25, np.inf)
    tau = classes.optical_depth_m * fog_per_m
    carried = classes.density_per_m3 * 2 * np.pi * classes.sigma_m**2 * tau
    assert carried.sum() == pytest.approx(0.25 * fog_per_m)
    assert ((tau >= 0.01) & (tau <= 0.05)).all()


def volume_share(seed, scale_height_m=np.inf):
    camera = make_camera(64, 48)
    return fog.fog_volume(
        camera,
        (0, 0, 48, 64),
        fog_per_m=0.04,
        scale_height_m=scale_height_m,
        patchiness=0.0,
        puff_share=0.5,
        seed=seed,
        axes_world=np.eye(3),
        drift_world_m=np.zeros(3),
    ).share


def worst_mean(scale_height_m=np.inf):
    """Largest relative error of the puffs' mean optical depth, over depths."""
    mean = np.mean([volume_share(seed, scale_height_m) for seed in range(60)], axis=0)
    above = mean[:, :6]  # where the rays rise, and no ground would be in the way
    # Half of the fog is even, so an error of the puffs counts twice.
    return 2 * np.abs(above.mean(axis=(1, 2)) - 1)[8:].max()


@pytest.mark.parametrize("scale_height_m", [np.inf, 15.0])
def test_puffs_carry_their_share_at_every_depth(scale_height_m):
    assert worst_mean(scale_height_m) < 0.03


def test_puffs_that_end_without_even_fog_are_noticed(monkeypatch):
    """Planted fault: the fog that takes over behind the puffs' reach is forgotten."""
    drawn = fog._drawn

    def for_puffs_only(depth_m, reach_m):
        return drawn(depth_m, reach_m) if depth_m.shape == reach_m.shape else np.ones((4, 1))

    monkeypatch.setattr(fog, "_drawn", for_puffs_only)
    assert worst_mean() > 0.03


def the_view(centre=(0.0, 0.0, 1.5)):
    camera = make_camera(64, 48)
    pose = camera.world_from_camera.copy()
    pose[:3, 3] = centre
    moved = replace(camera, world_from_camera=pose)
    rows, columns = fog._nodes((0, 0, 48, 64), 4.0)
    return fog._view(moved, rows, columns, 4.0, np.inf, np.eye(3), np.zeros(3))


def in_air(view, found):
    """Centres of puffs in the drifting air's axes, whoever looks."""
    return found[:, :3] @ view.axes_from_camera.T + view.origin_m


def test_denser_fog_adds_puffs_and_moves_none():
    view = the_view()
    thin, dense = (
        {tuple(p) for p in np.round(fog._puffs(view, classes, 3)[:, :4], 6)}
        for classes in (
            fog._puff_classes(0.004, 0.3, np.inf)._replace(reach_m=np.full(4, 40.0)),
            fog._puff_classes(0.1, 0.3, np.inf)._replace(reach_m=np.full(4, 40.0)),
        )
    )
    assert len(thin) > 20
    assert thin < dense


def test_two_cameras_see_the_same_puffs():
    classes = fog._puff_classes(0.03, 0.3, np.inf)
    seen = []
    for centre in ((0.0, 0.0, 1.5), (6.0, 1.0, 1.5)):
        view = the_view(centre)
        points = in_air(view, fog._puffs(view, classes, 3))
        inside = (points[:, 0] > 12) & (points[:, 0] < 25) & (np.abs(points[:, 1]) < 4)
        inside &= np.abs(points[:, 2] - 1.5) < 3
        seen.append({tuple(p) for p in np.round(points[inside], 6)})
    assert len(seen[0]) > 3
    assert seen[0] == seen[1]


def line_integral(puff, sigma_m, optical_depth_m, ray, z_m):
    """Optical depth of a puff (extinction at the camera 1) per metre of slant up to a depth."""
    peak = optical_depth_m / (sigma_m * np.sqrt(2 * np.pi))

    def extinction(z):
        return peak * np.exp(-0.5 * ((z * ray - puff[:3]) ** 2).sum() / sigma_m**2)

    return quad(extinction, 0.0, z_m, points=[min(puff[2], z_m)])[0]


def test_drawn_puffs_are_their_line_integrals():
    """The tables and the cut of the kernel against quadrature, to 1.1 % of a puff."""
    puff = np.array([[0.7, -0.4, 12.0, 0.0, 0.0], [1.0, 0.3, 1.0, 0.0, 0.0]])
    sigma_m, depth_m = np.array([2.0, 1.5]), np.array([1.5, 1.0])
    ray_x, ray_y = np.linspace(-0.6, 0.6, 13), np.linspace(-0.4, 0.4, 9)
    depths_m = slice_depths_m()[: NEAR_SLICES + 1]
    actual = np.zeros((9, 13, NEAR_SLICES))
    puffs.add_puffs(puff, sigma_m, depth_m, ray_x, ray_y, depths_m, fog._normal_rise(), actual)
    actual = actual.cumsum(axis=2)
    for r, c, k in ((4, 6, 10), (4, 7, 8), (2, 9, 31), (5, 6, 0), (0, 0, 31)):
        ray = np.array([ray_x[c], ray_y[r], 1.0])
        expected = sum(
            line_integral(*each, ray, depths_m[k + 1])
            for each in zip(puff, sigma_m, depth_m, strict=True)
        )
        assert actual[r, c, k] == pytest.approx(expected, rel=0.013, abs=0.02)
