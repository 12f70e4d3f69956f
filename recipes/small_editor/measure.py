"""How near edited streets are to the physical editor's, and how steady: numbers and a table."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from small_editor.streets import STYLES, target

import weather_aug as wa
from weather_aug.edit.background import BackgroundEditor, Moment
from weather_aug.scores.colour import bhattacharyya, colour_histogram
from weather_aug.scores.editing import Neighbours, neighbours_of, statistics_gap

UInt8 = NDArray[np.uint8]
Float64 = NDArray[np.float64]
Pictures = Mapping[wa.FrameKey, UInt8]

MEASURES = (
    *("L1", "statistics", "warp_time", "warp_view", "colour_time", "colour_view", "seconds"),
)
"""All in sRGB of [0, 1], colours as Bhattacharyya distances in [0, 1]; "seconds" by picture."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A street that nothing was trained on."""

    scene: wa.WeatherScene
    frames: Mapping[wa.FrameKey, wa.Frame]
    neighbours: Neighbours
    targets: Mapping[str, Pictures]
    """The physical editor's pictures, by style."""

    @classmethod
    def of(cls, scene: wa.WeatherScene) -> HeldOut:
        """With what pictures are compared to, found once."""
        frames = {key: scene.frame(key) for key in scene.keys}
        targets = {
            style: {key: target(scene, key, style) for key in scene.keys} for style in STYLES
        }
        return cls(scene, frames, neighbours_of(frames), targets)

    @property
    def clear(self) -> Pictures:
        """The pictures as they were taken."""
        return {key: frame.image for key, frame in self.frames.items()}

    def edited(
        self, editor: BackgroundEditor, style: str
    ) -> tuple[dict[wa.FrameKey, UInt8], float]:
        """All pictures in a style, and the seconds that one took."""
        times = [list(keys) for _, keys in groupby(self.frames, key=lambda key: key.time_index)]
        rigs = [tuple(self.frames[key] for key in keys) for keys in times]
        found: dict[wa.FrameKey, UInt8] = {}
        began = time.perf_counter()
        for now, keys in enumerate(times):
            before = rigs[now - 1] if now else ()
            after = rigs[now + 1] if now + 1 < len(rigs) else ()
            pictures = editor.edit(Moment(rigs[now], before, after), style)
            found |= dict(zip(keys, pictures, strict=True))
        return found, (time.perf_counter() - began) / len(found)


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured of one street in one style."""

    values: Mapping[str, Float64]
    """(N,) by measure: one of each picture, or of each pair of neighbours."""


def measured(street: HeldOut, style: str, pictures: Pictures, seconds: float = 0.0) -> Measured:
    """Measure pictures of a street against the targets of a style, and their neighbours."""
    goals = street.targets[style]
    near = street.neighbours
    histograms = {key: colour_histogram(picture) for key, picture in pictures.items()}
    values = {
        "L1": [_l1(pictures[key], goals[key]) for key in street.frames],
        "statistics": [
            statistics_gap(pictures[key], goals[key], frame.label)
            for key, frame in street.frames.items()
        ],
        "seconds": [seconds],
    }
    for name, pairs in (("time", near.time), ("view", near.view)):
        values[f"warp_{name}"] = [
            same.error(pictures[a], pictures[b]).absolute for (a, b), same in pairs.items()
        ]
        values[f"colour_{name}"] = [bhattacharyya(histograms[a], histograms[b]) for a, b in pairs]
    return Measured({name: np.array(each) for name, each in values.items()})


Row = Mapping[tuple[str, str], Measured]
"""By (street, style)."""


def measured_row(
    streets: Sequence[HeldOut], editor: BackgroundEditor | None, styles: Sequence[str] = STYLES
) -> dict[tuple[str, str], Measured]:
    """Measure an editor on streets; the clear pictures if it is None."""
    row = {}
    for street in streets:
        for style in styles:
            pictures, seconds = street.clear, 0.0
            if editor is not None:
                pictures, seconds = street.edited(editor, style)
            row[street.scene.name, style] = measured(street, style, pictures, seconds)
    return row


def measured_targets(streets: Sequence[HeldOut]) -> dict[tuple[str, str], Measured]:
    """Measure the physical editor's pictures: how steady are those that an editor is to make?"""
    return {
        (street.scene.name, style): measured(street, style, street.targets[style])
        for street in streets
        for style in STYLES
    }


