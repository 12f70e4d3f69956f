"""The paper's comparison of background editors, on any clip: one row an editor.

python -m benchmarks.editors SOURCE --editor none physical snow-cover stylisation
python -m benchmarks.editors SOURCE --editor diffusion --base DIR --adapter DIR \
    --attention self view temporal release paper --without labels --clip CLIP-MODEL-DIR
python -m benchmarks.editors SOURCE --editor stylisation colour-transfer controlnet \
    --weights DIR --pictures DIR --peer controlnet.base=DIR controlnet.steps=20

SOURCE is what `weather_aug.open_clip` takes, or the folder of a scene; of a clip a scene is built
in a temporary folder first. Numbers are of backgrounds as the editor leaves them: nothing falls.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.editor_rows import ATTENTION, NONE, PEER_VALUES, PHYSICAL, Physical, Row, rows_of
from benchmarks.report import write_results
from weather_aug.clip.open import open_clip
from weather_aug.clip.types import Clip, Float64, Frame, FrameKey
from weather_aug.edit.background import STYLES, BackgroundEditor, Moment
from weather_aug.edit.diffusion.options import ABLATIONS
from weather_aug.edit.diffusion.spec import CLEAR, PROMPTS
from weather_aug.errors import ArgumentError, DataError, MissingExtraError
from weather_aug.scene.scene import WeatherScene
from weather_aug.scores.clip import CLIP_LARGE, Encoder, clip_ds, clip_s, load_encoder
from weather_aug.scores.editing import EditScores, Neighbours, edit_scores, neighbours_of
from weather_aug.view.sheet import grid, write_png

UInt8 = NDArray[np.uint8]
Images = dict[FrameKey, UInt8]

OUT = Path("out/editors")
LEAST_TILE, LEAST_ROW, MOST_TILE = 480, 220, 1600
"""Of a sheet: width and height of a picture, pixels."""
COLUMNS = (
    *("CLIP-S", "CLIP-DS", "warp t", "ratio", "/contrast", "warp v", "ratio", "/contrast"),
    *("Bh t", "Bh v", "L1", "stat", "s/frame"),
)
LEGEND = """\
  CLIP-S     cosine of picture and prompt (-1..1, higher is nearer the text)
  CLIP-DS    cosine of the picture's change and the text's (-1..1; 0: unchanged)
  warp t     mean absolute difference, sRGB 0..1, of surfaces that neighbours in time both show;
             movers and sky are left out, depth and cameras tell what corresponds
  warp v     the same between cameras of one moment that overlap
  ratio      to the clear pictures' (1: as steady as the recording; lower: steadier, or blurred)
  /contrast  the ratio of errors per contrast: fog and blur gain nothing here
  Bh t, v    sqrt(1 - Bhattacharyya coefficient) of 8x8x8 RGB histograms of whole pictures, of
             neighbours in time and of overlapping cameras (0..1; `none` is the recording's own)
  L1, stat   to the physical editor's picture, sRGB 0..1: mean absolute difference; difference of
             each class's means and deviations of colour and luma. Not a score of realism
  s/frame    wall time of the edit, after one moment of warm-up"""


@dataclass(frozen=True)
class FirstTimes:
    """The first moments of a clip."""

    clip: Clip
    times: int

    @property
    def name(self) -> str:
        """Of the clip."""
        return self.clip.name

    @property
    def cameras(self) -> tuple[str, ...]:
        """Of the clip."""
        return self.clip.cameras

    @property
    def up_world(self) -> Float64:
        """Of the clip."""
        return self.clip.up_world

    @property
    def is_drive(self) -> bool:
        """Of the clip."""
        return bool(getattr(self.clip, "is_drive", True))

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Of the first moments."""
        return first_keys(self.clip.keys, self.times)

    def frame(self, key: FrameKey) -> Frame:
        """Of the clip."""
        return self.clip.frame(key)


@dataclass(frozen=True, eq=False)
class Bench:
    """A clip to edit, and all that is found of it once."""

    scene: WeatherScene
    frames: Mapping[FrameKey, Frame]
    moments: tuple[Moment, ...]
    neighbours: Neighbours


@dataclass(frozen=True, eq=False)
class Result:
    """What was measured of one editor."""

    scores: EditScores
    clip_s: float
    clip_ds: float
    seconds_per_frame: float


def first_keys(keys: Sequence[FrameKey], times: int) -> tuple[FrameKey, ...]:
    """Keys of the first `times` moments."""
    chosen = sorted({key.time_index for key in keys})[:times]
    return tuple(key for key in keys if key.time_index in chosen)


def moments_of(scene: WeatherScene, frames: Mapping[FrameKey, Frame]) -> tuple[Moment, ...]:
    """The moments of some frames of a scene, each with its neighbours among them."""

    def look(frame: Frame) -> Any:
        return scene.layers(frame.key), scene.ambience(frame.key)

    times: dict[int, list[Frame]] = {}
    for key, frame in frames.items():
        times.setdefault(key.time_index, []).append(frame)
    rigs = [(), *(tuple(times[at]) for at in sorted(times)), ()]
    return tuple(
        Moment(now, before, after, look)
        for before, now, after in zip(rigs, rigs[1:], rigs[2:], strict=False)
    )


def bench_of(scene: WeatherScene, times: int) -> Bench:
    """Read the first moments of a scene and find what its pictures have in common."""
    frames = {key: scene.frame(key) for key in first_keys(scene.keys, times)}
    return Bench(scene, frames, moments_of(scene, frames), neighbours_of(frames))


def pictures_of(editor: BackgroundEditor, bench: Bench, style: str) -> tuple[Images, float]:
    """All frames in a style, and the seconds that each took."""
    editor.edit(bench.moments[0], style)
    images: Images = {}
    seconds = 0.0
    for moment in bench.moments:
        start = time.perf_counter()
        pictures = editor.edit(moment, style)
        seconds += time.perf_counter() - start
        keys = [frame.key for frame in moment.now]
        images |= dict(zip(keys, pictures, strict=True))
    return images, seconds / len(images)


def measured(
    bench: Bench,
    images: Images,
    seconds: float,
    targets: Images,
    style: str,
    encoder: Encoder | None,
) -> Result:
    """Score the pictures of one editor."""
    scores = edit_scores(bench.frames, images, targets=targets, neighbours=bench.neighbours)
    if encoder is None:
        return Result(scores, math.nan, math.nan, seconds)
    text, clear_text = encoder.texts([PROMPTS[style], PROMPTS[CLEAR]])
    after = encoder.pictures([images[key] for key in bench.frames])
    before = encoder.pictures([frame.image for frame in bench.frames.values()])
    directional = clip_ds(after, before, text, clear_text)
    return Result(scores, float(clip_s(after, text).mean()), float(directional.mean()), seconds)


def heading(names: Sequence[str]) -> str:
    """First line of the table."""
    return "".join([f"  {'editor':{_width(names)}}", *(f"{name:>11}" for name in COLUMNS)])


def line(name: str, result: Result, names: Sequence[str]) -> str:
    """An editor's line of the table; "-" is what was not measured."""
    scores = result.scores
    warp = [
        value
        for each in (scores.warp_time, scores.warp_view)
        for value in (each.absolute, each.ratio, each.ratio_per_contrast)
    ]
    assert scores.target is not None
    values = [result.clip_s, result.clip_ds, *warp, scores.colour.time, scores.colour.view]
    values += [scores.target.l1, scores.target.statistics, result.seconds_per_frame]
    return "".join([f"  {name:{_width(names)}}", *map(_cell, values)])


def _width(names: Sequence[str]) -> int:
    return max(map(len, ("editor", *names)))


def _cell(value: float) -> str:
    return f"{'-':>11}" if math.isnan(value) else f"{value:11.4f}"


def sheet(bench: Bench, images_by_name: Mapping[str, Images]) -> UInt8:
    """A row an editor: all cameras of the middle moment, and the first camera a moment later."""
    middle = len(bench.moments) // 2
    frames = [*bench.moments[max(0, middle - 1)].now]
    if len(bench.moments) > 1:
        frames.append(bench.moments[middle].now[0])
    keys = [frame.key for frame in frames]
    rows = [[images[key] for key in keys] for images in images_by_name.values()]
    height, width = frames[0].image.shape[:2]
    # A row's name stands upright beside it.
    tile_width = min(MOST_TILE, max(LEAST_TILE, math.ceil(LEAST_ROW * width / height)))
    return grid(rows, list(images_by_name), [str(key) for key in keys], tile_width)


def compare(
    bench: Bench, rows: Sequence[Row], style: str, encoder: Encoder | None, out: Path
) -> dict[str, Result]:
    """Measure each editor in a style; print the table, write it and a sheet of pictures."""
    count = len(bench.frames)
    print(
        f"\n{bench.scene.name}, {style}: {count} pictures of {len(bench.moments)} moments",
        flush=True,
    )
    targets, _ = pictures_of(Physical(), bench, style)
    names = [row.name for row in rows]
    print(heading(names), flush=True)
    results: dict[str, Result] = {}
    shown: dict[str, Images] = {}
    for row in rows:
        try:
            editor = row.load(bench.scene)
            if style not in editor.styles:
                print(f"  {row.name}: does not edit to {style}, only to {', '.join(editor.styles)}")
                continue
            images, seconds = pictures_of(editor, bench, style)
        except (ArgumentError, DataError, MissingExtraError) as error:
            print(f"  {row.name}: not measured: {error}", flush=True)
            continue
        results[row.name] = measured(bench, images, seconds, targets, style, encoder)
        shown[row.name] = images
        print(line(row.name, results[row.name], names), flush=True)
    if not results:
        return results
    pairs = bench.neighbours
    print(f"  {len(pairs.time)} pairs in time, {len(pairs.view)} pairs of overlapping cameras")
    path = out / f"{bench.scene.name}-{style}"
    write_png(path.with_suffix(".png"), sheet(bench, shown))
    write_results(path.with_suffix(".json"), {name: asdict(r) for name, r in results.items()})
    print(f"  pictures and numbers: {path}.png, {path}.json")
    return results


@contextmanager
def scene_of(source: str, times: int) -> Iterator[WeatherScene]:
    """The scene in a folder, or one that is built of a clip's first moments and removed again."""
    if Path(source).is_dir():
        yield WeatherScene.load(source)
        return
    with tempfile.TemporaryDirectory() as folder:
        clip = FirstTimes(open_clip(source), times)
        yield WeatherScene.build(clip, Path(folder) / "scene", weathers=STYLES)


def encoder_of(given: argparse.Namespace) -> Encoder | None:
    """The CLIP model, or one line that says what is missing."""
    if given.clip is None:
        print(
            f"CLIP-S, CLIP-DS: not measured; give --clip a folder of {CLIP_LARGE} (licence: MIT; "
            f"hf download {CLIP_LARGE} --local-dir DIR)"
        )
        return None
    return load_encoder(given.clip, device=given.device)


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", help="clip, or folder of a scene")
    parser.add_argument("--editor", nargs="+", default=[NONE, PHYSICAL], metavar="NAME")
    parser.add_argument("--style", nargs="+", choices=STYLES, default=["snow"])
    parser.add_argument("--frames", type=int, default=6, help="moments, from the first")
    parser.add_argument("--clip", help="folder or id of a CLIP model; no CLIP scores without")
    parser.add_argument("--base", help="model of the diffusion editor")
    parser.add_argument("--adapter", type=Path, nargs="+", help="of the diffusion editor")
    parser.add_argument("--weights", type=Path, help="folder of the style networks")
    parser.add_argument("--pictures", type=Path, help="folder of a picture of each weather")
    parser.add_argument(
        "--peer",
        nargs="+",
        default=[],
        metavar="NAME.OPTION=VALUE",
        help=f"options of peers, of {', '.join(PEER_VALUES)}",
    )
    parser.add_argument("--attention", nargs="+", choices=ATTENTION, default=["release"])
    parser.add_argument("--without", nargs="+", choices=ABLATIONS, default=[])
    parser.add_argument("--height", type=int, help="rows at which networks edit; all if not given")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=OUT)
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> None:
    """Print the table of each style."""
    given = arguments(words)
    encoder = encoder_of(given)
    with scene_of(given.source, given.frames) as scene:
        bench = bench_of(scene, given.frames)
        for style in given.style:
            compare(bench, rows_of(given), style, encoder, given.out)
    print(f"\n{LEGEND}")


if __name__ == "__main__":
    main()
