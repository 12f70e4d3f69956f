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
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from weather_aug import _files
from weather_aug.taxonomy import CLASSES
from weather_aug.writers import layout

MIN_PIXELS = 3_000
"""A file counts for a class if it has more pixels of it than this."""

PathOf = Callable[[int], str | None]


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

    def write(self, out: Path, label_path: PathOf) -> tuple[str, ...]:
        """Write the three files; their names come back.

        Args:
            out: The export.
            label_path: Relative path of a sample's label, None where it has none.
        """
        chunks_by_name = {
            layout.CLASS_STATS: _json_chunks("[]", self._rows(label_path)),
            layout.CLASS_STATS_DICT: _json_chunks("{}", self._dict_rows(label_path)),
            layout.SAMPLES_WITH_CLASS: self._class_chunks(label_path),
        }
        for name, chunks in chunks_by_name.items():
            with _files.whole_file(out / name) as file:
                file.writelines(chunk.encode() for chunk in chunks)
                file.write(b"\n")
        return tuple(chunks_by_name)

    def _samples(self, label_path: PathOf) -> Iterator[tuple[str, dict[str, int]]]:
        kept = self.kept
        for index, row in enumerate(self._pixels):
            path = label_path(index)
            if path is not None:
                yield path, {str(c): int(row[c]) for c in kept if row[c]}

    def _rows(self, label_path: PathOf) -> Iterator[str]:
        return (json.dumps({**stats, "file": path}) for path, stats in self._samples(label_path))

    def _dict_rows(self, label_path: PathOf) -> Iterator[str]:
        for path, stats in self._samples(label_path):
            yield f"{json.dumps(path)}: {json.dumps(stats)}"

    def _class_chunks(self, label_path: PathOf) -> Iterator[str]:
        yield "{"
        for number, train_id in enumerate(self.kept):
            yield (",\n" if number else "\n") + f'"{train_id}": '
            yield from _json_chunks("[]", self._files_of(train_id, label_path))
        yield "\n}"

    def _files_of(self, train_id: int, label_path: PathOf) -> Iterator[str]:
        column = self._pixels[:, train_id]
        for index in np.flatnonzero(column):
            yield json.dumps([label_path(int(index)), int(column[index])])


def _json_chunks(brackets: str, rows: Iterable[str]) -> Iterator[str]:
    """A JSON array or object row by row, so that it need not fit into memory."""
    yield brackets[0]
    for number, row in enumerate(rows):
        yield (",\n" if number else "\n") + row
    yield f"\n{brackets[1]}"
