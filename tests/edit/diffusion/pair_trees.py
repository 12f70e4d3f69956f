"""Miniature data sets on disk, and lists of their pictures, for the tests of pairs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from weather_aug.edit.diffusion.leakage import digests_of
from weather_aug.edit.diffusion.pairs import Pair, PairList

SIZE = (24, 40)
"""Rows and columns of a picture."""


def picture(name: str, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W, 3); another one for another name."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return np.random.Generator(np.random.Philox(seed)).integers(0, 256, (*size, 3), np.uint8)


def save(path: Path, image: NDArray[np.uint8] | None = None) -> Path:
    """A picture as PNG or JPEG, by the suffix; one of its path if none is given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(str(path)) if image is None else image).save(path)
    return path


def save_label(path: Path, label: NDArray[np.uint8] | None = None) -> Path:
    """A label of four classes in blocks."""
    if label is None:
        label = np.kron(np.arange(4).reshape(2, 2), np.ones((SIZE[0] // 2, SIZE[1] // 2)))
    return save(path, np.asarray(label, np.uint8))


def pair_of(root: Path, source: str, target: str, **changes: Any) -> Pair:
    """A pair with the digests of its files, which it writes where they are missing."""
    for name in (source, target):
        if not (root / name).exists():
            save(root / name)
    digests = [digests_of(root / name) for name in (source, target)]
    fields: dict[str, Any] = {
        "source": source,
        "target": target,
        "source_label": None,
        "target_label": None,
        "style": "rain",
        "split": "train",
        "aligned": True,
        "source_sha256": digests[0].file,
        "target_sha256": digests[1].file,
        "source_pixels_sha256": digests[0].pixels,
        "target_pixels_sha256": digests[1].pixels,
    }
    return Pair(**fields | changes)


def list_of(root: Path, *pairs: Pair) -> PairList:
    return PairList("tiny", root, pairs)


def acdc_tree(root: Path) -> Path:
    """Two pictures in each weather and split, night too; labels but of the test pictures."""
    for weather in ("fog", "rain", "snow", "night"):
        for split in ("train", "val", "test"):
            for number in (1, 2):
                where, stem = (
                    f"{weather}/{split}",
                    f"GOPR0{number}/GOPR0{number}_frame_00001{number}",
                )
                save(root / "rgb_anon" / where / f"{stem}_rgb_anon.png")
                save(root / "rgb_anon" / f"{where}_ref" / f"{stem}_rgb_ref_anon.png")
                if split != "test":
                    save_label(root / "gt" / where / f"{stem}_gt_labelTrainIds.png")
                    save_label(root / "gt" / where / f"{stem}_gt_labelIds.png")
                    if number == 1:
                        stem = f"{where}_ref/{stem}_gt_ref_labelTrainIds.png"
                        save_label(root / "gt" / stem)
    return root


def muses_tree(root: Path) -> Path:
    """Two pictures of each weather, split and time of day."""
    for weather in ("clear", "fog", "rain", "snow"):
        for split in ("train", "val", "test"):
            for time in ("day", "night"):
                for number in (1, 2):
                    stem = f"{split}/{weather}/{time}/REC000{number}_frame_00000{number}"
                    save(root / "frame_camera" / f"{stem}_frame_camera.png")
                    if split != "test":
                        save_label(root / "gt_semantic" / f"{stem}_gt_labelTrainIds.png")
    return root


def bdd100k_tree(root: Path, labels: str = "labels/det_20/det_{split}.json") -> Path:
    """10K and 100K pictures, of which "both-…" stand in both; attributes of the 100K ones."""
    weathers = {"clear": "c", "partly cloudy": "p", "rainy": "r", "snowy": "s", "foggy": "f"}
    weathers |= {"overcast": "o", "undefined": "u"}
    for split in ("train", "val", "test"):
        entries = []
        for weather, letter in weathers.items():
            for time in ("daytime", "night", "dawn/dusk"):
                name = f"both-{split}-{letter}-{time.replace('/', '')}"
                for images in ("10k", "100k"):
                    save(root / "images" / images / split / f"{name}.jpg")
                if split != "test":
                    save_label(root / "labels/sem_seg/masks" / split / f"{name}.png")
                attributes = {"weather": weather, "timeofday": time, "scene": "city street"}
                entries.append({"name": f"{name}.jpg", "attributes": attributes, "labels": [1.5]})
        save(root / "images/10k" / split / f"unknown-{split}.jpg")
        if split != "test":
            path = root / labels.format(split=split)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(entries, indent=1))
    return root


def plain_tree(root: Path) -> Path:
    """Names a and b in all weathers, and one in rain of another place."""
    for split in ("train", "val"):
        for name in ("a", "b"):
            for weather in ("clear", "rain", "snow", "fog"):
                save(root / weather / split / f"{name}.png")
            save_label(root / "labels" / split / f"{name}.png")
        save(root / "rain" / split / "elsewhere.png")
    return root


def smooth(size: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3): red tells the row, green the column, in steps that survive resizing."""
    rows, columns = np.indices(size)
    red, green = 255 * rows / (size[0] - 1), 255 * columns / (size[1] - 1)
    return np.stack([red, green, np.zeros(size)], axis=-1).round().astype(np.uint8)


def stored_again(path: Path, other: Path) -> Path:
    """The same pixels in another PNG file."""
    other.parent.mkdir(parents=True, exist_ok=True)
    image = cv2.imread(str(path))
    cv2.imwrite(str(other), image, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    return other
