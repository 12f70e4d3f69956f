"""Uneven fog over one view: patches and puffs as a volume of shares; see `froxels`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import check_seed, key_of
from weather_aug.air import Air
from weather_aug.clip.types import Camera, Window
from weather_aug.render import patches, puffs
from weather_aug.render.froxels import (
    NEAR_SLICES,
    SLICES,
    FogVolume,
    accumulate,
    even_fog,
    slice_depths_m,
    volume_of,
)
from weather_aug.render.medium import LOWEST_HEIGHTS
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

NODES_ACROSS = 64
"""Nodes along the longer side of the whole picture, whatever its resolution."""
LEAST_NODE_PX = 4.0
STEP_M = 3.0
"""Longest step of the integration along a ray."""

BASE_WAVELENGTH_M = 20.0
OCTAVES = 4
FADE = (0.3, 0.6)
"""An octave fades out while a node grows through these shares of its lattice step: what the grid
cannot hold would shimmer."""

PUFF_SIGMAS_M = (1.0, 1.6, 2.5, 4.0)
"""Each carries an equal part of the puffs' extinction."""
REACH_SIGMAS = 30.0
PUFF_FADE = 0.7
"""Puffs fade between this share of their reach and all of it; even fog takes over."""
DEEPEST_TAU = 4.0
"""Nobody sees a puff behind so much fog."""
PUFF_OPTICAL_DEPTH = (0.01, 0.05)
"""Range of a puff's optical depth through its middle."""
USUAL_PUFF = (0.03, 0.004)
"""Optical depth of a puff, and the extinction of all puffs (1/m) at which it is that."""


class _View(NamedTuple):
    """The rays of the grid around a window, and the camera in the air's own axes."""

    ray_x: Float64
    """(C,) tangents of the node columns."""
    ray_y: Float64
    """(R,) tangents of the node rows."""
    per_height: Float64
    """(R, C) rise per metre of depth over the scale height, 1/m."""
    axes_from_camera: Float64
    """(3, 3)."""
    origin_m: Float64
    """(3,) camera minus the drift of the air, street axes."""
    node_angle: float
    """Size of a node as a tangent."""


def fog_volume_of(
    weather: Weather, camera: Camera, window: Window, seed: int, air: Air, axes_world: Float64
) -> FogVolume:
    """`fog_volume` of a weather's fog, carried along by the air; `even_fog` where it is even.

    Args:
        weather: Its fog, patches and puffs.
        camera: Of the whole picture.
        window: (top, left, height, width).
        seed: Which patches and puffs.
        air: How far it has drifted since time 0.
        axes_world: (3, 3), rows along the street, to the left, up.
    """
    if weather.fog_patchiness == weather.fog_puffs == 0.0:
        return even_fog()
    return fog_volume(
        camera,
        window,
        fog_per_m=weather.fog_per_m,
        scale_height_m=weather.fog_scale_height_m,
        patchiness=weather.fog_patchiness,
        puff_share=weather.fog_puffs,
        seed=seed,
        axes_world=axes_world,
        drift_world_m=np.asarray(air.drift_m) @ axes_world,
    )


