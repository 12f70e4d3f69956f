"""Pair lists of data sets as they are unpacked: ACDC, MUSES, BDD100K, and plain folders.

Convention:
    A data set's own split is kept: pictures of "val" and "test" are listed and never trained on.
    Night is left out, for an editor that is taught weather must not learn darkness. Where a data
    set has no picture of the same place, a clear one of the same split is drawn, keyed by (seed,
    path of the picture in the weather), so that pairs do not depend on each other.

Source:
    Folders and file names as public loaders of the sets read them: ACDC with reference frames
    (`train_ref`, `_rgb_ref_anon`, `_gt_ref_labelTrainIds`), MUSES' development kit and loaders,
    BDD100K's format page and its issues 22 and 132 (weather is known of the 100K pictures only;
    some training pictures of one set are validation pictures of the other).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from weather_aug import _files
from weather_aug._keys import check_seed, key_of
from weather_aug.edit.background import STYLES
from weather_aug.edit.diffusion.leakage import PICTURE_SUFFIXES, digests_by_path
from weather_aug.edit.diffusion.pairs import SPLITS, Pair, PairList
from weather_aug.errors import ArgumentError, DataError, printable

BDD100K_WEATHER = {
    "clear": "clear",
    "partly cloudy": "clear",
    "rainy": "rain",
    "snowy": "snow",
    "foggy": "fog",
}
"""Style by BDD100K's attribute; "overcast" is neither clear nor a weather, "undefined" nothing."""
BDD100K_DAY = "daytime"
MAX_ENTRY_CHARS = 2**24

_READ_CHARS = 2**20
_SEPARATOR = re.compile(r"[\s,]*")


class _Draft(NamedTuple):
    """A pair before its pictures were read; paths relative to the root."""

    source: str
    target: str
    source_label: str | None
    target_label: str | None
    style: str
    split: str
    aligned: bool


def acdc_pairs(root: Path, *, progress: bool = False) -> PairList:
    """Pairs of ACDC: a picture in fog, rain or snow and its reference frame.

    Reference frames show nearly the same place in clear weather and are not aligned. Expects
    `rgb_anon/{weather}/{split}/SEQUENCE/NAME_rgb_anon.png` and
    `rgb_anon/{weather}/{split}_ref/SEQUENCE/NAME_rgb_ref_anon.png`; labels are taken from `gt`
    where they are (`NAME_gt_labelTrainIds.png`, `NAME_gt_ref_labelTrainIds.png`).

    Args:
        root: Folder that holds `rgb_anon`.
        progress: Show how far the reading of pictures is.

    Raises:
        DataError: If there is no such picture, a reference frame is missing, or a picture cannot
            be read.
    """
    drafts = []
    for style in STYLES:
        for split in SPLITS:
            folder = f"rgb_anon/{style}/{split}"
            for target in _files_in(root, f"{folder}/*", ("_rgb_anon.png",)):
                sequence, name = target.split("/")[-2:]
                stem = f"{sequence}/{name.removesuffix('_rgb_anon.png')}"
                source = f"{folder}_ref/{stem}_rgb_ref_anon.png"
                if not (root / source).is_file():
                    raise DataError(
                        f"{printable(root / source, 200)} is missing; unpack the reference frames "
                        "of ACDC (rgb_anon_trainvaltest) beside the others"
                    )
                clear_label = f"gt/{style}/{split}_ref/{stem}_gt_ref_labelTrainIds.png"
                label = f"gt/{style}/{split}/{stem}_gt_labelTrainIds.png"
                labels = _if_there(root, clear_label), _if_there(root, label)
                drafts.append(_Draft(source, target, *labels, style, split, False))
    return _read("acdc", root, drafts, progress, "rgb_anon/{fog,rain,snow}/train/*/*_rgb_anon.png")


def muses_pairs(root: Path, *, seed: int = 0, progress: bool = False) -> PairList:
    """Pairs of MUSES: a daytime picture in fog, rain or snow and a clear one drawn for it.

    Expects `frame_camera/{split}/{weather}/day/NAME_frame_camera.png`; labels are taken from
    `gt_semantic/{split}/{weather}/day/NAME_gt_labelTrainIds.png` where they are. MUSES' own
    reference frames are not used.

    Args:
        root: Folder that holds `frame_camera`.
        seed: Of the draws of clear pictures.
        progress: Show how far the reading of pictures is.

    Raises:
        ArgumentError: If the seed is none.
        DataError: If there is no such picture, a split has no clear one, or a picture cannot be
            read.
    """
    suffix = "_frame_camera.png"
    pictures = {
        (style, split): _files_in(root, f"frame_camera/{split}/{style}/day", (suffix,))
        for style in ("clear", *STYLES)
        for split in SPLITS
    }

    def label(picture: str) -> str | None:
        stem = picture.removeprefix("frame_camera/").removesuffix(suffix)
        return _if_there(root, f"gt_semantic/{stem}_gt_labelTrainIds.png")

    drafts = _unpaired(pictures, label, seed)
    return _read("muses", root, drafts, progress, "frame_camera/train/{fog,rain,snow}/day/*.png")


