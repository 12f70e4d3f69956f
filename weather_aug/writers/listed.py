"""Plans read from a list of samples, such as chosen lines of another export's manifest.

One JSON object a line, empty lines left out:

    {"scene": "street", "time_index": 3, "camera": "front", "weather": "rain=0.3", "seed": 7}

scene        name of the scene, or `scene_digest` with its digest; neither where there is only one
weather      fields of a `Weather`, or a text as `choices.weather_named` takes
seed         of the particles; 0 if not given
kind         what the manifest calls it; the weather's text, or "listed", if not given
severity     in [0, 1] or null, for the manifest alone

An object with the field `recipe` is a manifest's line: its recipe is taken. Other fields are left
alone.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.scene.policy import WeatherDraw
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather
from weather_aug.writers.choices import weather_named

MAX_LISTED = 100_000
"""Samples of a list, which stands in memory, about 1 kB each."""
LISTED = "listed"


@dataclass(frozen=True)
class FromList:
    """Frames and weathers as somebody listed them."""

    samples: tuple[tuple[int, WeatherDraw], ...]

    def item(self, index: int, frames: int) -> tuple[int, WeatherDraw]:
        """Item i is sample i of the list."""
        return self.samples[index]

    def shares(self) -> dict[str, float]:
        """What was counted, in the order in which kinds first occur."""
        counts = Counter(draw.kind for _, draw in self.samples)
        return {kind: count / len(self.samples) for kind, count in counts.items()}

    def to_dict(self) -> dict[str, Any]:
        """A digest of the list."""
        listed = [
            [frame, draw.weather.to_dict(), draw.seed, draw.kind, draw.severity]
            for frame, draw in self.samples
        ]
        return {"list_sha256": _files.sha256_of(json.dumps(listed, allow_nan=False).encode())}


def read_list(path: Path, scenes: Sequence[WeatherScene]) -> FromList:
    """Read a list of samples of scenes; the module says what its lines hold.

    Raises:
        DataError: If it cannot be read, is empty or too long, or a line is no sample of the scenes.
        SceneError: If a scene cannot be read.
    """
    frames = _Frames(scenes)
    samples = []
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if not line.strip():
                    continue
                where = f"{path}, line {number}"
                samples.append(_sample(_files.parse_json(line, where), frames, where))
                if len(samples) > MAX_LISTED:
                    raise DataError(
                        f"{printable(path, 200)} lists more than {MAX_LISTED} samples; split it"
                    )
    except UnicodeDecodeError:
        raise DataError(f"{printable(path, 200)} is not UTF-8 text") from None
    except OSError as error:
        raise DataError(f"cannot read {printable(path, 200)}: {error.strerror}") from None
    if not samples:
        raise DataError(f"{printable(path, 200)} lists no samples")
    return FromList(tuple(samples))


class _Frames:
    """Where a line's frame stands among the frames of all scenes in a row."""

    def __init__(self, scenes: Sequence[WeatherScene]) -> None:
        self._scenes = scenes
        counts = [len(scene.keys) for scene in scenes]
        self._starts = (0, *accumulate(counts))
        self._places = [{key: place for place, key in enumerate(scene.keys)} for scene in scenes]

    def frame(self, line: Mapping[str, Any]) -> int:
        fitting = [
            number
            for number, scene in enumerate(self._scenes)
            if line.get("scene", scene.name) == scene.name
            and line.get("scene_digest", scene.digest) == scene.digest
        ]
        if len(fitting) != 1:
            which = "no scene is" if not fitting else f"{len(fitting)} scenes are"
            name = line.get("scene_digest", line.get("scene"))
            raise ArgumentError(f"{which} {printable(name)}; name one by its scene_digest")
        key = FrameKey(check_seed("time_index", line["time_index"]), str(line["camera"]))
        place = self._places[fitting[0]].get(key)
        if place is None:
            raise ArgumentError(f"the scene has no frame {printable(key)}")
        return self._starts[fitting[0]] + place


def _sample(line: Any, frames: _Frames, where: str) -> tuple[int, WeatherDraw]:
    try:
        line = line.get("recipe", line)
        weather, severity = line["weather"], line.get("severity")
        named = isinstance(weather, str)
        draw = WeatherDraw(
            weather_named(weather) if named else Weather.from_dict(weather),
            check_seed("seed", line.get("seed", 0)),
            str(line.get("kind", weather if named else LISTED)),
            None if severity is None else finite("severity", severity, 0, 1),
        )
        return frames.frame(line), draw
    except KeyError as error:
        raise DataError(f"{printable(where, 200)} has no field {error}") from None
    except (ArgumentError, TypeError, AttributeError) as error:
        raise DataError(f"{printable(where, 200)} is no sample: {error}") from None
