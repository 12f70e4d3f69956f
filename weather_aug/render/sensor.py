"""What bad weather makes of the camera itself: a longer exposure, gain, noise, glare, compression.

All of it follows from one number, the share of a clear day's light that is left, so that a picture
is never dark and clean, nor bright and noisy. The camera's automatic exposure makes up for the lost
light: half of it, in stops, with time and half with gain. Time lengthens the streaks, gain shows
the noise, and noise compresses badly. What changes is drawn on top of the recorded picture, which
has its own noise; where the light is a clear day's, nothing changes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8
from weather_aug._keys import check_seed, key_of
from weather_aug.clip.types import Camera, FrameKey, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.surface import checked_window, shared
from weather_aug.errors import ArgumentError
from weather_aug.render.compression import BLOCK_PX, steps_of
from weather_aug.render.sensor_kernels import expose, levels_of, spread_across
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

DECK_SHARE = 0.15
"""Light below a closed deck over that of a clear day: 10 to 20 klx of 100."""
DIMMING_RAIN_MM_PER_H, DIMMING_SNOW_MM_PER_H = 20.0, 1.0
"""Rates under whose clouds and curtains the light falls by a factor of sqrt 2."""
FOG_THICKNESS_M = 100.0
"""Of fog above the camera, whatever its scale height, which tells of its lowest metres."""
FOG_FORWARD = 0.85
"""Mean cosine of what fog droplets scatter."""
SNOW_ALBEDO, CLOUD_ALBEDO = 0.6, 0.6
"""Of a street's ground under snow, cars and walls included, and of a deck from below."""
SNOW_METERING = 0.3
"""Snow on all ground makes the picture, as the exposure meter sees it, brighter by this share."""

TIME_SHARE = 0.5
"""Of the lost light, in stops, that a longer exposure makes up for."""
MOST_STRETCH = 4.0
LONGEST_EXPOSURE_S = 0.020
MOST_GAIN = 4.0
"""12 dB. What time and gain do not make up for stays dark; that is not drawn."""
DAY_EXPOSURE_S = 0.005
"""Of a camera that tells nothing; four times as long just fits."""

SHOT_VARIANCE = 1.0 / 5300.0
"""Of white at gain 1, in linear light: the photosites hold 5300 electrons."""
READ_VARIANCE = 9e-8
"""At gain 1, in linear light: 1.6 electrons."""
MIDDLE_GREY = 118
"""sRGB level of 18 % of the light."""
LEVELS_PER_SIGMA = 3.0
"""Towards black and white noise fades, so that this many deviations fit before the end."""

GLARE_SHARE = 0.06
"""Of the light that glass and lens scatter under a closed deck."""
GLARE_SPREADS = ((0.012, 0.5), (0.07, 0.5))
"""Standard deviation of a Gaussian over the picture's width, and its share of the glare."""
GLARE_WIDTH_PX = 128

BEST_QUALITY, LEAST_QUALITY = 95, 80
QUALITY_PER_LEVEL = 5.0
"""What noise of one level at middle grey costs, because it takes bits."""


@dataclass(frozen=True)
class NoiseLevel:
    """Noise that the sensor's gain adds to that of the recorded picture; 0 is none."""

    shot_variance: float
    """Of linear light (white is 1) per linear light."""
    read_variance: float
    """Of linear light (white is 1), squared."""

    @property
    def sigma_levels(self) -> Float64:
        """(256,) standard deviation by sRGB level, in levels.

        sqrt(shot L + read) dS/dL, and at most a third of what is left up to black or white: a full
        photosite has no noise, and clipped noise would shift the mean.
        """
        level = np.arange(256.0)
        linear = np.sqrt(self.shot_variance * SRGB_LEVELS_LINEAR + self.read_variance)
        room = np.minimum(level, 255.0 - level) / LEVELS_PER_SIGMA
        return np.minimum(255.0 * linear * _srgb_slope(), room)

    @property
    def middle_levels(self) -> float:
        """Standard deviation at middle grey, in sRGB levels."""
        return float(self.sigma_levels[MIDDLE_GREY])