def bdd100k_pairs(
    root: Path, *, images: Literal["10k", "100k"] = "10k", seed: int = 0, progress: bool = False
) -> PairList:
    """Pairs of BDD100K: a daytime picture in rain, snow or fog and a clear one drawn for it.

    Weather and daytime are the attributes in `labels/det_20/det_{train,val}.json`, or in the older
    `labels/bdd100k_labels_images_{train,val}.json`; pictures without are left out. The sets of 10K
    and of 100K pictures overlap and are split differently: a training picture that the other set
    holds out, as far as it is unpacked, is left out.

    Args:
        root: Folder that holds `images` and `labels`.
        images: Which set: "10k", with labels (`labels/sem_seg/masks/{split}/NAME.png`) but the
            weather known of a part of its pictures only, or "100k", without labels.
        seed: Of the draws of clear pictures.
        progress: Show how far the reading of pictures is.

    Raises:
        ArgumentError: If the set is unknown or the seed is none.
        DataError: If there is no such picture, a split has no clear one, or an attribute file or a
            picture cannot be read.
    """
    if images not in ("10k", "100k"):
        raise ArgumentError(f"images must be 10k or 100k, got {printable(images)!r}")
    style_by_name = _bdd100k_styles(root)
    held_out = _bdd100k_held_out(root, "100k" if images == "10k" else "10k")
    pictures: dict[tuple[str, str], list[str]] = {}
    for split in SPLITS:
        for picture in _files_in(root, f"images/{images}/{split}", (".jpg",)):
            name = Path(picture).stem
            style = style_by_name.get(name)
            if style is not None and not (split == "train" and name in held_out):
                pictures.setdefault((style, split), []).append(picture)

    def label(picture: str) -> str | None:
        # The 10K masks belong to the 10K pictures; nobody says that a 100K picture of the same
        # name shows the same moment.
        stem = picture.removeprefix("images/10k/").removesuffix(".jpg")
        return _if_there(root, f"labels/sem_seg/masks/{stem}.png") if images == "10k" else None

    drafts = _unpaired(pictures, label, seed)
    wanted = f"images/{images}/train/*.jpg with the attribute rainy, snowy or foggy"
    return _read(f"bdd100k-{images}", root, drafts, progress, wanted)


def folder_pairs(root: Path, *, seed: int = 0, progress: bool = False) -> PairList:
    """Pairs of plain folders, `{clear,rain,snow,fog}/{train,val,test}/NAME.png` (or JPEG).

    A picture in the weather is paired with the clear one of the same split and name: these two are
    aligned and share the label `labels/{split}/NAME.png`. If there is none of that name, a clear
    one is drawn.

    Args:
        root: Folder that holds `clear`.
        seed: Of the draws of clear pictures.
        progress: Show how far the reading of pictures is.

    Raises:
        ArgumentError: If the seed is none.
        DataError: If there is no such picture, a split has no clear one, two pictures of a folder
            differ only in their suffix, or a picture cannot be read.
    """
    pictures = {
        (style, split): _files_in(root, f"{style}/{split}", PICTURE_SUFFIXES)
        for style in ("clear", *STYLES)
        for split in SPLITS
    }
    for found in pictures.values():
        _by_stem(root, found)
    clear = {split: _by_stem(root, pictures["clear", split]) for split in SPLITS}

    def label(picture: str) -> str | None:
        _, split, name = picture.split("/")
        return _if_there(root, f"labels/{split}/{Path(name).stem}.png")

    drafts = []
    for draft in _unpaired(pictures, label, seed):
        twin = clear[draft.split].get(Path(draft.target).stem)
        if twin is not None:
            draft = draft._replace(source=twin, source_label=label(twin), aligned=True)
        drafts.append(draft)
    return _read("folder", root, drafts, progress, "{rain,snow,fog}/train/NAME.png")


def _read(name: str, root: Path, drafts: list[_Draft], progress: bool, wanted: str) -> PairList:
    """The list, with the digests of all pictures."""
    if not drafts:
        raise DataError(f"{printable(root, 200)} holds no {wanted}; give the folder above it")
    paths = dict.fromkeys(path for draft in drafts for path in (draft.source, draft.target))
    files = [_files.file_inside(root, path) for path in paths]
    read = (digests for _, digests in digests_by_path(files, progress=progress))
    digests = dict(zip(paths, read, strict=True))
    pairs = (
        Pair(
            **draft._asdict(),
            source_sha256=digests[draft.source].file,
            target_sha256=digests[draft.target].file,
            source_pixels_sha256=digests[draft.source].pixels,
            target_pixels_sha256=digests[draft.target].pixels,
        )
        for draft in drafts
    )
    return PairList(name, root, tuple(pairs))


