"""Precompute a clip into a scene folder; interrupted work is taken up where it stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.clip.types import Clip, Frame, FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.edit.background import STYLES, BackgroundEditor
from weather_aug.edit.physical.mirror_seen import Seen
from weather_aug.edit.physical.site import Site
from weather_aug.errors import ArgumentError, ClipError, DataError, printable
from weather_aug.scene import publish, store
from weather_aug.scene.backgrounds import Editing, editing_of, write_backgrounds
from weather_aug.scene.journal import Round, digest_record, make_all
from weather_aug.scene.layers import PARTS as LAYER_PARTS
from weather_aug.scene.layers import encode_layers, layers_seen
from weather_aug.scene.policy import TYPES
from weather_aug.scene.reconstruct import Built, Wanted, write_geometry, write_styles
from weather_aug.scene.records import (
    FRAMES,
    SHELTER,
    check_name,
    parse_frame,
    part_of,
    part_path,
    streets,
)
from weather_aug.scene.route import street_axes
from weather_aug.scene.shelter import View, shelter_of
from weather_aug.scene.styles import PHYSICAL

if TYPE_CHECKING:
    from weather_aug.gaussians.types import Reconstruction

JOURNAL, LAYERS_JOURNAL = "journal.jsonl", "layers.jsonl"

Float64 = NDArray[np.float64]
Entries = list[dict[str, Any]]
"""What the manifest says of frames, as JSON values."""
Files = dict[str, Any]
"""Sizes and digests by relative path."""


def build(
    clip: Clip,
    out: Path,
    editor: str | BackgroundEditor,
    weathers: Sequence[str] | None,
    *,
    progress: bool,
    overwrite: bool,
    wanted: Wanted | None = None,
    editor_options: Any = None,
) -> None:
    """Write the scene of `clip` to the folder `out`, which appears only when it is complete.

    There are up to three rounds over the frames: the first stores them; the second, when the way
    driven is known, what the physical editor sees in each; the third, of another editor, their
    backgrounds; see `scene.backgrounds`. Where Gaussians are wanted, their geometry comes after the
    first, so that the editor sees what the road mirrors, and their styles, which need the
    backgrounds, after all; see `scene.reconstruct`. Work in progress stands in `out` + ".building"
    with a journal of each round; the same call again continues it, after making the first finished
    step once more to see that the clip and the editor are still the same. Bad input removes it:
    there is nothing to continue. A scene that is replaced stands in `out` + ".replaced" until the
    new one is in its place.

    Args:
        clip: The drive; every frame needs depth.
        out: Folder to make, and its parents.
        editor: How backgrounds get their weather; "physical" does it while rendering, all others
            (one of `edit.editors.EDITORS`, or a `BackgroundEditor`) store them in the scene.
        weathers: Types the scene is meant for; all that the editor knows if None. A note in the
            manifest for readers where the editor is physical: it prepares for none. Other editors
            store a background of each frame for each.
        progress: Show a bar for each round.
        overwrite: Replace `out` if it is a scene already.
        wanted: What to reconstruct, None for no Gaussians.
        editor_options: Of an editor that is named; see `edit.editors.editor_of`.

    Raises:
        ArgumentError: If the editor or a weather is unknown, the editor cannot edit to a weather,
            or does not return pictures.
        ConflictError: If `out` exists, or another process builds it.
        ClipError: If the clip is empty or too long, a frame has no depth, or unrelated pictures
            are to be reconstructed.
        SceneError: If a name cannot stand in a file name, or a frame cannot be stored.
        OutputError: If the output lies inside another scene, or cannot be written.
    """
    _check_weathers(weathers)
    _check_clip(clip)
    if wanted is not None and not _is_drive(clip):
        raise ClipError(
            f"clip {clip.name} is of unrelated pictures; only a drive can be reconstructed"
        )
    out = publish.located(out)
    with publish.held(out):
        publish.settle_replacement(out)
        # Before networks are read, which takes a while.
        publish.check_free(out, overwrite)
        editing = editing_of(editor, editor_options, weathers, clip)
        if weathers is None:
            weathers = STYLES if editing is None else editing.styles
        work = publish.work_folder(out)
        try:
            content = _content(clip, work, editing, weathers, progress, wanted)
        except DataError:
            shutil.rmtree(work, ignore_errors=True)
            raise
        _files.write_whole(work / store.MANIFEST, store.manifest_bytes(content))
        publish.publish(work, out, content["files"])


def _content(
    clip: Clip,
    work: Path,
    editing: Editing | None,
    weathers: Sequence[str],
    progress: bool,
    wanted: Wanted | None,
) -> dict[str, Any]:
    """Write all frames into `work`; what the manifest says of them."""
    entries, files = _write_frames(clip, work, progress)
    axes_world = street_axes(entries, clip.up_world)
    shelter = None
    airlight = None
    is_drive = _is_drive(clip)
    if is_drive:
        airlight = np.median([entry["light"]["airlight"] for entry in entries], axis=0).tolist()
        shelter, file = _write_shelter(work, entries, axes_world)
        files |= file
    content = {
        "name": clip.name,
        "editor": PHYSICAL if editing is None else editing.editor.name,
        "weathers": list(weathers),
        "axes_world": axes_world.tolist(),
        "airlight": airlight,
        "shelter": shelter,
        "frames": entries,
        "files": files,
    }
    built = None
    if wanted is not None:
        # Before the layers: with Gaussians they know what the road mirrors.
        manifest = store.manifest_of(content)
        built = write_geometry(work, manifest, files, wanted, progress=progress)
    entries, looks = _write_layers(work, entries, axes_world, is_drive, progress, built)
    content |= {"frames": entries, "files": files | looks}
    # What is not asked for leaves no trace in the manifest.
    if editing is not None:
        manifest = store.manifest_of(content)
        needs = [is_drive, entries, content["files"]]
        entry, files = write_backgrounds(
            work, manifest, needs, editing, clip.cameras, progress=progress
        )
        content |= {"backgrounds": entry, "files": content["files"] | files}
    if wanted is None or built is None:
        return content
    manifest = store.manifest_of(content)
    built = write_styles(work, manifest, content["files"], built, wanted, progress=progress)
    return content | {"reconstruction": built.entry, "files": content["files"] | built.files}


def _is_drive(clip: Clip) -> bool:
    return bool(getattr(clip, "is_drive", True))


def _write_shelter(
    work: Path, entries: Entries, axes_world: Float64
) -> tuple[dict[str, Any] | None, Files]:
    """Map the covers that the finished frames show; the manifest's entry, and the file's digest.

    From the stored frames, so that a build that is continued makes the same map.
    """
    # A build that was cut short after the map may have shown covers that are gone now.
    with _files.reported(work):
        (work / SHELTER).unlink(missing_ok=True)
    records = [parse_frame(entry) for entry in entries]
    views = (View(record.camera, *store.read_surfaces(work, record)) for record in records)
    shelter = shelter_of(views, axes_world)
    if shelter is None:
        return None, {}
    record, data = store.encode_shelter(shelter)
    _files.write_whole(work / SHELTER, data)
    return record, {SHELTER: digest_record(data)}


def _check_weathers(weathers: Sequence[str] | None) -> None:
    unknown = sorted(set(weathers or ()) - set(TYPES))
    if unknown:
        raise ArgumentError(f"weather {printable(unknown[0])!r} is not one of {', '.join(TYPES)}")


def _check_clip(clip: Clip) -> None:
    keys = clip.keys
    name = check_name("clip name", clip.name)
    if not keys:
        raise ClipError(f"clip {name} has no frames; there is nothing to build")
    if len(keys) > store.MAX_FRAMES:
        raise ClipError(
            f"clip {name} has {len(keys)} frames, a scene holds {store.MAX_FRAMES} at the most; "
            "build it in parts"
        )
    if len(set(keys)) < len(keys):
        raise ClipError(f"clip {name} has a frame twice; its keys must differ")
    for camera in dict.fromkeys(key.camera for key in keys):
        check_name("camera name", camera)
    length = float(np.linalg.norm(np.asarray(clip.up_world, np.float64)))
    if not abs(length - 1) < 1e-3:
        raise ClipError(f"clip {name}: up_world must be a unit vector, its length is {length:g}")


def _write_frames(clip: Clip, work: Path, progress: bool) -> tuple[Entries, Files]:
    """Write all frames; entries for the manifest in the clip's order, and each file's digest."""

    def made(key: FrameKey) -> tuple[dict[str, Any], dict[str, bytes]]:
        return _stored(clip.frame(key), clip.up_world)

    head = {
        "version": store.VERSION,
        "name": clip.name,
        "keys": _digest_of([str(key) for key in clip.keys]),
        "up_world": np.asarray(clip.up_world).tolist(),
    }
    task = Round("build", JOURNAL, head, clip.keys, made, _emptied)
    done = make_all(task, work, progress)
    start_s = None
    entries: Entries = []
    files: Files = {}
    for key in clip.keys:
        entry = done[str(key)]["entry"]
        # Times of day lose the precision that motion needs; a clip starts at 0.
        start_s = entry["time_s"] if start_s is None else start_s
        entries.append(entry | {"time_s": entry["time_s"] - start_s})
        files |= done[str(key)]["files"]
    return entries, files


def _stored(frame: Frame, up_world: Float64) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The manifest's entry for a frame, and bytes by relative path."""
    if frame.depth_m is None:
        raise ClipError(
            f"frame {frame.key} has no depth and no label to take a geometric prior from; give the "
            "clip a depth folder or labels"
        )
    axes = np.zeros((3, 3))
    axes[2] = up_world
    parts = store.encode_frame(frame)
    entry = store.frame_record(frame, ambience_of(frame, axes))
    return entry, {part_path(frame.key, part): data for part, data in parts.items()}