def daylight_share(weather: Weather) -> float:
    """Share of a clear day's light that the camera meters, in (0, 1]; 1 for clear weather.

    The product of
        cloud: 1 - 0.85 overcast;
        rain and snow: (1 + R / 20)^-1/2 (1 + S)^-1/2, in mm/h, the thicker clouds of showers;
        fog: 1 / (1 + 3/4 (1 - g) tau) of a layer of 100 m, tau = extinction x 100 m, g = 0.85;
        snow on the ground, cover c: 1 / (1 - 0.6 x 0.6 c overcast), light that goes back and forth
        between snow and cloud, and 1 + 0.3 c, because the exposure meter sees it;
    at most 1.

    Source:
        Illuminance of 100 klx on a clear day and 10 to 20 klx under a deck; two-stream
        transmittance of a layer that does not absorb. The constants of rain, snow and metering and
        the thickness of the fog are estimates.
    """
    cloud = 1.0 - (1.0 - DECK_SHARE) * weather.overcast
    rain = (1.0 + weather.rain_mm_per_h / DIMMING_RAIN_MM_PER_H) ** -0.5
    snow = (1.0 + weather.snow_mm_per_h / DIMMING_SNOW_MM_PER_H) ** -0.5
    fog = 1.0 / (1.0 + 0.75 * (1.0 - FOG_FORWARD) * weather.fog_per_m * FOG_THICKNESS_M)
    cover = 0.5 * (weather.snow_cover + weather.road_snow_cover)
    between = 1.0 / (1.0 - SNOW_ALBEDO * CLOUD_ALBEDO * cover * weather.overcast)
    return min(cloud * rain * snow * fog * between * (1.0 + SNOW_METERING * cover), 1.0)


def exposure_s_in(camera_exposure_s: float, weather: Weather) -> float:
    """How long the shutter is open in `weather`, seconds.

    The camera's own time over the square root of `daylight_share`: at most 4 times as long, at
    most 20 ms, never below the camera's own.

    Args:
        camera_exposure_s: Of the recorded picture, seconds, in (0, 1].
        weather: State of air and ground.

    Raises:
        ArgumentError: If `camera_exposure_s` is out of range.

    Source:
        The cameras of nuScenes expose for at most 20 ms; that time and gain share alike, and up to
        4 times, is an estimate.
    """
    own_s = finite("camera_exposure_s", camera_exposure_s, 1e-9, 1.0)
    stretch = min(daylight_share(weather) ** -TIME_SHARE, MOST_STRETCH)
    return max(own_s, min(own_s * stretch, LONGEST_EXPOSURE_S))


def gain_of(weather: Weather, camera_exposure_s: float = DAY_EXPOSURE_S) -> float:
    """Amplification that makes up for the light that time does not, in [1, 4]."""
    stretch = exposure_s_in(camera_exposure_s, weather) / camera_exposure_s
    return min(max(1.0 / (daylight_share(weather) * stretch), 1.0), MOST_GAIN)


def gain_noise(weather: Weather, camera_exposure_s: float = DAY_EXPOSURE_S) -> NoiseLevel:
    """Noise that a gain g adds to the recorded picture, whose gain is taken as 1.

    The same brightness comes from 1 / g as many electrons: the variance of the photons' number is
    g L / N, that of reading g^2 r^2 / N^2. Added are g - 1 and g^2 - 1 of them.

    Args:
        weather: State of air and ground.
        camera_exposure_s: Of the recorded picture, seconds; a long one leaves less to time.

    Source:
        EMVA Standard 1288, the linear camera model. Electrons and their reading are chosen for
        1 to 3 sRGB levels at middle grey.
    """
    gain = gain_of(weather, camera_exposure_s)
    return NoiseLevel((gain - 1.0) * SHOT_VARIANCE, (gain**2 - 1.0) * READ_VARIANCE)


def glare_share(weather: Weather) -> float:
    """Share of the light that is scattered in glass and lens, in [0, 0.06]."""
    return GLARE_SHARE * weather.overcast


