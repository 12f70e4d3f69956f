"""A scene's frame in a weather: over the editor's dressing, or over stored backgrounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from weather_aug.air import Air
from weather_aug.clip.types import Frame, Window
from weather_aug.edit.physical.layers import Layers
from weather_aug.particles.shelter import Shelter
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import RenderOptions
from weather_aug.scene.backdrop import backdrop_of, under_snow, with_picture
from weather_aug.scene.records import Manifest, rig_motion
from weather_aug.scene.styles import carried_options
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather


class Asked(NamedTuple):
    """What is asked of a render, besides the frame; see `WeatherScene.render`."""

    weather: Weather | WeatherTimeline
    seed: int
    window: Window | None
    air: Air | None
    options: RenderOptions


class Drive(NamedTuple):
    """What a frame's scene knows."""

    folder: Path
    manifest: Manifest
    shelter: Shelter | None
    look: Callable[[Frame], Layers]
    """What the editor knows of a frame."""


def dressed(drive: Drive, frame: Frame, asked: Asked) -> RenderedFrame:
    """A frame, recorded or not, in a weather; the physical editor draws what lies on surfaces."""
    manifest = drive.manifest
    weather, air, options = asked.weather, asked.air, asked.options
    frame = replace(frame, time_s=frame.time_s - manifest.frames[0].time_s)
    if isinstance(weather, WeatherTimeline):
        air = air or weather.air(frame.time_s, asked.seed)
        weather = weather.at(frame.time_s)
    # A clear picture is returned as it is, and what is no weather is refused.
    is_seen = isinstance(weather, Weather) and not weather.is_clear
    return render(
        frame,
        weather,
        seed=asked.seed,
        ambience=manifest.ambience(manifest.by_key[frame.key], manifest.raised_m(frame)),
        window=asked.window,
        air=air,
        shelter=drive.shelter,
        rig=rig_motion(manifest.frames, frame.key) if options.needs_rig else None,
        layers=drive.look(frame) if is_seen else None,
        options=options,
    )


def over_stored(
    drive: Drive, recorded: Frame, weights: Mapping[str, float], asked: Asked
) -> RenderedFrame:
    """A recorded frame in a weather, over shares of its stored backgrounds.

    Args:
        drive: With these styles.
        recorded: The frame.
        weights: Above 0 and together at most 1, by style; the rest is the recorded picture.
        asked: The rest.

    Raises:
        SceneError: If a picture cannot be read.
    """
    image, lying = backdrop_of(drive.folder, drive.manifest, recorded, weights)

    def look(frame: Frame) -> Layers:
        return with_picture(drive.look(frame), image)

    shown = replace(recorded, image=image)
    dressing = asked._replace(options=carried_options(asked.options))
    shot = dressed(drive._replace(look=look), shown, dressing)
    shot = replace(shot, frame=replace(shot.frame, image=recorded.image))
    return under_snow(shot, recorded, lying, asked.options)
