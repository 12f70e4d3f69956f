"""How DAFormer, HRDA and MIC read a data set, written again from their documented rules.

Convention:
    A data set class is tied to an image suffix and a label suffix. It lists its pictures by a scan
    of `img_dir`, of any depth, in whatever order the file system gives; a label is where the suffix
    replaced in the picture's path leads, below `ann_dir`. What is hidden, or a link that leads
    nowhere, ends a run there. Rare-class sampling (RCS) draws a class c
    with P(c) = softmax((1 - f_c) / T) of its share f_c of all pixels, then a file with more than
    `min_pixels` of it, then crops of that file until one shows enough of the class, at most eleven.
    It matches files by base name, but in the GTA class by path. Pictures are BGR, labels
    the PNG's values as they are.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

UInt8 = NDArray[np.uint8]
Window = tuple[slice, slice]
IGNORE = 255
CROP_TRIES = 10

SUFFIXES = {
    "CityscapesDataset": ("_leftImg8bit.png", "_gtFine_labelTrainIds.png"),
    "ACDCDataset": ("_rgb_anon.png", "_gt_labelTrainIds.png"),
    "GTADataset": (".png", "_labelTrainIds.png"),
}
BY_BASE_NAME = ("CityscapesDataset", "ACDCDataset")


class Sizes(NamedTuple):
    """What a pipeline makes of a picture, pixels; the authors' are the defaults."""

    scale: tuple[int, int] = (2048, 1024)
    """Longest long and short side after resizing, which keeps the aspect."""
    crop: int = 1024
    cat_max_ratio: float = 0.75
    """Crops that one class fills beyond this are drawn again, ten times."""


DEFAULT_SIZES = Sizes()


class Sample(NamedTuple):
    """After the pipeline, padded to the crop; no label of a target."""

    image: UInt8
    label: UInt8 | None


def scan(folder: Path, suffix: str, below: str = "") -> Iterator[str]:
    """Relative paths of the files with a suffix, of any depth, unsorted, as mmcv 1.3.7 scans.

    Raises:
        FileNotFoundError: If there is no such folder, or a link leads nowhere.
        NotADirectoryError: If a file is hidden: what is no plain file is taken for a folder.
    """
    for entry in list(os.scandir(folder)):
        relative = f"{below}{entry.name}"
        if entry.name.startswith(".") or not entry.is_file():
            yield from scan(Path(entry.path), suffix, f"{relative}/")
        elif relative.endswith(suffix):
            yield relative


@dataclass(frozen=True)
class Pictures:
    """A data set as a config's entry describes it; other keys, like the pipeline, are ignored."""

    type: str
    image_folder: Path
    label_folder: Path
    paths: tuple[tuple[str, str], ...]
    """Of each picture and its label, relative to their folders."""
    labelled: bool
    sizes: Sizes

    @classmethod
    def of(
        cls, entry: Mapping[str, Any], *, labelled: bool = True, sizes: Sizes = DEFAULT_SIZES
    ) -> Pictures:
        """What a config's `data.train.source` or `data.train.target` says.

        Raises:
            KeyError: If a key is missing, or the type is unknown.
            FileNotFoundError: If there is no folder of images.
        """
        image_suffix, label_suffix = SUFFIXES[entry["type"]]
        images, labels = (Path(entry["data_root"], entry[name]) for name in ("img_dir", "ann_dir"))
        paths = tuple(
            (path, path.replace(image_suffix, label_suffix)) for path in scan(images, image_suffix)
        )
        return cls(entry["type"], images, labels, paths, labelled, sizes)

    def __len__(self) -> int:
        return len(self.paths)

    def whole(self, index: int) -> Sample:
        """A picture and its label as they stand on disk.

        Raises:
            FileNotFoundError: If the label is not where the suffix leads.
        """
        image_path, label_path = self.paths[index]
        image = cv2.imread(str(self.image_folder / image_path), cv2.IMREAD_COLOR)
        label = None
        if self.labelled:
            with Image.open(self.label_folder / label_path) as file:
                label = np.asarray(file).squeeze().astype(np.uint8)
        return Sample(image, label)

    def load(self, index: int, rng: np.random.Generator) -> Sample:
        """A picture and its label resized, cropped, perhaps flipped, and padded."""
        resized = self.resized(index)
        window = self._window(resized.image.shape[:2], resized.label, rng)
        return self.cut(resized, window, bool(rng.random() < 0.5))

    def resized(self, index: int) -> Sample:
        """A picture and its label, fitted into the scale."""
        image, label = self.whole(index)
        image = fitted(image, self.sizes.scale, cv2.INTER_LINEAR)
        if label is not None:
            label = fitted(label, self.sizes.scale, cv2.INTER_NEAREST)
        return Sample(image, label)

    def cut(self, resized: Sample, window: Window, flip: bool) -> Sample:
        """A window of a resized sample, perhaps flipped, and padded; black is before the mean."""
        columns = slice(None, None, -1 if flip else 1)
        image, label = resized
        crop = self.sizes.crop
        return Sample(
            padded(image[window][:, columns], crop, 0),
            None if label is None else padded(label[window][:, columns], crop, IGNORE),
        )

    def _window(
        self, shape: tuple[int, ...], label: UInt8 | None, rng: np.random.Generator
    ) -> Window:
        for _ in range(CROP_TRIES + 1):
            starts = [int(rng.integers(max(side - self.sizes.crop, 0) + 1)) for side in shape]
            window = window_at(starts[0], starts[1], self.sizes.crop)
            if label is None or varied(label[window], self.sizes.cat_max_ratio):
                break
        return window


