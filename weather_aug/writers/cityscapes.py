"""Class statistics for rare-class sampling, as DAFormer, HRDA and MIC read them.

    sample_class_stats.json        [{"<train id>": pixels, …, "file": label path}, …]
    sample_class_stats_dict.json   {label path: {"<train id>": pixels, …}, …}
    samples_with_class.json        {"<train id>": [[label path, pixels], …], …}

A trainer asserts that every class of the statistics has a file with more than 3,000 of its pixels,
so a class without one is left out of all three. Files are matched by base name; paths are relative.
GTADataset looks for that name in its folder of labels itself, so its labels must stand flat there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from weather_aug import _files
from weather_aug.taxonomy import CLASSES
from weather_aug.writers import layout

MIN_PIXELS = 3_000
"""A file counts for a class if it has more pixels of it than this."""

LabelPaths = Callable[[], Iterable[str | None]]


class ClassStats:
    """Pixels of each class in each sample, 76 bytes a sample."""

    def __init__(self, count: int) -> None:
        """Start with `count` samples without a pixel."""
        self._pixels = np.zeros((count, len(CLASSES)), np.uint32)

    def add(self, index: int, class_pixels: Mapping[str, int]) -> None:
        """Record one sample's pixels by train id."""
        for train_id, pixels in class_pixels.items():
            self._pixels[index, int(train_id)] = pixels

    @property
    def kept(self) -> tuple[int, ...]:
        """Train ids that some file has enough pixels of."""
        most = self._pixels.max(axis=0)
        return tuple(int(train_id) for train_id in np.flatnonzero(most > MIN_PIXELS))

    @property
    def dropped(self) -> tuple[int, ...]:
        """Train ids that occur, but in no file often enough."""
        occurring = np.flatnonzero(self._pixels.max(axis=0))
        return tuple(int(train_id) for train_id in occurring if train_id not in self.kept)

    def write(
        self, out: Path, label_paths: LabelPaths, *, progress: bool = False
    ) -> tuple[str, ...]:
        """Write the three files; their names come back.

        Args:
            out: The export.
            label_paths: Gives the relative path of each sample's label in order, None where it has
                none; called once for each file and class, so that no list of paths is needed.
            progress: Show a bar if it takes more than a moment.
        """
        from tqdm.auto import tqdm

        kept = self.kept
        with tqdm(
            total=(2 + len(kept)) * len(self._pixels),
            desc="classes",
            unit="row",
            unit_scale=True,
            delay=1.0,
            disable=not progress,
        ) as bar:

            def paths() -> Iterator[str | None]:
                for path in label_paths():
                    yield path
                    bar.update()

            chunks_by_name = {
                layout.CLASS_STATS: _json_chunks("[]", self._rows(kept, paths)),
                layout.CLASS_STATS_DICT: _json_chunks("{}", self._dict_rows(kept, paths)),
                layout.SAMPLES_WITH_CLASS: self._class_chunks(kept, paths),
            }
            for name, chunks in chunks_by_name.items():
                with _files.whole_file(out / name) as file:
                    file.writelines(chunk.encode() for chunk in chunks)
                    file.write(b"\n")
        return tuple(chunks_by_name)

    def _samples(
        self, kept: Sequence[int], label_paths: LabelPaths
    ) -> Iterator[tuple[str, dict[str, int]]]:
        for path, row in zip(label_paths(), self._pixels, strict=True):
            if path is not None:
                pixels = row.tolist()
                yield path, {str(c): pixels[c] for c in kept if pixels[c]}

    def _rows(self, kept: Sequence[int], label_paths: LabelPaths) -> Iterator[str]:
        for path, stats in self._samples(kept, label_paths):
            yield json.dumps({**stats, "file": path})

    def _dict_rows(self, kept: Sequence[int], label_paths: LabelPaths) -> Iterator[str]:
        for path, stats in self._samples(kept, label_paths):
            yield f"{json.dumps(path)}: {json.dumps(stats)}"

    def _class_chunks(self, kept: Sequence[int], label_paths: LabelPaths) -> Iterator[str]:
        yield "{"
        for number, train_id in enumerate(kept):
            yield (",\n" if number else "\n") + f'"{train_id}": '
            yield from _json_chunks("[]", self._files_of(train_id, label_paths))
        yield "\n}"

    def _files_of(self, train_id: int, label_paths: LabelPaths) -> Iterator[str]:
        for path, pixels in zip(label_paths(), self._pixels[:, train_id], strict=True):
            if pixels:
                yield f"[{json.dumps(path)}, {pixels}]"


def _json_chunks(brackets: str, rows: Iterable[str]) -> Iterator[str]:
    """A JSON array or object row by row, so that it need not fit into memory."""
    yield brackets[0]
    for number, row in enumerate(rows):
        yield (",\n" if number else "\n") + row
    yield f"\n{brackets[1]}"