def mean(row: Row, measure: str, style: str | None = None) -> float:
    """Mean over streets of the mean of a street; over all styles if none is given."""
    chosen = [m.values[measure].mean() for (_, s), m in row.items() if style in (None, s)]
    return float(np.mean(chosen))


@dataclass(frozen=True)
class Difference:
    """Mean of a difference, and its standard error."""

    mean: float
    error: float
    better: float
    """Share of the compared pictures or pairs in which the first is lower."""

    def __str__(self) -> str:
        return f"{self.mean:+.5f} ± {self.error:.5f} (lower in {self.better:.0%})"


def difference(rows: Sequence[Row], others: Sequence[Row], measure: str) -> Difference:
    """Rows minus others, picture by picture, or pair by pair.

    Pictures of one street are alike, so that streets are counted, not pictures: the standard error
    is that of the streets' means over all rows (seeds).
    """
    by_street: dict[str, list[Float64]] = {}
    for row, other in zip(rows, others, strict=True):
        for (street, style), found in row.items():
            off = found.values[measure] - other[street, style].values[measure]
            by_street.setdefault(street, []).append(off)
    off = {street: np.concatenate(each) for street, each in by_street.items()}
    means = np.array([each.mean() for each in off.values()])
    spread = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    lower = np.mean(np.concatenate(list(off.values())) < 0)
    return Difference(float(means.mean()), float(spread), float(lower))


def table(rows: Mapping[str, Sequence[Row]]) -> str:
    """One line for each editor, means over its seeds; the first are the clear pictures.

    Warp errors are ratios to the first line's.
    """
    clear = next(iter(rows.values()))[0]
    head = f"{'':28}" + "".join(f"{'L1 ' + style:>9}" for style in STYLES)
    head += "".join(f"{'st. ' + style:>10}" for style in STYLES)
    lines = [head + "   warp t  warp v   BD t    BD v     s"]
    for name, seeds in rows.items():

        def of(measure: str, style: str | None = None, seeds: Sequence[Row] = seeds) -> float:
            return float(np.mean([mean(row, measure, style) for row in seeds]))

        line = f"{name:28}" + "".join(f"{of('L1', style):9.4f}" for style in STYLES)
        line += "".join(f"{of('statistics', style):10.4f}" for style in STYLES)
        line += "".join(f"{of(w) / mean(clear, w):8.3f}" for w in ("warp_time", "warp_view"))
        line += "".join(f"{of(c):8.4f}" for c in ("colour_time", "colour_view"))
        lines.append(line + f"{of('seconds'):7.3f}")
    return "\n".join(lines)


def report(rows: Mapping[str, Sequence[Row]]) -> str:
    """The table, and what it says of each part, with the spread over streets."""
    lines = [table(rows), ""]
    plain, clear = rows["self-attention"], rows["clear"] * len(rows["self-attention"])
    for style in STYLES:
        only = [_of_style(part, style) for part in (*plain, *clear)]
        for measure in ("L1", "statistics"):
            off = difference(only[: len(plain)], only[len(plain) :], measure)
            lines.append(f"{style}: {measure} to the target, edited - clear: {off}")
    for measure in ("L1", "statistics"):
        off = difference(plain, rows["without labels"], measure)
        lines.append(f"with - without labels: {measure}: {off}")
    for name in [name for name in rows if name.startswith("+")]:
        for measure in ("warp_time", "warp_view", "colour_time", "colour_view", "L1"):
            lines.append(
                f"{name} - self-attention: {measure}: {difference(rows[name], plain, measure)}"
            )
    return "\n".join(lines)


def _of_style(row: Row, style: str) -> Row:
    return {key: found for key, found in row.items() if key[1] == style}


def _l1(image: UInt8, goal: UInt8) -> float:
    return float(np.abs(image.astype(np.int16) - goal).mean() / 255.0)