def quality_of(noise: NoiseLevel) -> int:
    """JPEG quality, in [80, 95]: 5 less for each level of noise at middle grey."""
    return max(round(BEST_QUALITY - QUALITY_PER_LEVEL * noise.middle_levels), LEAST_QUALITY)


def block_window(window: Window, camera: Camera) -> Window:
    """The smallest window around `window` that cuts no block of the whole picture's compression."""
    top, left, rows, columns = window
    block = BLOCK_PX
    first, start = top // block * block, left // block * block
    end = min(-(-(top + rows) // block) * block, camera.height)
    stop = min(-(-(left + columns) // block) * block, camera.width)
    return (first, start, end - first, stop - start)


def exposed(
    image: UInt8,
    whole: Float32 | None,
    *,
    window: Window,
    camera: Camera,
    weather: Weather,
    seed: int,
    frame_key: FrameKey,
    noise: bool = True,
    glare: bool = True,
    compression: bool = True,
) -> UInt8:
    """A window of a picture as the camera would deliver it in `weather`: a pure function.

    Glare spreads a few percent of all light over the picture; noise follows the light, its colour
    coarser than its brightness, as a mosaic of colours leaves it; a light JPEG ends it. A window's
    pixels equal the same pixels of the whole picture.

    Args:
        image: (H, W, 3) sRGB of the window, as it leaves the lens.
        whole: (h, w, 3) float32 linear light of the whole picture in this weather, shrunk to a
            width of about 256; may be None without glare.
        window: (top, left, height, width) in the whole picture. With compression it must cut no
            block (see `block_window`); the caller cuts the result to what it needs.
        camera: Of the whole picture, with the exposure it was recorded with.
        weather: State of air and ground.
        seed: Which noise.
        frame_key: Of the picture; each has its own noise.
        noise: Whether noise is drawn.
        glare: Whether glare is drawn.
        compression: Whether the picture is compressed.

    Returns:
        (H, W, 3) uint8 sRGB, new; in clear weather a copy of `image`.

    Raises:
        ArgumentError: If an array has the wrong type or shape, or the window leaves the picture or
            cuts a block that is compressed.
    """
    image = image_uint8("image", image)
    seed = check_seed("seed", seed)
    _check_window(window, camera, compression)
    if image.shape[:2] != tuple(window[2:]):
        raise ArgumentError(f"image of {image.shape[:2]} pixels is not the window {window}")
    if not isinstance(weather, Weather):
        raise ArgumentError(f"weather must be a Weather, got {type(weather).__name__}")
    if not isinstance(frame_key, FrameKey):
        raise ArgumentError(f"frame_key must be a FrameKey, got {type(frame_key).__name__}")
    share = glare_share(weather) if glare else 0.0
    level = gain_noise(weather, camera.exposure_s)
    # Where the light is a clear day's, the recorded noise and compression are all there is.
    grainy = level.middle_levels > 0.0
    veil = np.empty((0, 0, 3), np.float32)
    if share > 0.0:
        veil = np.float32(share) * _scattered(_checked_whole(whole))
    noisy, compressed = noise and grainy, compression and grainy
    if not (share > 0.0 or noisy or compressed):
        return image.copy()
    sigma = level.sigma_levels.astype(np.float32) if noisy else np.empty(0, np.float32)
    steps = steps_of(quality_of(level)) if compressed else np.empty((0, 8, 8), np.float32)
    return _exposed(image, window, camera, noise_key(seed, frame_key), sigma, share, veil, steps)


def noise_key(seed: int, frame_key: FrameKey) -> int:
    """64 bits that the noise of one camera's picture at one time hangs on."""
    name = hashlib.blake2b(frame_key.camera.encode(), digest_size=8).digest()
    camera = int.from_bytes(name, "little")
    return key_of("sensor-noise", seed, frame_key.time_index, camera) % 2**64


def _exposed(
    image: UInt8,
    window: Window,
    camera: Camera,
    key: int,
    sigma: Float32,
    share: float,
    veil: Float32,
    steps: Float32,
) -> UInt8:
    top, left, height, width = window
    wide = (width + 15) // 16 * 16
    columns, column_shares = _places(left, wide, camera.width, veil.shape[1])
    rows, row_shares = _places(top, height, camera.height, veil.shape[0])
    across = np.empty((veil.shape[0], 3, wide), np.float32)
    spread_across(veil, columns, column_shares, across)
    out = np.empty(image.shape, np.uint8)
    expose(
        shared(image),
        (top, left),
        np.uint64(key),
        sigma,
        _light_by_level(),
        np.float32(1.0 - share),
        across,
        rows,
        row_shares,
        steps,
        out,
    )
    return out


def _places(
    first: int, count: int, size_px: int, small_px: int
) -> tuple[NDArray[np.int64], Float32]:
    """Where pixels of a picture lie on a small one: a pixel of it, and the share of the next."""
    centre = (np.arange(first, first + count) + 0.5) * (small_px / size_px) - 0.5
    centre = np.clip(centre, 0.0, max(small_px - 1, 0))
    before = np.minimum(centre.astype(np.int64), max(small_px - 2, 0))
    return before, (centre - before).astype(np.float32)


def _scattered(whole: Float32) -> Float32:
    """Where the light goes that is scattered (h, w, 3), each side 2 or more; linear light."""
    height, width = whole.shape[:2]
    columns = min(GLARE_WIDTH_PX, max(width, 2))
    rows = max(round(height * columns / width), 2)
    small = cv2.resize(np.maximum(whole, 0), (columns, rows), interpolation=cv2.INTER_AREA)
    out = np.zeros_like(small)
    for spread, share in GLARE_SPREADS:
        # A wide blur loses nothing on a picture that is small for it.
        shrink = max(int(spread * columns / 2.0), 1)
        size = (max(columns // shrink, 2), max(rows // shrink, 2))
        least = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
        sigma_px = spread * size[0]
        blurred = cv2.GaussianBlur(least, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
        wide = cv2.resize(blurred, (columns, rows), interpolation=cv2.INTER_LINEAR)
        out += np.float32(share) * wide
    return out


@lru_cache(maxsize=1)
def _light_by_level() -> Float32:
    """(256,) light that the kernel encodes as each level, so that without a veil none changes."""
    light = np.linspace(0.0, 1.0, 1 << 20, dtype=np.float32)
    levels = np.empty_like(light)
    levels_of(light, levels)
    table = np.interp(np.arange(256.0), np.maximum.accumulate(levels), light).astype(np.float32)
    table.flags.writeable = False
    return table


@lru_cache(maxsize=1)
def _srgb_slope() -> Float64:
    """(256,) dS/dL of each sRGB level, S and L in [0, 1] (IEC 61966-2-1)."""
    light = SRGB_LEVELS_LINEAR
    power = 1.055 / 2.4 * np.maximum(light, 0.0031308) ** (1.0 / 2.4 - 1.0)
    slope = np.where(light <= 0.0031308, 12.92, power)
    slope.flags.writeable = False
    return slope


def _checked_whole(whole: Float32 | None) -> Float32:
    if whole is None:
        raise ArgumentError("whole is needed for glare: pass linear light, or glare=False")
    if not isinstance(whole, np.ndarray) or whole.dtype != np.float32:
        raise ArgumentError("whole must be a float32 array of linear light")
    if whole.ndim != 3 or whole.shape[2] != 3 or 0 in whole.shape:
        raise ArgumentError(f"whole must have shape (h, w, 3), got {whole.shape}")
    if not np.isfinite(whole).all():
        raise ArgumentError("whole must be finite")
    return whole


def _check_window(window: Window, camera: Camera, compression: bool) -> None:
    checked_window(window, camera.height, camera.width)
    if compression and tuple(window) != block_window(window, camera):
        raise ArgumentError(
            f"window {window} cuts blocks of the compression; render {block_window(window, camera)}"
            " (block_window) and cut the result, or pass compression=False"
        )
