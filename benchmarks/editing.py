"""The edit of the background against the 2D snow and fog of albumentations 2.0.8, and its parts.

"On the fly" is what a single picture costs: its surfaces are looked at, then it is painted. "From
stored layers" is what a picture of a scene costs that has been looked at before. A whole render has
lamps to draw: three vehicles drive before the camera. Targets in milliseconds are for 512 x 1024.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.overlays import FOG, HEIGHT, SIZES, air_only, peers
from benchmarks.report import Row, show
from benchmarks.scene import CAMERA_HEIGHT_M, street
from benchmarks.stages import Stages, show_table, stage_ms
from benchmarks.timing import interleaved
from weather_aug.clip.types import Box, Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical import edit, layers, relight, settling
from weather_aug.edit.physical.edit import edited
from weather_aug.edit.physical.layers import Layers
from weather_aug.render import background
from weather_aug.render.background import looked_at
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.weather import Weather

BACKGROUNDS = {
    "wet road (after heavy rain)": Weather.rain("heavy", falling=False),
    "snow (heavy)": Weather.snow("heavy", falling=False),
    "overcast (heavy fog)": Weather.fog("heavy"),
}
WEATHERS = {kind: getattr(Weather, kind)("heavy") for kind in ("rain", "snow", "fog")}
TEXTURE, HAZE = "RandomSnow (texture)", "RandomFog (0.5-0.8)"
FLY, STORED = ", on the fly", ", stored"
ON_THE_FLY_MS, STORED_MS = 25.0, 3.0
SENSOR = ("exposure", "noise", "glare", "compression")
PARTS = {
    "lamps and spray": ("lamps", "spray"),
    "glass": ("drops", "wipers", "lens_veil"),
    "sensor": SENSOR,
    "background": tuple(EFFECTS[: EFFECTS.index("lamps")]),
}
EDIT_STAGES: Stages = {
    "look: surfaces and classes": (background, "site_of"),
    "look: flattening of the sun": (relight, "flattening"),
    "look: matte of the sky": (relight, "sky_matte"),
    "look: illumination": (relight, "illumination"),
    "look: what is mirrored, where": (layers, "mirror_map"),
    "look: mirrored light": (layers, "mirrored"),
    "look: what faces up": (settling, "facing_up"),
    "look: place across the street": (settling, "lateral_m"),
    "look: the rest": (background, "layers_of"),
    "paint": (edit, "dress"),
}
CARS = ((-1.8, 18.0, -9.0), (1.8, 25.0, 12.0), (-1.8, 40.0, -9.0))
"""To the right, ahead (metres), and ahead (metres per second), of each vehicle."""
PART_ROUNDS, STAGE_ROUNDS = 5, 9


def measure() -> list[dict[str, Any]]:
    """Print the edit beside its peers, the parts of a whole render, and the stages of the edit."""
    return [_measured(height, width) for height, width in SIZES]


def with_traffic(frame: Frame) -> Frame:
    """The frame with three vehicles that drive, as boxes."""
    boxes = []
    for number, (right_m, ahead_m, speed) in enumerate(CARS):
        along = np.array([0.0, 0.0, np.sign(speed)])
        down = np.array([0.0, 1.0, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([along, np.cross(-down, along), -down], axis=1)
        pose[:3, 3] = right_m, CAMERA_HEIGHT_M - 0.75, ahead_m
        boxes.append(Box(number, "car", pose, (4.5, 1.8, 1.5), np.abs(speed) * along))
    return replace(frame, boxes=tuple(boxes))


def edits(frame: Frame, ambience: Ambience, stored: Layers) -> dict[str, Callable[[], object]]:
    """Calls of each background's edit, on the fly and from stored layers."""
    window = (0, 0, *frame.image.shape[:2])

    def on_the_fly(weather: Weather) -> object:
        return edited(frame, looked_at(frame, ambience), weather, ambience, window)

    calls: dict[str, Callable[[], object]] = {}
    for name, weather in BACKGROUNDS.items():
        calls[name + FLY] = partial(on_the_fly, weather)
        calls[name + STORED] = partial(edited, frame, stored, weather, ambience, window)
    return calls