def fog_volume(
    camera: Camera,
    window: Window,
    *,
    fog_per_m: float,
    scale_height_m: float,
    patchiness: float,
    puff_share: float,
    seed: int,
    axes_world: Float64,
    drift_world_m: Float64,
) -> FogVolume:
    """Shares of the fog's optical depth over a window of a picture; `even_fog` where it is even.

    Patches multiply the extinction by exp(kappa n - kappa^2 / 2), kappa = `patchiness`, n fractal
    noise of unit variance; puffs are Gaussians that carry the share `puff_share` in front of their
    reach, and the patches carry the rest: G = (1 - puff_share) patches + puffs, each of mean 1
    times its share. The mean *optical depth* is that of even fog; the mean *transmittance* is a
    little more (Jensen), and is left so. Both are at rest in the drifting air, endless, and
    functions of seed and place only.

    Args:
        camera: Of the whole picture.
        window: (top, left, height, width); its pixels get the same shares as in the whole picture.
        fog_per_m: Extinction of the fog at camera height, 1/m.
        scale_height_m: Height over which it thins by a factor e; may be `inf`.
        patchiness: kappa, in [0, 1].
        puff_share: In [0, 0.5].
        seed: Which patches and puffs.
        axes_world: (3, 3), rows along the street, to the left, up.
        drift_world_m: (3,) how far the wind has carried the air since time 0, world axes.

    Raises:
        ArgumentError: If a number is outside its range.
    """
    fog_per_m = finite("fog_per_m", fog_per_m, 0, 10)
    kappa = finite("patchiness", patchiness, 0, 1)
    puff_share = finite("puff_share", puff_share, 0, 0.5)
    seed = check_seed("seed", seed)
    if fog_per_m == 0 or (kappa == 0 and puff_share == 0):
        return even_fog()
    node_px = max(LEAST_NODE_PX, max(camera.width, camera.height) / NODES_ACROSS)
    rows, columns = _nodes(window, node_px)
    view = _view(camera, rows, columns, node_px, scale_height_m, axes_world, drift_world_m)
    increments = np.zeros((len(rows), len(columns), NEAR_SLICES))
    even_share = np.ones(len(_steps()[1]))
    if puff_share > 0:
        classes = _puff_classes(fog_per_m, puff_share, scale_height_m)
        even_share -= puff_share * _drawn(_steps()[2], classes.reach_m[:, None]).mean(axis=0)
        _add_puffs(view, classes, seed, scale_height_m, increments)
    _add_patches(view, kappa, even_share, seed, increments)
    share = np.empty((SLICES, len(rows), len(columns)), np.float32)
    accumulate(increments, view.per_height, slice_depths_m(), share)
    return volume_of(share, int(rows[0]), int(columns[0]), node_px)


