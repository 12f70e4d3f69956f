"""Light scattered forwards by thick fog: the background blurs the more of it is in between."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug._compiled import compiled
from weather_aug.colour import SRGB_LEVELS_LINEAR, srgb_of_16_bits
from weather_aug.errors import ArgumentError

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]

SPREAD_RAD = 0.004
"""Standard deviation of the blur at one unit of optical depth beyond the clear one."""
CLEAR_TAU = 0.5
"""Fog below this optical depth scatters too little to see."""
FULL_TAU, MOST_WEIGHT = 3.0, 0.35
"""Share of scattered light in the background from FULL_TAU on."""
WIDEST_TAU = 4.5
"""The blur grows no more: 1 % of the background is left."""
LEVELS = (0.0, 0.25, 0.5, 1.0)
"""Standard deviations of the stack of blurs over the widest one."""
REACH_SIGMAS = 3.0


class _Law(NamedTuple):
    """How blur and its weight follow the optical depth, float32."""

    clear_tau: np.float32
    widest_tau: np.float32
    weight_per_tau: np.float32
    most_weight: np.float32
    sigma_px: np.float32


def scattered_background(image: UInt8, optical_depth: Float32, focal_px: float) -> UInt8:
    """`image` as it would look through the fog's forward scattering, before the fog dims it.

    Each pixel is mixed with a blurred picture: sigma = f theta sqrt(tau - 0.5) with theta = 4 mrad,
    up to tau = 4.5, and a weight that grows from 0 at tau = 0.5 to 0.35 at tau = 3. Only what is
    itself behind fog is spread: a near car, seen clearly, leaves no glow on the street behind it.
    Linear light in 16-bit integers, so that a window gives the bits of the whole picture if it has
    `scattering_margin_px` pixels around what is kept of it.

    Args:
        image: (H, W, 3) sRGB.
        optical_depth: (H, W) of the air up to each surface, the sky's included.
        focal_px: Focal length, pixels.

    Returns:
        (H, W, 3) sRGB; pixels of optical depth 0.5 or less are those of `image`.

    Raises:
        ArgumentError: If an argument has the wrong type or shape.

    Source:
        A Gaussian stand-in for the point spread function of Narasimhan and Nayar (2003).
    """
    image = image_uint8("image", image)
    like_image("optical_depth", optical_depth, image.shape[:2])
    if optical_depth.dtype != np.float32:
        raise ArgumentError(f"optical_depth must be float32, got {optical_depth.dtype}")
    focal_px = finite("focal_px", focal_px, 1e-3, 1e6)
    out = image.copy()
    thick = optical_depth > CLEAR_TAU
    if not thick.any():
        return out
    most_tau = float(optical_depth[thick].max())
    part = _surroundings(thick, scattering_margin_px(focal_px, most_tau))
    # Copies, because the kernels would be compiled once more for arrays with gaps.
    mixed, tau = np.array(image[part], order="C"), np.array(optical_depth[part], order="C")
    stack = _blurs(mixed, tau, focal_px, most_tau)
    law = _Law(
        np.float32(CLEAR_TAU),
        np.float32(WIDEST_TAU),
        np.float32(MOST_WEIGHT / (FULL_TAU - CLEAR_TAU)),
        np.float32(MOST_WEIGHT),
        np.float32(1.0 / math.sqrt(WIDEST_TAU - CLEAR_TAU)),
    )
    levels = np.array(LEVELS, np.float32)
    _mix(tau, stack, levels, law, srgb_of_16_bits(), mixed)
    out[part] = mixed
    return out


def _surroundings(mask: NDArray[np.bool_], margin: int) -> tuple[slice, slice]:
    """Box around the set pixels and what they look at."""
    slices = []
    for axis in (1, 0):
        hit = np.flatnonzero(mask.any(axis=axis))
        slices.append(slice(max(int(hit[0]) - margin, 0), int(hit[-1]) + margin + 1))
    return slices[0], slices[1]


def _blurs(image: UInt8, optical_depth: Float32, focal_px: float, most_tau: float) -> UInt16:
    """(LEVELS, H, W, 4) light times share, and share; levels wider than needed stay empty."""
    sharp = np.empty((*image.shape[:2], 4), np.uint16)
    _weigh(image, optical_depth, _linear_16(), np.float32(CLEAR_TAU), sharp)
    stack = np.empty((len(LEVELS), *sharp.shape), np.uint16)
    stack[0] = sharp
    widest_px = _sigma_px(focal_px, math.inf)
    for level in range(1, 1 + _level_above(_sigma_px(focal_px, most_tau) / widest_px)):
        sigma_px = LEVELS[level] * widest_px
        side = 2 * _radius_px(sigma_px) + 1
        # On 16-bit integers OpenCV computes in fixed point: no bit depends on a pixel's place.
        cv2.GaussianBlur(sharp, (side, side), sigma_px, dst=stack[level])
    return stack


def scattering_margin_px(focal_px: float, most_tau: float) -> int:
    """Pixels around a window that `scattered_background` looks at.

    Args:
        focal_px: Focal length, pixels.
        most_tau: Largest optical depth inside the window; `inf` for any.
    """
    if not most_tau > CLEAR_TAU:
        return 0
    widest_px = _sigma_px(finite("focal_px", focal_px, 1e-3, 1e6), math.inf)
    level = _level_above(_sigma_px(focal_px, most_tau) / widest_px)
    return _radius_px(LEVELS[level] * widest_px)


def _sigma_px(focal_px: float, tau: float) -> float:
    return focal_px * SPREAD_RAD * math.sqrt(max(min(tau, WIDEST_TAU) - CLEAR_TAU, 0.0))


def _radius_px(sigma_px: float) -> int:
    return max(1, math.ceil(REACH_SIGMAS * sigma_px))


def _level_above(share: float) -> int:
    """First level at or above a share of the widest blur; a hair early, as float32 may round up."""
    return min(int(np.searchsorted(LEVELS, share * (1 + 1e-6))), len(LEVELS) - 1)


@lru_cache(maxsize=1)
def _linear_16() -> Float32:
    """(256,) linear light of each sRGB level, 65535 for white."""
    return np.round(65535.0 * SRGB_LEVELS_LINEAR).astype(np.float32)


@compiled
def _weigh(image: UInt8, tau: Float32, linear: Float32, full_tau: np.float32, out: UInt16) -> None:
    """Light times how much it is spread, and that share itself, (H, W, 4)."""
    one, half, white = np.float32(1.0), np.float32(0.5), np.float32(65535.0)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            share = tau[y, x] / full_tau
            share = share if share < one else one
            for k in range(3):
                out[y, x, k] = np.uint16(share * linear[image[y, x, k]] + half)
            out[y, x, 3] = np.uint16(share * white + half)


@compiled
def _mix(tau: Float32, stack: UInt16, levels: Float32, law: _Law, srgb: UInt8, out: UInt8) -> None:
    """Mix each pixel with the two blurs of the stack that enclose its own."""
    white, half = np.float32(65535.0), np.float32(0.5)
    for y in range(tau.shape[0]):
        for x in range(tau.shape[1]):
            t = min(tau[y, x], law.widest_tau) - law.clear_tau
            if not t > np.float32(0.0):
                continue
            weight = min(t * law.weight_per_tau, law.most_weight)
            sigma = np.sqrt(t) * law.sigma_px
            upper = 1
            while upper < levels.shape[0] - 1 and levels[upper] < sigma:
                upper += 1
            lower = upper - 1
            v = (sigma - levels[lower]) / (levels[upper] - levels[lower])
            v = min(v, np.float32(1.0))
            near, far = stack[lower, y, x], stack[upper, y, x]
            near_scale = (np.float32(1.0) - v) * white / np.float32(near[3])
            far_scale = v * white / np.float32(far[3])
            for k in range(3):
                sharp = np.float32(stack[0, y, x, k])
                soft = near_scale * np.float32(near[k]) + far_scale * np.float32(far[k])
                light = sharp + weight * (soft - sharp)
                out[y, x, k] = srgb[np.int64(min(max(light, np.float32(0.0)), white) + half)]
