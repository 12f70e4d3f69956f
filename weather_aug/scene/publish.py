"""Where a scene comes to stand: one job at a time, and whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from weather_aug import _files, _lock
from weather_aug.errors import ConflictError, OutputError, printable
from weather_aug.scene.records import FRAMES
from weather_aug.scene.store import MANIFEST

UNFINISHED_SUFFIX = ".building"
LOCK_SUFFIX = ".building.lock"
REPLACED_SUFFIX = ".replaced"


def located(out: Path) -> Path:
    """`out` without links, so that one folder has one lock; refuse a place inside a scene."""
    try:
        place = out.resolve()
        scenes = [folder for folder in place.parents if _is_scene(folder)]
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"cannot write to {printable(out, 200)}: {error}") from None
    if not place.name:
        raise ConflictError(f"{printable(out, 200)} exists; choose another folder")
    if scenes:
        raise OutputError(
            f"{printable(out, 200)} lies inside the scene {printable(scenes[0], 200)}; choose a "
            "folder outside it"
        )
    return place


def _is_scene(folder: Path) -> bool:
    return (folder / MANIFEST).is_file() and (folder / FRAMES).is_dir()


def work_folder(out: Path) -> Path:
    """Where a scene stands until it is whole."""
    return _beside(out, UNFINISHED_SUFFIX)


def check_free(out: Path, overwrite: bool) -> None:
    """Refuse a place where something stands that is not to be replaced."""
    if not out.exists():
        return
    if not (out / MANIFEST).is_file():
        raise ConflictError(
            f"{printable(out, 200)} exists; choose another folder, or remove it yourself: it is no "
            f"scene (no {MANIFEST}), so overwrite does not replace it"
        )
    if not overwrite:
        raise ConflictError(
            f"{printable(out, 200)} exists; choose another folder, or pass overwrite to replace "
            "the scene"
        )


def _beside(out: Path, suffix: str) -> Path:
    return out.with_name(out.name + suffix)


@contextmanager
def held(out: Path) -> Iterator[None]:
    """Build `out` alone; the lock's file goes with the lock."""
    path = _beside(out, LOCK_SUFFIX)
    with _lock.exclusive(path, f"{printable(out, 200)} is being built"):
        try:
            yield
        finally:
            with _files.reported(path):
                path.unlink(missing_ok=True)


def publish(work: Path, out: Path, files: Collection[str]) -> None:
    """Put finished work in its place; whenever this is cut short, one whole scene is left.

    Args:
        work: Folder with the manifest and all that it lists; what else is there goes (journals,
            checkpoints, what was made of choices that are no longer asked for).
        out: Where it comes to stand.
        files: Relative paths that the manifest lists.
    """
    replaced = _beside(out, REPLACED_SUFFIX)
    with _files.reported(out):
        _remove_others(work, {MANIFEST, *files})
        try:
            if out.exists():
                out.rename(replaced)
                _files.sync_folder(out.parent)
            work.rename(out)
        finally:
            _files.sync_folder(out.parent)
            settle_replacement(out)


def _remove_others(folder: Path, files: Collection[str]) -> None:
    """Remove all but these files, and the folders that are empty then."""
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif path.relative_to(folder).as_posix() not in files:
            path.unlink()


def settle_replacement(out: Path) -> None:
    """Put back the scene of a replacement that was cut short, or remove it if a new one stands."""
    replaced = _beside(out, REPLACED_SUFFIX)
    if not replaced.exists():
        return
    with _files.reported(replaced):
        if not any(replaced.iterdir()):
            replaced.rmdir()
        elif not (replaced / MANIFEST).is_file():
            raise ConflictError(
                f"{printable(replaced, 200)} stands where a replaced scene is kept, but is none; "
                "move it elsewhere"
            )
        elif out.exists():
            _remove_scene(replaced)
        else:
            replaced.rename(out)
        _files.sync_folder(out.parent)


def _remove_scene(folder: Path) -> None:
    """Remove a scene, its manifest last: what is cut short is still known as a scene."""
    for entry in folder.iterdir():
        if entry.name == MANIFEST:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    (folder / MANIFEST).unlink(missing_ok=True)
    folder.rmdir()