def _nodes(window: Window, node_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the node rows and columns that surround the window's pixels."""
    top, left, height, width = window
    # Rounded as `share_row` rounds, lest a pixel on a node looks for one that is not there.
    per_px = np.float32(1.0 / node_px)
    found = []
    for first, count in ((top, height), (left, width)):
        ends = np.floor(np.array([first, first + count - 1], np.float32) * per_px).astype(np.int64)
        found.append(np.arange(ends[0], ends[1] + 2))
    return found[0], found[1]


def _view(
    camera: Camera,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    node_px: float,
    scale_height_m: float,
    axes_world: Float64,
    drift_world_m: Float64,
) -> _View:
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    ray_x: Float64 = (columns.astype(np.float64) * node_px - cx) / fx
    ray_y: Float64 = (rows.astype(np.float64) * node_px - cy) / fy
    axes_from_camera = np.asarray(axes_world) @ camera.world_from_camera[:3, :3]
    up = axes_from_camera[2]
    rise = up[0] * ray_x + up[1] * ray_y[:, None] + up[2]
    origin_m = np.asarray(axes_world) @ (camera.centre_world - np.asarray(drift_world_m))
    return _View(ray_x, ray_y, rise / scale_height_m, axes_from_camera, origin_m, node_px / fx)


@lru_cache(maxsize=1)
def _steps() -> tuple[Float64, NDArray[np.int64], Float64]:
    """Ends (J + 1,), slices (J,) and middles (J,) of the steps of the integration, metres."""
    depths_m = slice_depths_m()[: NEAR_SLICES + 1]
    ends, slices = [0.0], []
    for k, (start, end) in enumerate(pairwise(depths_m)):
        count = int(np.ceil((end - start) / STEP_M))
        ends += list(start + (end - start) * np.arange(1, count + 1) / count)
        slices += [k] * count
    edges = np.array(ends)
    return edges, np.array(slices), 0.5 * (edges[:-1] + edges[1:])


def _smooth(t: Float64) -> Float64:
    """Smooth step from 0 at t <= 0 to 1 at t >= 1."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _add_patches(
    view: _View, kappa: float, even_share: Float64, seed: int, increments: Float64
) -> None:
    """Add the fog that no puff carries, patchy where kappa is above 0."""
    ends_m, slice_of, middle_m = _steps()
    noise = np.zeros((len(middle_m), len(view.ray_y), len(view.ray_x)), np.float32)
    variance = np.zeros(len(middle_m))
    for octave in range(OCTAVES) if kappa > 0 else ():
        step_m = 0.5 * BASE_WAVELENGTH_M / 2**octave
        low, high = FADE
        node_share = view.node_angle * middle_m / step_m
        amplitude = _amplitudes()[octave] * (1.0 - _smooth((node_share - low) / (high - low)))
        variance += amplitude**2
        turn = _turn(octave) @ view.axes_from_camera / step_m
        origin = _turn(octave) @ view.origin_m / step_m
        base = np.floor(origin)
        reach_m = middle_m[amplitude > 0].max(initial=0.0)
        lowest, size = _box(view, turn, origin - base, reach_m)
        points = np.empty(size, np.float32)
        key = np.uint64(key_of("fog-patches", seed, octave) % 2**64)
        patches.lattice(key, lowest + base.astype(np.int64), _normal_quantiles(), points)
        patches.add_octave(
            points,
            lowest,
            (origin - base).astype(np.float32),
            turn.astype(np.float32),
            view.ray_x.astype(np.float32),
            view.ray_y.astype(np.float32),
            middle_m.astype(np.float32),
            amplitude.astype(np.float32),
            noise,
        )
    half_variance = (0.5 * variance).astype(np.float32)
    patches.add_patches(
        noise, half_variance, even_share, kappa, slice_of, ends_m, view.per_height, increments
    )


def _box(
    view: _View, turn: Float64, rest: Float64, reach_m: float
) -> tuple[NDArray[np.int64], tuple[int, int, int]]:
    """First lattice point and size of the box that holds the view up to a depth."""
    corners = np.array(list(_corners(view, reach_m))) @ turn.T + rest
    # One point more on all sides, because the kernel's float32 coordinates may round outwards.
    low = np.floor(corners.min(axis=0)).astype(np.int64) - 1
    high = np.floor(corners.max(axis=0)).astype(np.int64) + 2
    x, y, z = (int(v) for v in high - low + 1)
    return low, (x, y, z)


def _corners(view: _View, reach_m: float) -> Iterator[tuple[float, float, float]]:
    """The camera and the four corners of the view at a depth, camera axes, metres."""
    yield (0.0, 0.0, 0.0)
    for x in (view.ray_x[0], view.ray_x[-1]):
        for y in (view.ray_y[0], view.ray_y[-1]):
            yield (x * reach_m, y * reach_m, reach_m)


@lru_cache(maxsize=1)
def _amplitudes() -> Float64:
    """(OCTAVES,) halved from one to the next, of unit variance together."""
    amplitudes = 0.5 ** np.arange(OCTAVES)
    return np.asarray(amplitudes / np.sqrt((amplitudes**2).sum()))


@lru_cache(maxsize=OCTAVES)
def _turn(octave: int) -> Float64:
    """(3, 3) rotation of an octave's lattice: none lies along the street or along another one."""
    axis = np.array([2.0, -1.0, 3.0]) / np.sqrt(14.0)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = 0.7 + 1.3 * octave
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


@lru_cache(maxsize=1)
def _normal_quantiles() -> Float32:
    """(4096,) quantiles of the standard normal distribution, of unit variance as a table."""
    normal = NormalDist()
    quantiles = np.array([normal.inv_cdf((i + 0.5) / 4096) for i in range(4096)])
    return (quantiles / quantiles.std()).astype(np.float32)


class _PuffClasses(NamedTuple):
    """Sizes of puffs; all arrays are (K,)."""

    sigma_m: Float64
    density_per_m3: Float64
    reach_m: Float64
    optical_depth_m: Float64
    """Through the middle, over the extinction at the camera."""


def _puff_classes(fog_per_m: float, puff_share: float, scale_height_m: float) -> _PuffClasses:
    """Puffs that carry `puff_share` of the fog.

    Their density stays while their optical depth is in range, so that denser fog makes the same
    puffs denser; then puffs are added or left out. In fog so dense or so shallow that puffs would
    fill it, they are smaller.

    Source:
        Campbell: beta = n 2 pi sigma^2 tau0 for Poisson puffs of density n and depth tau0.
    """
    shrink = min(1.0, scale_height_m / 8.0, 0.125 / fog_per_m)
    sigma_m = np.array(PUFF_SIGMAS_M) * shrink
    carried_per_m = fog_per_m * puff_share
    usual, at_per_m = USUAL_PUFF
    low, high = PUFF_OPTICAL_DEPTH
    tau = min(max(usual * carried_per_m / at_per_m, low), high)
    density = carried_per_m / len(sigma_m) / (2 * np.pi * tau * sigma_m**2)
    reach_m = np.minimum(REACH_SIGMAS * sigma_m, DEEPEST_TAU / fog_per_m)
    return _PuffClasses(sigma_m, density, reach_m, np.full(len(sigma_m), tau / fog_per_m))


def _drawn(depth_m: Float64, reach_m: Float64) -> Float64:
    """Share of the puffs at a depth that is drawn; even fog carries the rest."""
    start_m = PUFF_FADE * reach_m
    return 1.0 - _smooth((depth_m - start_m) / (reach_m - start_m))


def _add_puffs(
    view: _View, classes: _PuffClasses, seed: int, scale_height_m: float, increments: Float64
) -> None:
    """Add the puffs that the view touches."""
    found = _puffs(view, classes, seed)
    index = found[:, 3].astype(np.int64)
    sigma_m, reach_m = classes.sigma_m[index], classes.reach_m[index]
    drawn = _drawn(found[:, 2], reach_m)
    # A Gaussian in exponential air: the mean over all puffs at a height is the air's own density
    # there only if each is thinned by the second term, too.
    thinning = found[:, 4] / scale_height_m + 0.5 * (sigma_m / scale_height_m) ** 2
    # Farther below, the even fog thickens no more, either.
    alive = (drawn > 0) & (found[:, 2] > -puffs.CUT * sigma_m) & (thinning > LOWEST_HEIGHTS)
    index, thinning, drawn = index[alive], thinning[alive], drawn[alive]
    puffs.add_puffs(
        found[alive],
        classes.sigma_m[index],
        classes.optical_depth_m[index] * drawn * np.exp(-thinning),
        view.ray_x,
        view.ray_y,
        slice_depths_m()[: NEAR_SLICES + 1],
        _normal_rise(),
        increments,
    )


def _puffs(view: _View, classes: _PuffClasses, seed: int) -> Float64:
    """(N, 5) puffs in boxes around the view; see `puffs.gather`."""
    sigma_m = classes.sigma_m
    cell_m = 4.0 * sigma_m
    bounds_m = np.empty((len(sigma_m), 2, 3))
    # Beside a slanted ray a puff reaches farther along the axes than its own size.
    slant = np.sqrt(1.0 + np.abs(view.ray_x).max() ** 2 + np.abs(view.ray_y).max() ** 2)
    pads_m = puffs.CUT * sigma_m * slant
    for k, (reach_m, pad_m) in enumerate(zip(classes.reach_m, pads_m, strict=True)):
        corners = np.array(list(_corners(view, reach_m))) @ view.axes_from_camera.T
        bounds_m[k] = corners.min(axis=0) - pad_m, corners.max(axis=0) + pad_m
    keys = np.array([key_of("fog-puffs", seed, k) % 2**64 for k in range(len(sigma_m))], np.uint64)
    volume_m3 = (bounds_m[:, 1] - bounds_m[:, 0] + cell_m[:, None]).prod(axis=1)
    capacity = int(1.2 * (volume_m3 * classes.density_per_m3).sum()) + 256
    axes = np.ascontiguousarray(view.axes_from_camera)
    mean = classes.density_per_m3 * cell_m**3
    while True:
        out = np.empty((capacity, 5))
        found = puffs.gather(keys, sigma_m, mean, cell_m, view.origin_m, axes, bounds_m, out)
        if found <= capacity:
            return out[:found]
        capacity = found


@lru_cache(maxsize=1)
def _normal_rise() -> Float64:
    """(1025,) integral of the standard normal density from -CUT to CUT, scaled to end at 1."""
    normal = NormalDist()
    rise = np.array([normal.cdf(x) for x in np.linspace(-puffs.CUT, puffs.CUT, 1025)])
    return np.asarray((rise - rise[0]) / (rise[-1] - rise[0]))