def window_at(top: int, left: int, side: int) -> Window:
    """A square of a picture; it may reach beyond the right and the lower edge."""
    return slice(top, top + side), slice(left, left + side)


def fitted(plane: UInt8, scale: tuple[int, int], interpolation: int) -> UInt8:
    """A plane resized to fit into a long and a short side, whichever is met first."""
    height, width = plane.shape[:2]
    ratio = min(
        max(scale) / max(height, width),
        min(scale) / min(height, width),
    )
    size = int(width * ratio + 0.5), int(height * ratio + 0.5)
    return cv2.resize(plane, size, interpolation=interpolation)


def varied(label: UInt8, cat_max_ratio: float) -> bool:
    """Whether a crop has at least two classes, and none fills more than the ratio."""
    counts = np.bincount(label.ravel(), minlength=256)[:IGNORE]
    return np.count_nonzero(counts) > 1 and counts.max() / counts.sum() < cat_max_ratio


def padded(plane: UInt8, side: int, value: int) -> UInt8:
    """A plane filled up at the right and the bottom."""
    height, width = plane.shape[:2]
    more = ((0, side - height), (0, side - width)) + ((0, 0),) * (plane.ndim - 2)
    return np.pad(plane, more, constant_values=value)


class Drawn(NamedTuple):
    """A sample that rare-class sampling drew."""

    train_id: int
    file: str
    """Of `samples_with_class.json`, as the sampler names it."""
    index: int
    sample: Sample
    tries: int
    """Crops that were looked at."""
    enough: bool
    """Whether the crop shows more pixels of the class than are asked for."""


@dataclass(frozen=True)
class RareClasses:
    """Rare-class sampling of a source."""

    source: Pictures
    classes: tuple[int, ...]
    probabilities: NDArray[np.float64]
    files: Mapping[int, tuple[str, ...]]
    index_by_file: Mapping[str, int]
    min_pixels: int
    min_crop_ratio: float

    @classmethod
    def of(
        cls,
        root: Path,
        source: Pictures,
        *,
        min_pixels: int = 3000,
        class_temp: float = 0.01,
        min_crop_ratio: float = 2.0,
    ) -> RareClasses:
        """Read both files of statistics.

        Raises:
            AssertionError: If a class of the statistics has no file that passes; it ends a run.
            KeyError: If a class has no list of files.
        """
        pixels: Counter[int] = Counter()
        for row in json.loads((root / "sample_class_stats.json").read_text()):
            pixels.update({int(c): count for c, count in row.items() if c != "file"})
        classes = tuple(sorted(pixels, key=lambda c: pixels[c]))
        by_class = json.loads((root / "samples_with_class.json").read_text())
        files = {}
        for c in classes:
            rows = by_class[str(c)]
            files[c] = tuple(path.split("/")[-1] for path, count in rows if count > min_pixels)
            assert files[c], f"class {c} has no file with more than {min_pixels} pixels"
        names = (
            path.split("/")[-1] if source.type in BY_BASE_NAME else path for _, path in source.paths
        )
        index_by_file = {name: index for index, name in enumerate(names)}
        shares = np.array([pixels[c] for c in classes]) / sum(pixels.values())
        weights = np.exp((1 - shares - (1 - shares).max()) / class_temp)
        probabilities = weights / weights.sum()
        return cls(source, classes, probabilities, files, index_by_file, min_pixels, min_crop_ratio)

    def draw(self, rng: np.random.Generator) -> Drawn:
        """A class, a file with enough of it, and a crop of that file.

        Raises:
            KeyError: If the file is not among the source's.
        """
        c = int(rng.choice(self.classes, p=self.probabilities))
        file = str(rng.choice(self.files[c]))
        index = self.index_by_file[file]
        tries, enough = 0, False
        while not enough and tries <= CROP_TRIES:
            tries += 1
            sample = self.source.load(index, rng)
            shown = np.count_nonzero(sample.label == c)
            enough = bool(shown > self.min_pixels * self.min_crop_ratio)
        return Drawn(c, file, index, sample, tries, enough)


def mistaken(root: Path, source: Pictures) -> list[str]:
    """Files of the statistics for which a sampler would load another picture, or none."""
    rare = RareClasses.of(root, source)
    folder = source.label_folder.relative_to(root).as_posix()
    found = []
    for row in json.loads((root / "sample_class_stats.json").read_text()):
        index = rare.index_by_file.get(row["file"].split("/")[-1])
        if index is None or f"{folder}/{source.paths[index][1]}" != row["file"]:
            found.append(row["file"])
    return found