def _unpaired(
    pictures: dict[tuple[str, str], list[str]], label: Callable[[str], str | None], seed: int
) -> list[_Draft]:
    """Each picture in a weather with a clear one of its split, from pictures by (style, split)."""
    check_seed("seed", seed)
    drafts = []
    for style in STYLES:
        for split in SPLITS:
            clear = pictures.get(("clear", split), [])
            for target in pictures.get((style, split), []):
                if not clear:
                    raise DataError(
                        f"{printable(target, 200)} has no clear picture of the split {split} to be "
                        "paired with; unpack the clear pictures, too"
                    )
                source = clear[_number(target, seed) % len(clear)]
                drafts.append(
                    _Draft(source, target, label(source), label(target), style, split, False)
                )
    return drafts


def _number(path: str, seed: int) -> int:
    word = hashlib.sha256(path.encode("utf-8", "surrogateescape")).digest()[:8]
    return key_of("pairs.clear", seed, int.from_bytes(word, "little"))


def _files_in(root: Path, folder: str, suffixes: tuple[str, ...]) -> list[str]:
    """Paths, by name, of the files in a folder (a pattern) whose names end so."""
    found = (path for path in root.glob(f"{folder}/*") if path.name.lower().endswith(suffixes))
    return sorted(path.relative_to(root).as_posix() for path in found)


def _if_there(root: Path, path: str) -> str | None:
    if not (root / path).is_file():
        return None
    _files.file_inside(root, path)
    return path


def _by_stem(root: Path, paths: list[str]) -> dict[str, str]:
    found = {Path(path).stem: path for path in paths}
    for path in paths:
        if found[Path(path).stem] != path:
            raise DataError(
                f"{printable(root / path, 200)} and {printable(found[Path(path).stem])} differ in "
                "their suffix alone; keep one"
            )
    return found


def _bdd100k_styles(root: Path) -> dict[str, str]:
    """Style by name, of the pictures by day whose weather is one of `BDD100K_WEATHER`."""
    styles: dict[str, str] = {}
    read = 0
    for split in ("train", "val"):
        for path in _bdd100k_attributes(root, split):
            read += 1
            for entry in _entries(path):
                name, attributes = entry.get("name"), entry.get("attributes")
                if not isinstance(name, str) or not isinstance(attributes, dict):
                    raise DataError(
                        f"{printable(path, 200)} has an entry without name or attributes; is it "
                        "BDD100K's file of image labels?"
                    )
                weather, time = attributes.get("weather"), attributes.get("timeofday")
                if time == BDD100K_DAY and isinstance(weather, str) and weather in BDD100K_WEATHER:
                    styles[Path(name).stem] = BDD100K_WEATHER[weather]
    if not read:
        raise DataError(
            f"{printable(root, 200)} holds neither labels/det_20/det_train.json nor "
            "labels/bdd100k_labels_images_train.json; unpack the 2020 detection labels of BDD100K, "
            "which say the weather"
        )
    return styles


def _bdd100k_attributes(root: Path, split: str) -> list[Path]:
    names = (f"labels/det_20/det_{split}.json", f"labels/bdd100k_labels_images_{split}.json")
    return [root / name for name in names if (root / name).is_file()][:1]


def _bdd100k_held_out(root: Path, images: str) -> set[str]:
    """Names that a set of pictures does not train on, of what is unpacked."""
    folders = [f"images/{images}/{split}" for split in ("val", "test")]
    if images == "10k":
        folders.append("labels/sem_seg/masks/val")
    paths = (path for folder in folders for path in _files_in(root, folder, (".jpg", ".png")))
    names = {Path(path).stem for path in paths}
    if images == "100k":
        for path in _bdd100k_attributes(root, "val"):
            names.update(Path(str(entry.get("name"))).stem for entry in _entries(path))
    return names


def _entries(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a JSON file that is one array, one by one: such files have a gigabyte."""
    decoder = json.JSONDecoder()
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_READ_CHARS).lstrip()
            if not text.startswith("["):
                raise _no_array(path)
            at = 1
            while True:
                at = _between_entries(text, at)
                if text.startswith("]", at):
                    return
                try:
                    entry, at = decoder.raw_decode(text, at)
                except ValueError:
                    more = file.read(_READ_CHARS)
                    if not more or len(text) - at > MAX_ENTRY_CHARS:
                        raise _no_array(path) from None
                    text, at = text[at:] + more, 0
                    continue
                if not isinstance(entry, dict):
                    raise _no_array(path)
                yield entry
    except RecursionError:
        raise _no_array(path) from None
    except UnicodeDecodeError:
        raise DataError(f"{printable(path, 200)} is not UTF-8 text") from None
    except OSError as error:
        raise DataError(f"cannot read {printable(path, 200)}: {error.strerror}") from None


def _between_entries(text: str, at: int) -> int:
    found = _SEPARATOR.match(text, at)
    return at if found is None else found.end()


def _no_array(path: Path) -> DataError:
    return DataError(
        f"{printable(path, 200)} is not a whole JSON array of objects; unpack the labels again"
    )
