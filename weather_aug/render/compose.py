"""A frame and a weather become a picture with honest labels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import check_seed
from weather_aug.air import Air, air_of
from weather_aug.clip.types import Box, Camera, Frame, FrameKey, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.edit.physical.look import changes_background
from weather_aug.edit.surface import checked_window, depth_of, kinds_of, surface_of
from weather_aug.errors import ArgumentError
from weather_aug.particles.shelter import Shelter
from weather_aug.render.background import background_of, looked_at
from weather_aug.render.fields import RigMotion, fields_of
from weather_aug.render.label import (
    DOUBTFUL_TRANSMITTANCE,
    MARGIN_PX,
    Sight,
    kept_labels,
    readable_labels,
)
from weather_aug.render.label_runs import small_things
from weather_aug.render.label_snow import buried_borders, covered_faces, snow_limits
from weather_aug.render.label_weight import loss_weight_of
from weather_aug.render.lens import Glass
from weather_aug.render.lens_wiper import CROSSING, wiper_of
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.render.scattering import scattering_margin_px
from weather_aug.render.stage import Planes, Stage
from weather_aug.render.taken import camera_in, sees_whole, taken, window_taken
from weather_aug.render.traffic import traffic_of
from weather_aug.taxonomy import SIDEWALK, SKY, TRAIN_ID
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A picture in weather, and what can still be said about it; H, W are the window's size."""

    image: UInt8
    """(H, W, 3) sRGB."""
    label: UInt8 | None
    """(H, W) train ids, by `RenderOptions.labels` 255 where the surface cannot be seen; None where
    nobody labelled it."""
    label_full: UInt8 | None
    """(H, W) train ids of the clear frame."""
    invalid: UInt8
    """(H, W), 1 where the surface is undetectable, or small and beyond the optical range, or under
    so much snow that it cannot be told; of the sky where what stood before it has vanished."""
    transmittance: Float32
    """(H, W) share of the surface's light that reaches the pixel, in [0, 1]."""
    frame: Frame
    """The recorded frame behind the weather."""
    window: Window
    """Which part of it (top, left, height, width)."""

    @cached_property
    def depth(self) -> Float32:
        """(H, W) z-depth of the surface, metres, `inf` for the sky; read on first use."""
        return depth_of(surface_of(self.frame), self.window)

    @cached_property
    def loss_weight(self) -> Float32:
        """(H, W) in [0, 1], how much a loss should count each pixel; see `loss_weight_of`.

        0 where the label is 255 because of the weather, rising with the transmittance; computed on
        first use.
        """
        if self.label is None or self.label_full is None:
            return loss_weight_of(self.transmittance, self.invalid, np.isinf(self.depth), None)
        lost = self.label != self.label_full
        return loss_weight_of(self.transmittance, self.invalid, self.label_full == SKY, lost)


