"""Export: render a plan to disk, survive being killed, give the same bytes however it went.

A sample's files are written whole (temporary file, sync, rename), then one line of the journal
commits it. The root files are made from the complete journal at the end, `export.json` last. The
same call continues interrupted work, repairs a damaged export, and does nothing to a finished one.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError, ConflictError, DataError, IntegrityError, printable
from weather_aug.writers import layout
from weather_aug.writers.engines import Engine, run_inline, run_processes
from weather_aug.writers.journal import Journal, job_of, write_journal
from weather_aug.writers.lock import check_output, exclusive
from weather_aug.writers.manifest import finish, is_finished_whole, usable_lines
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.remote import FsspecFolder, default_state
from weather_aug.writers.target import LocalFolder, Target

MAX_WORKERS = 1024
ENGINES = ("process", "inline", "ray")


@dataclass(frozen=True)
class ExportReport:
    """What an export holds now, and what this run did for it."""

    out: Path | str
    """Folder, or url as it was given."""
    samples: int
    rendered: int
    """Samples made by this run; the others were there, whole."""
    damaged: int
    """Samples that an earlier run had committed, but whose files were no longer whole."""
    labelled: int
    bytes: int
    """Of all pictures and labels."""
    classes: tuple[int, ...]
    """Train ids in the class statistics."""
    dropped_classes: tuple[int, ...]
    """Train ids that occur, but never with enough pixels for rare-class sampling."""
    seconds: float


def export(
    plan: ExportPlan,
    out: str | Path,
    *,
    workers: int = 1,
    engine: str = "process",
    address: str | None = None,
    state: str | Path | None = None,
    storage_options: Mapping[str, Any] | None = None,
    progress: bool = False,
    verify: bool = False,
    on_sample: Callable[[dict[str, Any]], None] | None = None,
) -> ExportReport:
    """Render all items of `plan` into the folder `out`.

    The tree that comes out depends on the plan alone: not on `workers` or `engine`, on the kind of
    place, on interruptions, or on damage repaired on the way.

    Args:
        plan: What to render; see `plan_export`.
        out: Folder to make or to continue; or a url that fsspec knows, such as
            "s3://bucket/rainy" (a string with "://"). Reading a url back to continue takes as long
            as the network needs for all its bytes.
        workers: Processes or Ray actors, at least 1; 1 process is this one, as is 0.
        engine: Who renders: "process", "inline" (this process, whatever `workers` is), or "ray".
        address: Ray cluster to render on, as `ray.init` takes it; without one, "ray" starts a Ray
            of its own on this machine. See `ray_engine.run_ray`.
        state: For a url, local folder of lock, journal and root files, by which a second run
            continues; `.weather-aug-export/<digest of the url>` in the working directory if None.
            A run without it makes everything again, to the same bytes.
        storage_options: For a url, options of its fsspec file system, such as credentials.
        progress: Show a bar with rate and time left.
        verify: Compare digests, not only sizes, where the export is finished already.
        on_sample: Called with each newly committed sample's entry of the manifest, in the order of
            completion.

    Raises:
        ArgumentError: If `workers` is not an integer in its range, `engine` is none, or an
            argument is given that only another engine or output takes.
        ConflictError: If another process exports to `out`, it holds another job or other files, or
            a scene was rebuilt since it was planned.
        OutputError: If `out` lies inside a scene, is a file, or cannot be written.
        SceneError: If a scene cannot be read.
        IntegrityError: If items are missing because they killed their workers.
        MissingExtraError: If Ray, or the package of the url's file system, is not installed.
    """
    start_s = time.monotonic()
    if not 0 <= check_seed("workers", workers) <= MAX_WORKERS:
        raise ArgumentError(f"workers must be in [0, {MAX_WORKERS}], got {workers}")
    run = _engine(engine, workers, address)
    target = _target(plan, out, state, storage_options)
    plan.check_scenes()
    rendered = damaged = 0
    with exclusive(target.state):
        target.remove_leftovers(plan.layout)
        remote = target if isinstance(target, FsspecFolder) else None
        if remote is not None and (found := remote.found_job()) is not None:
            _check_job(plan, found, remote)
        contents = _finished(plan, target, verify, progress)
        if contents is None:
            if remote is not None:
                remote.begin(plan.job)
            with Journal(plan, target, progress=progress) as journal:
                damaged = journal.damaged
                target.make_folders(plan.folders())
                rendered = _render(plan, target, journal, run, progress, on_sample)
                contents = finish(plan, target, journal, progress=progress)
        if remote is not None:
            remote.publish([*contents["files"], layout.CONTENTS])
        with _files.reported(target.state):
            for name in (layout.QUARANTINE, layout.JOURNAL):
                (target.state / name).unlink(missing_ok=True)
    return ExportReport(
        out=str(out) if remote is not None else target.state,
        samples=contents["samples"],
        rendered=rendered,
        damaged=damaged,
        labelled=contents["labelled"],
        bytes=contents["bytes"],
        classes=tuple(contents["classes"]),
        dropped_classes=tuple(contents["dropped_classes"]),
        seconds=time.monotonic() - start_s,
    )


def _finished(
    plan: ExportPlan, target: Target, verify: bool, progress: bool
) -> dict[str, Any] | None:
    """`export.json` of a whole export, or None; then there is a journal of the job to continue."""
    out = target.state
    path = out / layout.JOURNAL
    if not (out / layout.CONTENTS).exists():
        if path.exists():
            _check_job(plan, job_of(path), out)
        else:
            write_journal(path, plan.job)
        return None
    contents = _contents(out)
    _check_job(plan, contents["job"], out)
    if is_finished_whole(target, contents, digests=verify, progress=progress):
        return contents
    write_journal(path, plan.job, usable_lines(out, contents))
    with _files.reported(out):
        (out / layout.CONTENTS).unlink()
        _files.sync_folder(out)
    return None


def _contents(out: Path) -> dict[str, Any]:
    try:
        with _files.reported(out / layout.CONTENTS):
            return layout.read_contents(out)
    except (DataError, IntegrityError) as error:
        raise IntegrityError(
            f"{error}; the job of this export is unknown, so it cannot be repaired: remove the "
            "folder and export again"
        ) from None


def _check_job(plan: ExportPlan, found: Any, out: object) -> None:
    """Refuse an output that belongs to another job; name the first field that differs."""
    found = found if isinstance(found, dict) else {}
    for name in dict.fromkeys([*plan.job, *found]):
        theirs, ours = (_text(job.get(name)) for job in (found, plan.job))
        if theirs != ours:
            raise ConflictError(
                f"{printable(out, 200)} belongs to another job: its {name} is "
                f"{printable(theirs, 120)}, this job's is {printable(ours, 120)}; choose another "
                "folder, or remove this one"
            )


def _text(value: Any) -> str:
    """JSON text, by which what was read back is compared with what is planned."""
    return json.dumps(value)


def _render(
    plan: ExportPlan,
    target: Target,
    journal: Journal,
    run: Engine,
    progress: bool,
    on_sample: Callable[[dict[str, Any]], None] | None,
) -> int:
    """Render and commit what the journal misses; how many samples that were."""
    from tqdm.auto import tqdm

    if journal.committed == plan.count:
        return 0
    rendered = 0
    with (
        closing(run(plan, target, journal.missing())) as finished,
        tqdm(
            total=plan.count,
            initial=journal.committed,
            desc="export",
            unit="sample",
            disable=not progress,
        ) as bar,
    ):
        for unit, lines in finished:
            made = journal.append(unit, lines)
            rendered += len(made)
            bar.update(len(made))
            if on_sample is not None:
                for line in made:
                    on_sample(json.loads(line))
    return rendered


def _engine(name: str, workers: int, address: str | None) -> Engine:
    if name not in ENGINES:
        raise ArgumentError(f"engine {printable(name)!r} is not one of {', '.join(ENGINES)}")
    if name == "ray":
        from weather_aug.writers.ray_engine import run_ray

        return partial(run_ray, actors=workers, address=address)
    if address is not None:
        raise ArgumentError(f"address is of a Ray cluster; engine {name!r} takes none")
    if name == "inline" or workers <= 1:
        return run_inline
    return partial(run_processes, workers=workers)


def _target(
    plan: ExportPlan, out: str | Path, state: str | Path | None, options: Mapping[str, Any] | None
) -> Target:
    """The place `out`; its local folder is made."""
    scenes = [scene.path for scene in plan.scenes]
    if isinstance(out, str) and "://" in out:
        place = FsspecFolder(out, Path(state or default_state(out)), options or {})
        return replace(place, state=check_output(place.state, scenes))
    if state is not None or options is not None:
        raise ArgumentError(
            "state and storage_options are for an output such as s3://bucket/name; "
            f"{printable(out, 200)} is a folder of this machine"
        )
    return LocalFolder(check_output(Path(out), scenes))
