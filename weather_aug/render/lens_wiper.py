"""Wipers: when they pass a place of the picture, the blade, and what it smears.

A blade is a ray from a pivot below the picture. A place is told by its tangent (right over up, from
the pivot), and the blade sweeps the tangents evenly, from one side to the other and at the next
pass back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug._keys import key_of, uniforms
from weather_aug.clip.types import Camera
from weather_aug.render.lens_refraction import light_at, mixed, smooth_step
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

GLASS_M = 0.3
"""From the camera to the glass."""
SLOW_S, FAST_S = 2.0, 1.0
"""Time from pass to pass; the fast wiper has the slow one's passes among its own."""
FAST_MM_PER_H = 10.0
"""Rain from which the wiper runs fast."""
CROSSING = 0.025
"""Share of the time in which the blade is in the picture: a camera at the mirror sees little of a
stroke."""
BLADE_M_PER_S = 2.5
"""Of a real stroke; it sets how far the shutter smears the blade."""
DULL_EXPOSURE_S = 0.015
"""Under rain clouds no shutter is open for less; a recorded drive may have been sunny."""
BLADE_M = 0.016
"""Width of blade and arm."""
SMEARS = 6
SMEAR_S = 0.9
"""A smear dries within this time."""
_PLACES = 64
"""Numbers by which a smear varies along its arc, 32 to a radian; a power of 2."""


@dataclass(frozen=True)
class Wiper:
    """One wiper before one camera, at one moment."""

    key: tuple[int, int]
    """Seed and glass, of what is drawn for each pass."""
    pivot_px: tuple[float, float]
    """(x, y) in the picture's pixels, below it."""
    outer_px: float
    """Reach of the blade from the pivot."""
    tangents: tuple[float, float]
    """Of the picture's sides and a margin, in which the blade moves."""
    period_s: float
    start_s: float
    """Moment of a pass."""
    time_s: float

    @property
    def _turn(self) -> int:
        """Number of the latest pass that has begun."""
        return math.floor((self.time_s - self.start_s) / self.period_s)

    def _begun_s(self, turn: int) -> float:
        """How long ago a pass began; negative if it has not."""
        return self.time_s - (self.start_s + turn * self.period_s)

    @property
    def _crossing_s(self) -> float:
        return CROSSING * self.period_s

    def cleared(self, x_px: Float64, y_px: Float64, age_s: Float64) -> Bool:
        """(N,) whether the blade has passed over drops at these places since they landed."""
        right, up = x_px - self.pivot_px[0], self.pivot_px[1] - y_px
        within = (up > 0) & (np.hypot(right, up) < self.outer_px)
        first, last = self.tangents
        share = np.clip((right / np.where(up > 0, up, 1.0) - first) / (last - first), 0.0, 1.0)
        turn = self._turn
        since_s = self._begun_s(turn) - self._crossing_s * _along(share, turn)
        before_s = self._begun_s(turn - 1) - self._crossing_s * _along(share, turn - 1)
        return within & (age_s >= np.where(since_s >= 0, since_s, before_s))

    @property
    def blade(self) -> float | None:
        """Tangent of the blade's middle, None while it is not before the picture."""
        share = self._begun_s(self._turn) / self._crossing_s
        if share >= 1.0:
            return None
        first, last = self.tangents
        return first + (last - first) * (share if self._turn % 2 == 0 else 1.0 - share)

    def smears(self, camera: Camera) -> tuple[Float32, Float32]:
        """What the latest complete pass has left in a camera's picture.

        Returns:
            (SMEARS, 3) radius and half width in pixels and opacity; (SMEARS, 64) how the opacity
            varies along each, in [0, 1].
        """
        turn = self._turn if self.blade is None else self._turn - 1
        dry = (self._begun_s(turn) - self._crossing_s) / SMEAR_S
        # A worn blade smears at the same places in every pass, only not always as much.
        worn = uniforms(key_of("smear-place", *self.key), 2 * SMEARS).reshape(2, SMEARS)
        drawn = uniforms(key_of("smear", *self.key, turn), (1 + _PLACES) * SMEARS)
        drawn = drawn.reshape(SMEARS, 1 + _PLACES)
        inner = self.pivot_px[1] - camera.height
        radius = inner + (self.outer_px - inner) * worn[0]
        half_width = camera.width * (0.0015 + 0.004 * worn[1] ** 2)
        opacity = 0.4 * drawn[:, 0] * max(1.0 - dry, 0.0) ** 2
        along = np.clip(1.6 * drawn[:, 1:] - 0.5, 0.0, 1.0)
        rows = np.stack([radius, half_width, opacity], axis=1)
        return rows[opacity > 0.004].astype(np.float32), along[opacity > 0.004].astype(np.float32)