def render(
    frame: Frame,
    weather: Weather,
    *,
    seed: int,
    ambience: Ambience,
    window: Window | None = None,
    air: Air | None = None,
    shelter: Shelter | None = None,
    rig: RigMotion | None = None,
    layers: Layers | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> RenderedFrame:
    """Render `frame` in `weather`: a pure function of its arguments.

    Args:
        frame: Picture with depth; a label decides where the sky is, else the depth does.
        weather: State of air and ground.
        seed: Which particles fall and which gusts blow. In equal air a higher rain rate adds drops
            to those already there; of snow small flakes become fewer and large ones more.
        ambience: Light and axes of the scene.
        window: (top, left, height, width) to render, the whole picture if None; a window's pixels
            equal the same pixels of the whole.
        air: How the air moves and has moved; if None, as it does when the weather has been the same
            since time 0. `WeatherTimeline.air` tells it of changing weather, `Air.held` keeps
            drops in place from one weather to the next.
        shelter: Bridges and roofs of the street, None for an open sky.
        rig: Motion of the reference camera, for options that carry the particles along with it; if
            None, this camera stood at time 0 where it stands.
        layers: What the editor knows of the frame; if None, it looks at the frame now, and the way
            driven is taken to go straight ahead.
        options: Choices besides the weather.

    Raises:
        ArgumentError: If the frame has no depth or the window leaves the picture.

    Source:
        docs/physics.md, master equation: I = T B + (1 - T) A behind particles that are themselves
        seen through the air in front of them, all in linear light.
    """
    seed = check_seed("seed", seed)
    if not isinstance(weather, Weather):
        raise ArgumentError(f"weather must be a Weather, got {type(weather).__name__}")
    if frame.depth_m is None:
        raise ArgumentError(
            f"frame {frame.key} has no depth; build a scene from the clip, or pass depth_m"
        )
    if not isinstance(options, RenderOptions):
        raise ArgumentError(f"options must be RenderOptions, got {type(options).__name__}")
    height, width = frame.image.shape[:2]
    window = checked_window(window, height, width)
    if weather.is_clear:
        return _clear(frame, window)
    if air is None:
        air = air_of(weather, frame.time_s, seed)
    outer = _with_margin(window, _margin_px(frame, options), height, width)
    edits = changes_background(weather, options.without)
    if layers is None and (edits or sees_whole(weather, options)):
        layers = looked_at(frame, ambience)
    if options.preset != "physical":
        surface = background_of(frame, weather, ambience, outer, layers, options)
        here = frame.camera.world_from_camera
        stage = Stage(surface, outer, frame.camera, weather, ambience, seed, air, options)
        shot = stage.published(rig or RigMotion(here, here), frame.time_s)
        return _trimmed(shot, None, frame, outer, window, weather, options)
    outer = window_taken(outer, frame.camera, options)
    surface = background_of(frame, weather, ambience, outer, layers, options)
    camera = camera_in(frame.camera, weather, options)
    stage = Stage(surface, outer, camera, weather, ambience, seed, air, options)
    fields = fields_of(weather, seed, air, ambience.axes_world, options, rig)
    traffic = traffic_of(frame, weather, ambience, seed, options)
    shot = stage.shaded(fields, shelter, frame.time_s, traffic.spray(air))
    photo = taken(traffic.lit(shot.image, outer, fields), frame, stage, fields, layers)
    shot = shot._replace(image=photo.image)
    return _trimmed(shot, photo.glass, frame, outer, window, weather, options)


def warm_up() -> None:
    """Compile or load all kernels of a default render now, before worker processes are started.

    A labelled frame with half-precision depth, as a scene stores it, and an unlabelled one with
    single precision, each with a car ahead, under all that falls, through a wiper and behind it.
    """
    intrinsics = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    camera = Camera(intrinsics, np.eye(4), 16, 16)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    grey = np.full(3, 0.5)
    ambience = Ambience(axes, grey, grey, grey, grey)
    image = np.full((16, 16, 3), 128, np.uint8)
    depth = np.full((16, 16), 20.0)
    label = np.zeros((16, 16), np.uint8)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes.T, (0.0, 0.75, 10.0)
    car = Box(0, "car", pose, (4.5, 1.8, 1.5), np.array([0.0, 0.0, 12.0]))
    both = Weather.mix(Weather.rain("heavy"), Weather.snow("heavy"))
    storm = replace(both, wipers=1.0, lens_drops=500.0)
    roof = Shelter(np.full((8, 8), 3.0, np.float32), np.array([-2.0, -2.0, -5.0]), axes)
    patchy = Weather(visibility_m=50.0, fog_patchiness=0.5, fog_puffs=0.2)
    deep = Weather(visibility_m=18.0, snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2)
    label[:, 8:] = SIDEWALK
    label[2:4, :] = TRAIN_ID["traffic sign"]
    for dtype, known in ((np.float16, label), (np.float32, None)):
        frame = Frame(
            FrameKey(0, "warm-up"), 0.0, camera, image, known, depth.astype(dtype), boxes=(car,)
        )
        for time_s in _wiping_s(storm, camera):
            moment = replace(frame, time_s=time_s)
            render(moment, storm, seed=0, ambience=ambience, shelter=roof)
        render(frame, patchy, seed=0, ambience=ambience)
        render(frame, deep, seed=0, ambience=ambience)


def _wiping_s(weather: Weather, camera: Camera) -> tuple[float, float]:
    """When, at seed 0, the blade is before the picture, and when it has just passed."""
    wiper = wiper_of(weather, camera, 0, 0, 0.0)
    assert wiper is not None
    crossing_s = CROSSING * wiper.period_s
    return wiper.start_s + 0.5 * crossing_s, wiper.start_s + 2.0 * crossing_s


def _clear(frame: Frame, window: Window) -> RenderedFrame:
    part = _part(window)
    label = None if frame.label is None else np.array(frame.label[part], order="C")
    size = window[2:]
    return RenderedFrame(
        np.array(frame.image[part], order="C"),
        label,
        None if label is None else label.copy(),
        np.zeros(size, np.uint8),
        np.ones(size, np.float32),
        frame,
        window,
    )


def _part(window: Window) -> tuple[slice, slice]:
    top, left, height, width = window
    return slice(top, top + height), slice(left, left + width)


def _with_margin(window: Window, margin: int, height: int, width: int) -> Window:
    """The window and the pixels around it that its labels depend on."""
    top, left, rows, columns = window
    first, start = max(top - margin, 0), max(left - margin, 0)
    end, stop = min(top + rows + margin, height), min(left + columns + margin, width)
    return (first, start, end - first, stop - start)


def _margin_px(frame: Frame, options: RenderOptions) -> int:
    """How far around a pixel its label and colour depend on the picture."""
    margin = MARGIN_PX
    if options.multiple_scattering:
        margin += scattering_margin_px(max(frame.camera.focal_px), math.inf)
    return margin


def _trimmed(
    shot: Planes,
    glass: Glass | None,
    frame: Frame,
    outer: Window,
    window: Window,
    weather: Weather,
    options: RenderOptions,
) -> RenderedFrame:
    """Labels from the outer window, then everything cut to the inner one."""
    through, covered = shot.transmittance, shot.covered
    if glass is not None:
        through = through * (np.float32(1.0) - glass.alpha)
        covered = covered | glass.hidden
    part = _part((window[0] - outer[0], window[1] - outer[1], *window[2:]))
    cut = np.ascontiguousarray
    sight = Sight(*np.zeros((2, *window[2:]), np.uint8))
    # Else all surfaces are bright enough behind the glass and none is hazy.
    if shot.hazy_count or covered.any() or through.min() < DOUBTFUL_TRANSMITTANCE:
        planes = readable_labels(
            kinds_of(surface_of(frame), outer),
            shot.transmittance,
            through,
            shot.distinct,
            covered,
            small_things(frame, outer),
        )
        sight = Sight(*(cut(plane[part]) for plane in planes))
    full = None if frame.label is None else np.array(frame.label[_part(window)], order="C")
    honest = None
    if full is not None:
        sight = _under_snow(sight, frame, window, weather, options)
        honest = kept_labels(full, sight.unseen, options.labels)
    return RenderedFrame(
        image=cut(shot.image[part]),
        label=honest,
        label_full=full,
        invalid=sight.invalid,
        transmittance=cut(through[part]),
        frame=frame,
        window=window,
    )


def _under_snow(
    sight: Sight, frame: Frame, window: Window, weather: Weather, options: RenderOptions
) -> Sight:
    """What cannot be told because of the snow that lies, besides what cannot be seen."""
    limits = snow_limits(weather, options)
    if limits is None:
        return sight
    unseen = sight.unseen | buried_borders(frame, window, limits)
    return Sight(unseen, sight.invalid | unseen | covered_faces(frame, window, limits))
