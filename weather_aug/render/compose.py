"""A frame and a weather become a picture with honest labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical.overcast import ZENITH_GAIN, tone
from weather_aug.errors import ArgumentError
from weather_aug.particles import statistics
from weather_aug.particles.field import MAX_PARTICLES, ParticleField, Window
from weather_aug.particles.resolve import DEPTH_BINS, FAR_M, Resolved
from weather_aug.render import planes
from weather_aug.render.label import NEIGHBOURHOOD_PX, least_linear_contrast, readable_labels
from weather_aug.render.light import Ambience, rain_colour, snow_colour
from weather_aug.render.medium import Medium, Optics
from weather_aug.render.project import BAND_ROWS, project, sorted_in_blocks, split_by_band
from weather_aug.render.shade import Tone, shade
from weather_aug.taxonomy import SKY
from weather_aug.weather import Weather, Wind

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

_EVEN = np.empty((0, 0), np.float32)
"""No patches in the fog."""


@dataclass(frozen=True)
class RenderOptions:
    """How much work to spend on a frame."""

    max_particles: int = 20_000
    """Expected number of resolved particles in a whole picture; the rest becomes extinction."""

    def __post_init__(self) -> None:
        count = finite("max_particles", self.max_particles, 0, MAX_PARTICLES // 2)
        if count != int(count):
            raise ArgumentError(f"max_particles must be whole, got {self.max_particles!r}")
        object.__setattr__(self, "max_particles", int(count))


DEFAULT_OPTIONS = RenderOptions()


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A picture in weather, and what can still be said about it; H, W are the window's size."""

    image: UInt8
    """(H, W, 3) sRGB."""
    label: UInt8 | None
    """(H, W) train ids, 255 where the surface cannot be seen; None where nobody labelled it."""
    label_full: UInt8 | None
    """(H, W) train ids of the clear frame."""
    invalid: UInt8
    """(H, W), 1 where the surface is undetectable or beyond the optical range."""
    transmittance: Float32
    """(H, W) share of the surface's light that reaches the pixel, in [0, 1]."""
    depth: Float32
    """(H, W) z-depth of the surface, metres, `inf` for the sky."""


