"""Where the sky is in an unlabelled daylight picture: a heuristic, used for depth only."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.completion import greatest

WORKING_WIDTH_PX = 640
MIN_BRIGHTNESS = 130
MIN_BLUE_BRIGHTNESS = 80
MAX_TEXTURE = 5.0
MIN_SHARE = 0.002
GAP_SHARE = 0.03
GAP_GREY_LEVELS = 18
BRIDGE_PX = 9
DULL_SHARE = 0.75
DEEP_BLUE = 30
THIN_SHARE = 0.006
THIN_GREY_LEVELS = 14.0
THIN_NOISE = 4.0
COLOUR_WIDTH_PX = 320
SLIVER_SHARE = 0.05
SLIVER_REACH = 0.4
SLIVER_BELOW = 0.08
SLIVER_TINT = 0.15
SLIVER_MIN_BLUE, SLIVER_MIN_GREY = 0.45, 0.8
SLIVER_CONTRAST = 0.7


def sky_mask(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels that look like sky: bright and grey or blue, smooth, connected to the top border.

    White walls that touch the top of the picture are taken for sky, night sky is not found; give
    labels, or measurements that contradict it, where that matters. Gaps in foliage count as sky
    where they have the colour of the sky nearby, dimmed by no more than the leaves that share their
    pixels. Posts and wires before the sky are no sky down to a width of about a pixel.

    Args:
        image: (H, W, 3) uint8 RGB.

    Returns:
        (H, W) bool.
    """
    height, width = image.shape[:2]
    scale = min(1.0, WORKING_WIDTH_PX / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    coloured = _sky_coloured(small)
    open_sky = _touching_top(coloured & (texture(small) < MAX_TEXTURE))
    open_sky = _touching_top(open_sky & ~_dull(small, open_sky))
    if open_sky.mean() < MIN_SHARE:
        return np.zeros((height, width), bool)
    mask = open_sky | _gaps(small, open_sky)
    mask = mask | _rim(small, mask)
    grown = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    whole = np.asarray(grown > 0.5)
    sky_colour = _sky_colour(image, whole)
    whole &= ~_thin(image, whole, sky_colour)
    return np.asarray(whole | _slivers(image, whole, sky_colour))


def _sky_coloured(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    red, green, blue = (image[..., channel].astype(np.int16) for channel in range(3))
    brightness = np.maximum(np.maximum(red, green), blue)
    greyness = brightness - np.minimum(np.minimum(red, green), blue)
    bright = (brightness >= MIN_BRIGHTNESS) & (greyness <= 0.18 * brightness)
    # Daylight cloud is grey or bluish; sunlit plaster and stone are warm.
    bright &= red <= blue + 8
    blueish = (brightness >= MIN_BLUE_BRIGHTNESS) & (blue >= green) & (green >= red - 4)
    return np.asarray(bright | (blueish & (blue > red + 8)))


def texture(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Standard deviation of the grey value within 5x5 pixels, (H, W)."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (5, 5))
    variance = cv2.blur(grey * grey, (5, 5)) - mean * mean
    return np.sqrt(np.maximum(variance, 0)).astype(np.float32)


def _touching_top(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # Wires cut the sky into pieces; a piece belongs to it if only a few pixels lie between.
    bridged = cv2.dilate(mask.astype(np.uint8), np.ones((BRIDGE_PX, BRIDGE_PX), np.uint8))
    _, parts = cv2.connectedComponents(bridged, connectivity=4)
    at_top = np.unique(parts[:2][mask[:2]])
    return np.isin(parts, at_top) & mask


def _dull(image: NDArray[np.uint8], sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grey pixels well below the brightest tenth of the sky: the side of a white lorry."""
    if not sky.any():
        return np.zeros_like(sky)
    brightness = greatest(image)
    blueish = image[..., 2] > image[..., 0].astype(np.int16) + DEEP_BLUE
    return np.asarray((brightness < DULL_SHARE * np.percentile(brightness[sky], 90)) & ~blueish)


def _local_mean(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Mean colour of the masked pixels around each pixel, (H, W, 3); -255 where there are none."""
    side = 2 * max(3, round(GAP_SHARE * image.shape[1])) + 1
    share = cv2.blur(mask.astype(np.float32), (side, side))
    total = cv2.blur(image.astype(np.float32) * mask[..., None], (side, side))
    mean = total / np.maximum(share, 1e-6)[..., None]
    return np.where((share > 1e-4)[..., None], mean, -255).astype(np.float32)


def _gaps(image: NDArray[np.uint8], sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels near the open sky that have its colour, such as holes in foliage."""
    off = greatest(np.abs(image.astype(np.float32) - _local_mean(image, sky)))
    return np.asarray(off < GAP_GREY_LEVELS)


def _rim(image: NDArray[np.uint8], sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The blurred pixels at the border, given to the side whose colour they are closer to."""
    kernel = np.ones((5, 5), np.uint8)
    ring = (cv2.dilate(sky.astype(np.uint8), kernel) > 0) & ~sky
    to_sky = greatest(np.abs(image.astype(np.float32) - _local_mean(image, sky)))
    to_land = greatest(np.abs(image.astype(np.float32) - _local_mean(image, ~sky)))
    return np.asarray(ring & (to_sky < 0.7 * to_land))


def _sky_colour(image: NDArray[np.uint8], sky: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Colour of the sky around each pixel, from as near as there is some, (H, W, 3)."""
    height, width = sky.shape
    scale = min(1.0, COLOUR_WIDTH_PX / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    share = cv2.resize(sky.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    masked = np.where(sky[..., None], image, 0).astype(np.uint8)
    masked = cv2.resize(masked, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    colour = np.broadcast_to(masked.sum(axis=(0, 1)) / share.sum(), masked.shape)
    for reach in (0.12, GAP_SHARE):
        side = 2 * max(1, round(reach * size[0])) + 1
        amount = cv2.blur(share, (side, side))
        mean = cv2.blur(masked, (side, side)) / np.maximum(amount, 1e-6)[..., None]
        colour = np.where((amount > 0.02)[..., None], mean, colour)
    grown = cv2.resize(colour, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(grown, np.float32)


def _thin(
    image: NDArray[np.uint8], sky: NDArray[np.bool_], sky_colour: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Posts, lamps and wires within the sky: narrow, long, of another colour."""
    off = greatest(cv2.absdiff(image, np.rint(sky_colour).clip(0, 255).astype(np.uint8)))
    off = np.where(sky, off, 0).astype(np.uint8)
    side = 2 * max(3, round(THIN_SHARE * image.shape[1])) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    # What is wide is cloud; what is left of it is narrow.
    narrow = cv2.morphologyEx(off, cv2.MORPH_TOPHAT, kernel)
    noise = float(np.median(narrow[sky])) if sky.any() else 0.0
    seen = narrow > max(THIN_GREY_LEVELS, THIN_NOISE * noise)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(seen.astype(np.uint8))
    span = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    long = span > side
    long[0] = False
    return np.asarray(long[parts])


def _slivers(
    image: NDArray[np.uint8], sky: NDArray[np.bool_], sky_colour: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Sky between leaves: small, brighter than what is around, the colour of the sky but dimmed."""
    height, width = sky.shape
    strength = np.maximum(np.einsum("hwc,hwc->hw", sky_colour, sky_colour), 1)
    pixels = image.astype(np.float32)
    dimmed = np.einsum("hwc,hwc->hw", pixels, sky_colour) / strength
    blue = sky_colour[..., 2] - sky_colour[..., 0] > DEEP_BLUE
    alike = (dimmed > np.where(blue, SLIVER_MIN_BLUE, SLIVER_MIN_GREY)) & ~sky
    lowest = np.searchsorted(np.cumsum(sky.sum(axis=1)), 0.99 * sky.sum())
    alike[int(lowest + SLIVER_BELOW * height) :] = False
    away = cv2.distanceTransform((~sky).astype(np.uint8), cv2.DIST_L2, 3)
    alike &= away < SLIVER_REACH * width
    tint = np.abs(pixels[alike] - dimmed[alike][:, None] * sky_colour[alike]).max(axis=1)
    alike[alike] = tint < SLIVER_TINT * dimmed[alike] * sky_colour[alike].max(axis=1)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(alike.astype(np.uint8))
    wide, tall = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    # A post in the shade has the colour of a dim sky, and is upright and straight.
    shaped = (np.maximum(wide, tall) <= max(3.0, SLIVER_SHARE * width)) & (tall <= 5 * wide + 3)
    # Of two parts at one pixel of the ring the later one gets it.
    numbered = cv2.dilate(parts.astype(np.float32), np.ones((5, 5), np.uint8)).astype(np.int32)
    ring = (numbered > 0) & ~alike & ~sky
    around = _mean_by_part(dimmed[ring], numbered[ring], count)
    inside = _mean_by_part(dimmed[alike], parts[alike], count)
    kept = shaped & (around < SLIVER_CONTRAST * inside)
    kept[0] = False
    return np.asarray(kept[parts])


def _mean_by_part(
    values: NDArray[np.float32], parts: NDArray[np.int32], count: int
) -> NDArray[np.float64]:
    total = np.bincount(parts, values, count)
    return np.asarray(total / np.maximum(np.bincount(parts, minlength=count), 1))
