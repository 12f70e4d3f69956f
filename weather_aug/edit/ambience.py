"""The light of a scene: what its sky, its surfaces and its ground look like, and its airlight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import FAR_DEPTH_M, Frame
from weather_aug.colour import LUMINANCE, SRGB_LEVELS_LINEAR, linear_from_srgb
from weather_aug.edit.physical.overcast import MEAN_SKY_GAIN, tone
from weather_aug.taxonomy import GROUND, ROAD, SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

AIRLIGHT_SATURATION = 0.1
AIRLIGHT_SRGB = (0.78, 0.90)
"""Range of the airlight's luminance; a recorded sky may be night-blue or burnt out."""
SAMPLES_PER_SIDE = 96
CAMERA_HEIGHT_M = 1.5
"""Over the road, where nothing tells."""
CAMERA_HEIGHT_RANGE_M = (0.5, 4.0)
ROAD_RANGE_M = (2.0, 20.0)
ROAD_SIDE_M = 5.0
LEAST_ROAD_POINTS = 20


@dataclass(frozen=True, eq=False)
class Ambience:
    """The light around a camera and the axes of its street; colours are (3,) linear RGB.

    Convention:
        `axes_world` (3, 3) has the rows along the street (the clip's first heading), to the left,
        up; all unit vectors in world axes. `sky`, `middle` and `ground` are medians of the recorded
        picture; `airlight` is what fog looks like, one for the whole clip.
    """

    axes_world: Float64
    sky: Float64
    middle: Float64
    ground: Float64
    airlight: Float64
    camera_height_m: float = CAMERA_HEIGHT_M
    """Height of the camera over the road, metres, in [0.5, 4]."""

    def under(self, overcast: float) -> Ambience:
        """The same light after the weather's tone, under the whole of the weather's sky."""
        curve, matrix = tone(overcast)
        toned = {
            name: matrix @ np.interp(getattr(self, name), SRGB_LEVELS_LINEAR, curve)
            for name in ("sky", "middle", "ground")
        }
        closed = MEAN_SKY_GAIN * self.airlight
        toned["sky"] = toned["sky"] + overcast * (closed - toned["sky"])
        return replace(self, **toned)


def ambience_of(frame: Frame, axes_world: Float64) -> Ambience:
    """Measure the light in one picture, on a grid of at most 96 x 96 pixels.

    Where the picture shows no sky, the brightest twentieth stands for it; where nothing is labelled
    as ground, the lowest third does.
    """
    height, width = frame.image.shape[:2]
    step = (
        slice(None, None, -(-height // SAMPLES_PER_SIDE)),
        slice(None, None, -(-width // SAMPLES_PER_SIDE)),
    )
    light = linear_from_srgb(frame.image[step] / 255.0)
    rows = np.broadcast_to(np.arange(light.shape[0])[:, None], light.shape[:2])
    if frame.label is not None:
        label = frame.label[step]
        is_sky, is_ground = label == SKY, np.isin(label, GROUND)
    else:
        is_sky = np.zeros(light.shape[:2], bool)
        if frame.depth_m is not None:
            is_sky = frame.depth_m[step].astype(np.float32) >= FAR_DEPTH_M
        is_ground = (rows >= light.shape[0] * 2 // 3) & ~is_sky
    middle = light[~is_sky & ~is_ground]
    sky = _sky_colour(light, is_sky)
    whole = np.median(light.reshape(-1, 3), axis=0)
    return Ambience(
        axes_world=axes_world,
        sky=sky,
        middle=np.median(middle, axis=0) if len(middle) else whole,
        ground=np.median(light[is_ground], axis=0) if is_ground.any() else whole,
        airlight=airlight_from_sky(sky),
        camera_height_m=camera_height_m(frame, axes_world[2]),
    )


def camera_height_m(frame: Frame, up_world: Float64) -> float:
    """Height of the camera over the road, from the points of the road a few metres away.

    What is labelled as road is; without a label the road is the level that most points within 5 m
    of the camera's way share.

    Returns:
        Metres in [0.5, 4]; 1.5 where fewer than 20 points tell.
    """
    drop_m, is_road = _drops_to_road(frame, up_world)
    if is_road is not None:
        drop_m = drop_m[is_road]
    low, high = CAMERA_HEIGHT_RANGE_M
    drop_m = drop_m[(drop_m > 0.5 * low) & (drop_m < 1.5 * high)]
    if len(drop_m) < LEAST_ROAD_POINTS:
        return CAMERA_HEIGHT_M
    if is_road is None:
        level = np.bincount((drop_m / 0.1).astype(np.int64))
        commonest = np.convolve(level, np.ones(3), "same").argmax()
        drop_m = drop_m[np.abs(drop_m - 0.1 * (commonest + 0.5)) < 0.25]
    return float(np.clip(np.median(drop_m), low, high))


def _drops_to_road(frame: Frame, up_world: Float64) -> tuple[Float64, NDArray[np.bool_] | None]:
    """How far points of the near road's strip lie under the camera (N,), and which are labelled."""
    none = np.zeros(0)
    if frame.depth_m is None:
        return none, None
    camera = frame.camera
    steps = tuple(-(-side // SAMPLES_PER_SIDE) for side in frame.depth_m.shape)
    depth = np.asarray(frame.depth_m[:: steps[0], :: steps[1]], np.float64)
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    x = (np.arange(depth.shape[1]) * steps[1] - cx)[None, :] / fx
    y = (np.arange(depth.shape[0]) * steps[0] - cy)[:, None] / fy
    near, far = ROAD_RANGE_M
    with np.errstate(invalid="ignore"):
        strip = (depth > near) & (depth < far) & (np.abs(x * depth) < ROAD_SIDE_M)
    up = camera.world_from_camera[:3, :3].T @ up_world
    drop = -(up[0] * x + up[1] * y + up[2])[strip] * depth[strip]
    if frame.label is None:
        return drop, None
    return drop, np.asarray(frame.label[:: steps[0], :: steps[1]] == ROAD)[strip]


def _sky_colour(light: Float64, is_sky: NDArray[np.bool_]) -> Float64:
    """Median of the lower third of the sky, which is what fog fades to."""
    if is_sky.sum() >= 0.002 * is_sky.size:
        rows = np.nonzero(is_sky)[0]
        low = is_sky & (np.arange(len(light))[:, None] >= np.quantile(rows, 2 / 3))
        return np.asarray(np.median(light[low], axis=0))
    luminance = light @ LUMINANCE
    return np.asarray(np.median(light[luminance >= np.quantile(luminance, 0.95)], axis=0))


def airlight_from_sky(sky: Float64) -> Float64:
    """Airlight of a sky colour: nearly grey, its luminance kept within what fog can look like."""
    luminance = float(sky @ LUMINANCE)
    low, high = linear_from_srgb(np.array(AIRLIGHT_SRGB))
    target = min(max(luminance, float(low)), float(high))
    tinted = luminance + AIRLIGHT_SATURATION * (sky - luminance)
    return (
        np.asarray(tinted * (target / max(luminance, 1e-6)))
        if luminance > 1e-6
        else np.full(3, low)
    )