def wiper_of(
    weather: Weather, camera: Camera, seed: int, glass: int, time_s: float
) -> Wiper | None:
    """The wiper before a camera; None in a drive without.

    Args:
        weather: Its `wipers` is the share of the seeds at which they run, its rain sets how often.
        camera: Of the whole picture.
        seed: Decides whether and when; all cameras of a rig see the same pass.
        glass: Decides where the pivot is.
        time_s: Moment.
    """
    runs, start = uniforms(key_of("wiper", seed), 2)
    if runs >= weather.wipers:
        return None
    side, below, reach = uniforms(key_of("wiper-place", seed, glass), 3)
    width, height = camera.width, camera.height
    pivot = ((0.2 + 0.6 * side) * width, height + (0.7 + 0.6 * below) * width)
    margin = 0.08 * width
    corners = [(x, y) for x in (-margin, width + margin) for y in (0.0, float(height))]
    tangents = [(x - pivot[0]) / (pivot[1] - y) for x, y in corners]
    period_s = FAST_S if weather.rain_mm_per_h >= FAST_MM_PER_H else SLOW_S
    return Wiper(
        (seed, glass),
        pivot,
        pivot[1] - (0.16 * reach - 0.08) * height,
        (min(tangents), max(tangents)),
        period_s,
        SLOW_S * start,
        time_s,
    )


def confusion_px(camera: Camera) -> float:
    """Diameter of the disc that a point on the glass becomes, pixels: f A / z."""
    return camera.focal_px[0] * camera.aperture_m / GLASS_M


def _along(share: Float64, turn: int) -> Float64:
    """Share of a pass at which the blade comes by; every other pass goes back."""
    return share if turn % 2 == 0 else 1.0 - share


