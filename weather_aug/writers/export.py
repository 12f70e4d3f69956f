"""Export: render a plan to disk, survive being killed, give the same bytes however it went.

A sample's files are written whole (temporary file, sync, rename), then one line of the journal
commits it. The root files are made from the complete journal at the end, `export.json` last. The
same call continues interrupted work, repairs a damaged export, and does nothing to a finished one.
Machines that know nothing of each other may each render a shard first; see `shards`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing, suppress
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
from weather_aug.writers.lock import check_output, exclusive, shared
from weather_aug.writers.manifest import finish, is_finished_whole, usable_lines
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.remote import FsspecFolder, default_state
from weather_aug.writers.shards import Shard, ShardTarget, shard_journals
from weather_aug.writers.source import is_url
from weather_aug.writers.target import LocalFolder, Target

MAX_WORKERS = 1024
ENGINES = ("process", "inline", "ray")


@dataclass(frozen=True)
class ExportReport:
    """What an export holds now, and what this run did for it."""

    out: Path | str
    """Folder, or url as it was given."""
    finished: bool
    """Whether the export is whole; a shard that rendered its part did not finish it."""
    samples: int
    rendered: int
    """Samples made by this run; the others were there, whole."""
    damaged: int
    """Samples that an earlier run had committed, but whose files were no longer whole."""
    labelled: int
    bytes: int
    """Of all pictures and labels."""
    classes: tuple[int, ...]
    """Train ids in the class statistics, which only a finished export has."""
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
    shard: tuple[int, int] | None = None,
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
        shard: (i, n) for a machine that renders the i-th of n parts, 1 <= i <= n, and knows nothing
            of the others; all machines see `out`, and `state` where there is one. The same call
            without it finishes the export. What is finished is left as it is.
        state: For a url, local folder of lock, journal and root files, by which a second run
            continues; `.weather-aug-export/<digest of the url>` in the working directory if None.
            A run without it makes everything again, to the same bytes.
        storage_options: For a url, options of its fsspec file system, such as credentials.
        progress: Show a bar with rate and time left.
        verify: Compare digests, not only sizes, where the export is finished already.
        on_sample: Called with each newly committed sample's entry of the manifest, in the order of
            completion.

    Returns:
        What the export holds, or what the shard does.

    Raises:
        ArgumentError: If `workers` is not an integer in its range, `engine` or `shard` is none, or
            an argument is given that only another engine or output takes, or no shard.
        ConflictError: If another process exports to `out`, or to the same shard of it, it holds
            another job or other files, or a scene was rebuilt since it was planned.
        OutputError: If `out` lies inside a scene, is a file, or cannot be written.
        SceneError: If a scene cannot be read.
        IntegrityError: If items are missing because they killed their workers.
        MissingExtraError: If Ray, or the package of the url's file system, is not installed.
    """
    start_s = time.monotonic()
    if not 0 <= check_seed("workers", workers) <= MAX_WORKERS:
        raise ArgumentError(f"workers must be in [0, {MAX_WORKERS}], got {workers}")
    part = None if shard is None else Shard(*shard)
    if part is not None and verify:
        raise ArgumentError("verify is for the whole export, not for a shard of it")
    run = _engine(engine, workers, address)
    target = export_target(plan, out, state, storage_options)
    plan.check_scenes()
    task = _Task(plan, target, run, progress, on_sample)
    done = _whole(task, verify) if part is None else _part(task, part)
    return ExportReport(
        out=str(out) if isinstance(target, FsspecFolder) else target.state,
        finished=done.finished,
        samples=done.contents["samples"],
        rendered=done.rendered,
        damaged=done.damaged,
        labelled=done.contents["labelled"],
        bytes=done.contents["bytes"],
        classes=tuple(done.contents.get("classes", ())),
        dropped_classes=tuple(done.contents.get("dropped_classes", ())),
        seconds=time.monotonic() - start_s,
    )


@dataclass(frozen=True)
class _Task:
    """What to render, where to, by whom."""

    plan: ExportPlan
    target: LocalFolder | FsspecFolder
    run: Engine
    progress: bool
    on_sample: Callable[[dict[str, Any]], None] | None


@dataclass(frozen=True)
class _Done:
    """What came of a run."""

    contents: Mapping[str, Any]
    """Counts: of `export.json`, or the same of a shard."""
    rendered: int
    damaged: int
    finished: bool


def _whole(task: _Task, verify: bool) -> _Done:
    """An ordinary run: alone at the output, it continues, repairs and finishes what it finds."""
    plan, target = task.plan, task.target
    remote = target if isinstance(target, FsspecFolder) else None
    rendered = damaged = 0
    with exclusive(target.state):
        target.remove_leftovers(plan.layout)
        _check_place(plan, target)
        shards = _of_job(plan, shard_journals(target.state))
        contents = _finished(plan, target, verify, task.progress)
        if contents is None:
            if remote is not None:
                remote.begin(plan.job)
            with Journal(plan, target, others=shards, progress=task.progress) as journal:
                damaged = journal.damaged
                target.make_folders(plan.folders())
                rendered = _render(task, target, journal)
                contents = finish(plan, target, journal, progress=task.progress)
        if remote is not None:
            remote.publish([*contents["files"], layout.CONTENTS])
        with _files.reported(target.state):
            for name in (layout.QUARANTINE, layout.JOURNAL):
                (target.state / name).unlink(missing_ok=True)
    return _Done(contents, rendered, damaged, True)