def render(
    frame: Frame,
    weather: Weather,
    *,
    seed: int,
    ambience: Ambience,
    window: Window | None = None,
    drift_m: Wind | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> RenderedFrame:
    """Render `frame` in `weather`: a pure function of its arguments.

    Args:
        frame: Picture with depth; a label decides where the sky is, else the depth does.
        weather: State of air and ground.
        seed: Which particles fall. At equal drift a higher rain rate adds drops to those already
            there; of snow small flakes become fewer and large ones more.
        ambience: Light and axes of the scene.
        window: (top, left, height, width) to render, the whole picture if None; a window's pixels
            equal the same pixels of the whole.
        drift_m: How far the wind has carried the air since time 0 (along the street, to its left,
            up); wind times time if None. Give it to compare weathers of different wind, or where
            the wind changed on the way.
        options: Budget.

    Raises:
        ArgumentError: If the frame has no depth or the window leaves the picture.

    Source:
        docs/design.md, master equation: I = T B + (1 - T) A behind particles that are themselves
        seen through the air in front of them, all in linear light.
    """
    seed = check_seed("seed", seed)
    if not isinstance(weather, Weather):
        raise ArgumentError(f"weather must be a Weather, got {type(weather).__name__}")
    if frame.depth_m is None:
        raise ArgumentError(
            f"frame {frame.key} has no depth; build a scene from the clip, or pass depth_m"
        )
    height, width = frame.image.shape[:2]
    window = checked_window(window, height, width)
    if weather.is_clear:
        return _clear(frame, window)
    # Labels look around themselves, and so does the sky where only depth tells of it.
    looks = 1 if frame.label is not None else 2
    outer = _with_margin(window, looks * (NEIGHBOURHOOD_PX // 2), height, width)
    image, label, depth = _cut(frame, outer)
    sky = _sky_by_depth(depth) if label is None else label == SKY
    fields = _fields(weather, seed, ambience, drift_m)
    budget = options.max_particles // max(len(fields), 1)
    resolved = [field.resolve(frame.camera, budget) for field in fields]
    shot = _shade(frame, weather, ambience, outer, fields, resolved, image, depth, sky)
    return _trimmed(shot, label, depth, outer, window)


def checked_window(window: Window | None, height: int, width: int) -> Window:
    """`window` as integers, or the whole picture; refuse one that leaves the picture."""
    if window is None:
        return (0, 0, height, width)
    try:
        top, left, rows, columns = (v.__index__() for v in window)
    except (AttributeError, TypeError, ValueError):
        raise ArgumentError(
            f"window must be four integers (top, left, height, width), got {window!r}"
        ) from None
    if not (0 <= top and 0 <= left and rows > 0 and columns > 0):
        raise ArgumentError(f"window {window} must be (top >= 0, left >= 0, height > 0, width > 0)")
    if top + rows > height or left + columns > width:
        raise ArgumentError(f"window {window} leaves the picture of {height}x{width} pixels")
    return (top, left, rows, columns)


def warm_up() -> None:
    """Compile or load all kernels now, before worker processes are started.

    A frame as a scene stores it (half-precision depth, a label) and one as a caller may pass it.
    """
    intrinsics = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    camera = Camera(intrinsics, np.eye(4), 16, 16)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    grey = np.full(3, 0.5)
    ambience = Ambience(axes, grey, grey, grey, grey)
    image = np.full((16, 16, 3), 128, np.uint8)
    depth = np.full((16, 16), 20.0)
    label = np.zeros((16, 16), np.uint8)
    storm = Weather.mix(Weather.rain("heavy"), Weather.snow("heavy"))
    for dtype in (np.float16, np.float32):
        frame = Frame(FrameKey(0, "warm-up"), 0.0, camera, image, label, depth.astype(dtype))
        render(frame, storm, seed=0, ambience=ambience)


def _clear(frame: Frame, window: Window) -> RenderedFrame:
    image, label, depth = _cut(frame, window)
    return RenderedFrame(
        image,
        label,
        None if label is None else label.copy(),
        np.zeros(depth.shape, np.uint8),
        np.ones(depth.shape, np.float32),
        depth,
    )


def _cut(frame: Frame, window: Window) -> tuple[UInt8, UInt8 | None, Float32]:
    """Copies of a window of image, label and depth (float32, far and unknown as `inf`).

    Copies, because the kernels would be compiled once more for arrays that may not be written. A
    label of sky outranks a measured depth: sensors see leaves and wires before it.
    """
    top, left, height, width = window
    part = (slice(top, top + height), slice(left, left + width))
    assert frame.depth_m is not None
    depth = _clean_depth(np.asarray(frame.depth_m[part]))
    label = None if frame.label is None else np.array(frame.label[part], order="C")
    if label is not None:
        planes.raise_sky(label.reshape(-1), np.uint8(SKY), depth.reshape(-1))
    return np.array(frame.image[part], order="C"), label, depth


def _clean_depth(depth: NDArray[Any]) -> Float32:
    """A float32 copy with far and unknown as `inf`."""
    if depth.dtype == np.float16:
        wide = np.empty(depth.shape, np.float32)
        bits = np.array(depth, order="C").view(np.uint16)
        planes.widen_depth(bits.reshape(-1), wide.view(np.int32).reshape(-1))
        return wide
    copy = np.array(depth, np.float32, order="C")
    planes.clean_depth(copy.reshape(-1))
    return copy


def _sky_by_depth(depth: Float32) -> NDArray[np.bool_]:
    """Where the sky may show: everything far, and the ring around it that depth sensors miss.

    Inside the mask only pixels as bright as the sky are taken for it, so that the ring costs
    nothing where the edge was right.
    """
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    far = (depth == np.inf).astype(np.uint8)
    ringed: NDArray[np.bool_] = cv2.dilate(far, np.ones(size, np.uint8)).astype(bool)
    return ringed


def _with_margin(window: Window, margin: int, height: int, width: int) -> Window:
    """The window and the pixels around it that its labels depend on."""
    top, left, rows, columns = window
    first, start = max(top - margin, 0), max(left - margin, 0)
    end, stop = min(top + rows + margin, height), min(left + columns + margin, width)
    return (first, start, end - first, stop - start)


def _fields(
    weather: Weather, seed: int, ambience: Ambience, drift_m: Wind | None = None
) -> list[ParticleField]:
    axes = ambience.axes_world
    wind = np.asarray(weather.wind_m_per_s) @ axes
    drift = None if drift_m is None else np.asarray(drift_m, np.float64) @ axes
    populations = []
    if weather.rain_mm_per_h > statistics.TRACE_MM_PER_H:
        populations.append(statistics.rain(weather.rain_mm_per_h))
    if weather.snow_mm_per_h > statistics.TRACE_MM_PER_H:
        populations.append(statistics.snow(weather.snow_mm_per_h))
    return [ParticleField(population, seed, wind, axes, drift) for population in populations]


def _optics(camera: Camera, up_world: Float64) -> Optics:
    up = camera.world_from_camera[:3, :3].T @ up_world
    values = (
        *camera.focal_px,
        *camera.principal_px,
        camera.exposure_s,
        camera.aperture_m,
        *camera.angular_velocity_rad_per_s,
        *up,
        camera.width * camera.height,
    )
    return Optics(*(np.float32(v) for v in values))


def _medium(weather: Weather, fields: list[ParticleField]) -> Medium:
    values = (
        weather.fog_per_m,
        1.0 / weather.fog_scale_height_m,
        weather.mist_per_km * 1e-3,
        sum(field.population.extinction_per_m for field in fields),
        FAR_M / DEPTH_BINS,
        0.0,
    )
    return Medium(*(np.float32(v) for v in values))


def _shade(
    frame: Frame,
    weather: Weather,
    ambience: Ambience,
    window: Window,
    fields: list[ParticleField],
    resolved: list[Resolved],
    image: UInt8,
    depth: Float32,
    sky: NDArray[np.bool_],
) -> dict[str, Any]:
    """Run the kernels over a window; planes of its size come back."""
    optics = _optics(frame.camera, ambience.axes_world[2])
    medium = _medium(weather, fields)
    carried = np.zeros(DEPTH_BINS + 1, np.float32)
    for part in resolved:
        carried = carried + part.optical_depth
    airlight = ambience.airlight.astype(np.float32)
    splats = _splats(frame, weather, ambience, window, fields, resolved, optics, medium, carried)
    _, _, height, width = window
    bands = -(-height // BAND_ROWS)
    splats, band_starts = split_by_band(splats, window, bands)
    curve, matrix = tone(weather.overcast)
    out: dict[str, Any] = {
        "image": np.empty((3, height, width), np.uint8),
        "transmittance": np.empty((height, width), np.float32),
        "distinct": np.empty((height, width), np.uint8),
        "covered": np.zeros((height, width), np.uint8),
    }
    shade(
        image,
        depth,
        sky,
        _EVEN,
        window,
        optics,
        medium,
        carried,
        curve.astype(np.float32),
        matrix.astype(np.float32),
        Tone(
            np.float32(weather.overcast),
            np.float32(max(float(ambience.sky @ LUMINANCE), 0.05)),
            np.float32(ZENITH_GAIN),
            np.float32(0.0),
        ),
        airlight,
        splats,
        band_starts,
        np.float32(least_linear_contrast(ambience.airlight)),
        *out.values(),
    )
    out["image"] = cv2.merge(tuple(out["image"]))
    return out


def _splats(
    frame: Frame,
    weather: Weather,
    ambience: Ambience,
    window: Window,
    fields: list[ParticleField],
    resolved: list[Resolved],
    optics: Optics,
    medium: Medium,
    carried: Float32,
) -> Float32:
    """(N, 16) screen-space particles of all fields that touch the window."""
    light = ambience.under(weather.overcast)
    colour_of = {"rain": rain_colour, "snow": snow_colour}
    clouds = [
        field.particles(frame.camera, frame.time_s, part, window)
        for field, part in zip(fields, resolved, strict=True)
    ]
    if not any(len(cloud) for cloud in clouds):
        return np.empty((0, 16), np.float32)
    particles = np.concatenate(clouds) if len(clouds) > 1 else clouds[0]
    colours = np.array([colour_of[f.population.kind](light) for f in fields], np.float32)
    blocks, kinds = sorted_in_blocks(particles, np.cumsum([len(cloud) for cloud in clouds]))
    airlight = ambience.airlight.astype(np.float32)
    splats: Float32 = project(
        blocks, kinds, colours, optics, medium, carried, airlight, window, True
    )
    return splats


def _trimmed(
    shot: dict[str, Any],
    label: UInt8 | None,
    depth: Float32,
    outer: Window,
    window: Window,
) -> RenderedFrame:
    """Labels from the outer window, then everything cut to the inner one."""
    top, left = window[0] - outer[0], window[1] - outer[1]
    part = (slice(top, top + window[2]), slice(left, left + window[3]))
    seen = np.zeros(depth.shape, np.uint8) if label is None else label
    honest, invalid = readable_labels(
        seen, shot["transmittance"], shot["distinct"], shot["covered"]
    )
    cut = np.ascontiguousarray
    return RenderedFrame(
        image=cut(shot["image"][part]),
        label=None if label is None else cut(honest[part]),
        label_full=None if label is None else label[part].copy(),
        invalid=cut(invalid[part]),
        transmittance=cut(shot["transmittance"][part]),
        depth=cut(depth[part]),
    )