@compiled
def draw_smears(
    smears: Float32,
    along: Float32,
    pivot: Float32,
    reach: np.float32,
    pyramid: Float32,
    first: int,
    height: int,
    width: int,
    scale: Float32,
    veil: Float32,
    window: Int64,
    linear: Float32,
    srgb: UInt8,
    image: UInt8,
) -> None:
    """Mix arcs of blurred light into a window, where the blade has left strips of water.

    Args:
        smears: (N, 3) float32; see `Wiper.smears`.
        along: (N, 64) float32, likewise.
        pivot: (2,) float32 pixels of the picture.
        reach: How far a ray at a strip's edge is bent, pixels.
        pyramid: See `lens_refraction.fill_pyramid`.
        first: First row of the level that the film shows.
        height: Rows of that level.
        width: Columns of that level.
        scale: (2,) float32, pixels of that level per pixel of the picture.
        veil: (3,) float32 light that the glass adds everywhere.
        window: (top, left) int64 of the window in the picture.
        linear: (256,) float32.
        srgb: (65536,) uint8.
        image: (H, W, 3) uint8, drawn over.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    places = along.shape[1]
    for n in range(smears.shape[0]):
        radius, thick, opacity = smears[n, 0], smears[n, 1] + one, smears[n, 2]
        outer, inner = radius + thick, max(radius - thick, zero)
        per_thick, per_place = one / thick, np.float32(places // 2) / radius
        for i in range(image.shape[0]):
            rise = pivot[1] - np.float32(window[0] + i)
            if rise >= outer or rise <= zero:
                continue
            far = np.sqrt(outer * outer - rise * rise)
            near = np.sqrt(max(inner * inner - rise * rise, zero))
            for side in range(2):
                # Left and right of the pivot; one of them may lie outside.
                low = pivot[0] - far if side == 0 else pivot[0] + near
                high = pivot[0] - near if side == 0 else pivot[0] + far
                x0 = max(np.int64(np.floor(low)) + side, window[1])
                x1 = min(np.int64(np.floor(high)), window[1] + image.shape[1] - 1)
                for x in range(x0, x1 + 1):
                    right = np.float32(x) - pivot[0]
                    away = np.sqrt(right * right + rise * rise)
                    off = (away - radius) * per_thick
                    body = max(one - off * off, zero)
                    place = right * per_place
                    place -= np.floor(place / np.float32(places)) * np.float32(places)
                    k = np.int64(place)
                    t = smooth_step(place - np.float32(k))
                    here, there = along[n, k & (places - 1)], along[n, (k + 1) & (places - 1)]
                    cover = opacity * body * body * (here + t * (there - here))
                    if cover <= zero:
                        continue
                    # A strip of water is a lens across its length.
                    bend = reach * off / away
                    u = (np.float32(x) - bend * right + half) * scale[0] - half
                    v = (np.float32(window[0] + i) + bend * rise + half) * scale[1] - half
                    red, green, blue = light_at(pyramid, first, height, width, u, v)
                    j = x - window[1]
                    image[i, j, 0] = mixed(image[i, j, 0], red + veil[0], cover, linear, srgb)
                    image[i, j, 1] = mixed(image[i, j, 1], green + veil[1], cover, linear, srgb)
                    image[i, j, 2] = mixed(image[i, j, 2], blue + veil[2], cover, linear, srgb)


@compiled
def draw_blade(
    tangent: np.float32,
    pivot: Float32,
    outer: np.float32,
    width: np.float32,
    swept: np.float32,
    blur: np.float32,
    dark: Float32,
    window: Int64,
    linear: Float32,
    srgb: UInt8,
    image: UInt8,
    alpha: Float32,
    hidden: UInt8,
) -> None:
    """Draw the blade as the shutter smears it: a box as wide as the blade under two soft edges.

    Args:
        tangent: Of the blade's middle.
        pivot: (2,) float32 pixels of the picture.
        outer: Reach of the blade, pixels.
        width: Of the blade, pixels.
        swept: How far the blade moves while the shutter is open, pixels.
        blur: Diameter of the circle of confusion, pixels.
        dark: (3,) float32 light of the blade.
        window: (top, left) int64 of the window in the picture.
        linear: (256,) float32.
        srgb: (65536,) uint8.
        image: (H, W, 3) uint8, drawn over.
        alpha: (H, W) float32 opacity, added to as layers are.
        hidden: (H, W) uint8, set to 1 where `alpha` exceeds 0.5.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    soft = swept + blur
    per_soft, reach = one / soft, half * (width + soft)
    for i in range(image.shape[0]):
        rise = pivot[1] - np.float32(window[0] + i)
        middle = pivot[0] + tangent * rise
        x0 = max(np.int64(np.ceil(middle - reach)), window[1])
        x1 = min(np.int64(np.floor(middle + reach)), window[1] + image.shape[1] - 1)
        for x in range(x0, x1 + 1):
            right = np.float32(x) - pivot[0]
            tip = outer - np.sqrt(right * right + rise * rise)
            off = np.float32(x) - middle
            left_edge = smooth_step((off + half * width) * per_soft + half)
            right_edge = smooth_step((off - half * width) * per_soft + half)
            cover = (left_edge - right_edge) * smooth_step(tip / blur + half)
            if cover <= zero:
                continue
            j = x - window[1]
            for k in range(3):
                image[i, j, k] = mixed(image[i, j, k], dark[k], cover, linear, srgb)
            total = alpha[i, j] + cover * (one - alpha[i, j])
            alpha[i, j] = total
            if total > half:
                hidden[i, j] = 1