def edit_ratios(ms: Mapping[str, float], height: int) -> list[Row]:
    """The edit against its targets and the sum of its peers."""
    theirs = ms[TEXTURE] + ms[HAZE]
    rows = []
    for name in BACKGROUNDS:
        fly, stored = ms[name + FLY], ms[name + STORED]
        in_time, at_once = (ON_THE_FLY_MS, STORED_MS) if height == HEIGHT else (None, None)
        rows += [
            Row(f"{name}: on the fly", fly, "ms", at_most=in_time),
            Row(f"{name}: from stored layers", stored, "ms", at_most=at_once),
            Row(f"{name}: on the fly / (RandomSnow + RandomFog)", fly / theirs, "x", at_most=1.0),
            Row(f"{name}: on the fly / RandomSnow", fly / ms[TEXTURE], "x"),
            Row(f"{name}: stored / (RandomSnow + RandomFog)", stored / theirs, "x"),
        ]
    return rows


def part_ratios(ms: Mapping[str, float], kind: str) -> list[Row]:
    """Whole renders in fog passes, and what each part of them costs."""
    whole, fog = ms[f"{kind}: stored"], ms["fog pass"]
    rows = [
        Row(f"{kind}: whole, on the fly / fog pass", ms[f"{kind}: on the fly"] / fog, "x"),
        Row(f"{kind}: whole, stored layers / fog pass", whole / fog, "x"),
        Row(f"{kind}: air alone / fog pass", ms[f"{kind}: air"] / fog, "x"),
    ]
    for part in PARTS:
        added = ms[f"{kind}: air + {part}"] - ms[f"{kind}: air"]
        rows.append(Row(f"{kind}:   {part} alone add", added, "ms"))
    for effect in EFFECTS:
        less = ms.get(f"{kind}: without {effect}")
        if less is not None:
            rows.append(Row(f"{kind}:   leaving out {effect} saves", whole - less, "ms"))
    return rows


def missed(rows: list[Row]) -> list[str]:
    """One sentence for each target that is not met."""
    return [
        f"missed: {row.name} is {row.value:.3g} {row.unit}, target {row.at_most:g}"
        for row in rows
        if row.verdict == "missed"
    ]


def _measured(height: int, width: int) -> dict[str, Any]:
    frame, ambience = street(height, width, speed_m_per_s=10.0)
    frame = with_traffic(frame)
    stored = looked_at(frame, ambience)
    ours = edits(frame, ambience, stored)
    others = {
        name: partial(peer, image=frame.image)
        for name, peer in peers().items()
        if name in (TEXTURE, HAZE)
    }
    ms = interleaved(ours | others)
    rows = edit_ratios(ms, height)
    shown = show(f"{height} x {width}: the edit against albumentations 2.0.8", rows)
    for sentence in missed(rows):
        print(f"  {sentence}")
    table = {
        name.split(" (")[0]: stage_ms(run, STAGE_ROUNDS, EDIT_STAGES)
        for name, run in ours.items()
        if name.endswith(FLY)
    }
    show_table(f"{height} x {width}: stages of the edit, ms", table)
    parts = _parts(frame, ambience, stored)
    title = f"{height} x {width}: parts of a whole render (fog pass: {parts['fog pass']:.2f} ms)"
    part_rows = [row for kind in WEATHERS for row in part_ratios(parts, kind)]
    shown_parts = show(title, part_rows)
    return {
        "size": [height, width],
        "ms": ms,
        "rows": shown["rows"],
        "stages": table,
        "parts": shown_parts["rows"],
        "parts_ms": parts,
    }


def _parts(frame: Frame, ambience: Ambience, stored: Layers) -> dict[str, float]:
    """Milliseconds of whole renders and of renders with one part more or less."""
    call = partial(render, frame, seed=1, ambience=ambience)
    kept = partial(call, layers=stored)
    calls: dict[str, Callable[[], object]] = {"fog pass": partial(kept, FOG, options=air_only(0))}
    for kind, weather in WEATHERS.items():

        def without(*effects: str, weather: Weather = weather) -> Callable[[], RenderedFrame]:
            return partial(kept, weather, options=RenderOptions(without=effects))

        calls[f"{kind}: on the fly"] = partial(call, weather)
        calls[f"{kind}: stored"] = without()
        calls[f"{kind}: air"] = without(*EFFECTS)
        for part, effects in PARTS.items():
            others = (effect for effect in EFFECTS if effect not in effects)
            calls[f"{kind}: air + {part}"] = without(*others)
        picture = without()().image
        for effect in EFFECTS:
            if (without(effect)().image != picture).any():
                calls[f"{kind}: without {effect}"] = without(effect)
    return interleaved(calls, PART_ROUNDS)


if __name__ == "__main__":
    measure()