def _part(task: _Task, shard: Shard) -> _Done:
    """A shard's run: it commits its samples to a journal of its own, and nothing else."""
    plan, target = task.plan, task.target
    done = _finished_before(plan, target)
    if done is not None:
        return done
    with shared(target.state, shard.state(target.state), str(shard)):
        done = _finished_before(plan, target)
        if done is None:
            return _rendered_part(task, shard)
    # It was finished just before the lock was held: what holding it made is removed by the last.
    with suppress(ConflictError), exclusive(target.state):
        pass
    return done


def _rendered_part(task: _Task, shard: Shard) -> _Done:
    """Render what the journals of an unfinished export miss of a shard."""
    plan, target = task.plan, task.target
    own = ShardTarget(target, shard.state(target.state))
    _check_place(plan, target)
    # The output's own journal says whose it is; the ordinary run fills it.
    _claim(plan, target.state)
    others = _of_job(plan, shard.foreign_journals(target.state))
    _claim(plan, own.state)
    if isinstance(target, FsspecFolder):
        target.begin(plan.job)
    with Journal(plan, own, shard, others, progress=task.progress) as journal:
        own.make_folders(plan.folders())
        rendered = _render(task, own, journal)
        counts = _counted(plan, shard, journal)
    with _files.reported(own.state):
        (own.state / layout.QUARANTINE).unlink(missing_ok=True)
    return _Done(counts, rendered, journal.damaged, False)


def _counted(plan: ExportPlan, shard: Shard, journal: Journal) -> dict[str, Any]:
    """Counts of a shard whose items are all committed, as `export.json` has them of all."""
    labelled = size = 0
    for unit in shard.units(plan):
        for item in plan.items_of(unit):
            parts = layout.parts_of(json.loads(journal.line(item)))
            labelled += "label" in parts
            size += sum(part["size"] for part in parts.values())
    return {"samples": journal.committed, "labelled": labelled, "bytes": size}


def _check_place(plan: ExportPlan, target: Target) -> None:
    """Refuse a url that is of another job, whatever its state says."""
    if isinstance(target, FsspecFolder) and (found := target.found_job()) is not None:
        _check_job(plan, found, target)


def _of_job(plan: ExportPlan, journals: Iterable[Path]) -> list[Path]:
    """Journals, refused if one is of another job."""
    checked = list(journals)
    for path in checked:
        _check_job(plan, job_of(path), path)
    return checked


def _claim(plan: ExportPlan, out: Path) -> None:
    """See to it that there is a journal of this job."""
    path = out / layout.JOURNAL
    if path.exists():
        _check_job(plan, job_of(path), out)
    else:
        write_journal(path, plan.job)


def _finished_before(plan: ExportPlan, target: LocalFolder | FsspecFolder) -> _Done | None:
    """A finished export as it stands, whole or damaged; None if it is not finished."""
    out: object = target.state
    if isinstance(target, FsspecFolder):
        out, contents = target, target.finished_contents()
    else:
        finished = (target.state / layout.CONTENTS).exists()
        contents = _contents(target.state) if finished else None
    if contents is None:
        return None
    _check_job(plan, contents["job"], out)
    return _Done(contents, 0, 0, True)


def _finished(
    plan: ExportPlan, target: Target, verify: bool, progress: bool
) -> dict[str, Any] | None:
    """`export.json` of a whole export, or None; then there is a journal of the job to continue."""
    out = target.state
    if not (out / layout.CONTENTS).exists():
        _claim(plan, out)
        return None
    contents = _contents(out)
    _check_job(plan, contents["job"], out)
    if is_finished_whole(target, contents, digests=verify, progress=progress):
        return contents
    write_journal(out / layout.JOURNAL, plan.job, usable_lines(out, contents))
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


def _render(task: _Task, target: Target, journal: Journal) -> int:
    """Render and commit what the journal misses; how many samples that were."""
    from tqdm.auto import tqdm

    if journal.committed == journal.items:
        return 0
    rendered = 0
    with (
        closing(task.run(task.plan, target, journal.missing())) as finished,
        tqdm(
            total=journal.items,
            initial=journal.committed,
            desc="export",
            unit="sample",
            disable=not task.progress,
        ) as bar,
    ):
        for unit, lines in finished:
            made = journal.append(unit, lines)
            rendered += len(made)
            bar.update(len(made))
            if task.on_sample is not None:
                for line in made:
                    task.on_sample(json.loads(line))
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


def export_target(
    plan: ExportPlan,
    out: str | Path,
    state: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
) -> LocalFolder | FsspecFolder:
    """The place `out`, checked for a plan; its local folder is made. See `export`.

    Raises:
        ArgumentError: If arguments for a url are given for a folder, or fsspec cannot use the url.
        ConflictError: If a folder holds something that is not an export.
        OutputError: If it lies inside a scene, is a file, or cannot be made.
        MissingExtraError: If the package of the url's file system is not installed.
    """
    scenes = [scene.path for scene in plan.scenes]
    place = state_of(out, state)
    if is_url(out):
        folder = FsspecFolder(str(out), place, options or {})
        return replace(folder, state=check_output(place, scenes))
    if options is not None:
        raise ArgumentError(f"storage_options are for a url; {printable(out, 200)} is a folder")
    return LocalFolder(check_output(place, scenes))


def state_of(out: str | Path, state: str | Path | None = None) -> Path:
    """Local folder of lock, journal and root files of an export to `out`; see `export`.

    Raises:
        ArgumentError: If `out` is a folder, which is its own state, and `state` is another.
    """
    if is_url(out):
        return Path(state or default_state(str(out)))
    if state is not None:
        raise ArgumentError(
            "state is for an output such as s3://bucket/name; "
            f"{printable(out, 200)} is a folder of this machine"
        )
    return Path(out)