def _emptied(work: Path) -> None:
    if work.exists():
        shutil.rmtree(work)
    (work / FRAMES).mkdir(parents=True)


def _write_layers(
    work: Path,
    entries: Entries,
    axes_world: Float64,
    is_drive: bool,
    progress: bool,
    built: Built | None,
) -> tuple[Entries, Files]:
    """Write what the editor knows of each finished frame; the entries with it, and the digests.

    From the stored frames, so that it is what rendering them would find out.
    """
    mirrored = None if built is None else partial(_seen_in_road, built.scene)
    records = [parse_frame(entry) for entry in entries]
    street_by_camera = streets(records, axes_world, is_drive=is_drive)
    by_key = {record.key: record for record in records}

    def made(key: FrameKey) -> tuple[dict[str, Any], dict[str, bytes]]:
        frame = store.read_frame(work, by_key[key])
        entry, parts = encode_layers(
            frame, layers_seen(frame, street_by_camera[key.camera], mirrored)
        )
        return entry, {part_path(key, part): data for part, data in parts.items()}

    gaussians = None if built is None else built.digest
    head = {"layers": _digest_of([is_drive, axes_world.tolist(), entries, gaussians])}
    keys = tuple(by_key)
    done = make_all(Round("layers", LAYERS_JOURNAL, head, keys, made, _bare), work, progress)
    with_layers: Entries = []
    files: Files = {}
    for key, entry in zip(keys, entries, strict=True):
        record = done[str(key)]
        paths = {part_of(relative): relative for relative in record["files"]}
        with_layers.append(entry | {"layers": record["entry"], "files": entry["files"] | paths})
        files |= record["files"]
    return with_layers, files


def _seen_in_road(scene: Reconstruction, site: Site) -> Seen:
    # Loads torch.
    from weather_aug.scene.geometry import seen_in_road

    return seen_in_road(scene, site)


def _bare(work: Path) -> None:
    """Remove layers that belong to other frames or to another way of looking at them."""
    for part in LAYER_PARTS:
        for path in (work / FRAMES).glob(f"*.{part}.npy*"):
            path.unlink()


def _digest_of(value: Any) -> str:
    return _files.sha256_of(json.dumps(value).encode())
