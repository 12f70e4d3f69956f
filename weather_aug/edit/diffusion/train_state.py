"""Training that was cut short goes on to the bit: its job, its log and its state on disk.

Convention:
    Work in progress stands in OUT + ".training"; OUT appears when the adapter is whole.

Files:
    training.json: the job: options, digests of pairs and base. Stays beside the adapter.
    losses.jsonl: one JSON object a step, and one each validation. Stays as well.
    samples/: sample grids. Stay as well.
    state.safetensors: all that is learnt, both moments of each optimiser, and in its metadata a
        JSON head with the number of steps done. Written beside its place and renamed into it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch

from weather_aug import _files, _lock
from weather_aug._extras import require
from weather_aug.edit.diffusion.adapter_files import CARD, WEIGHTS
from weather_aug.edit.diffusion.base import TO
from weather_aug.edit.diffusion.leakage import TRAINED_ON
from weather_aug.errors import ConflictError, DataError, OutputError, printable

WORK_SUFFIX = ".training"
LOCK_SUFFIX = ".training.lock"
JOB, LOG, STATE, SAMPLES = "training.json", "losses.jsonl", "state.safetensors", "samples"
HEAD = "head"
SHOWN = 4
"""Differences between two jobs that a message names."""

Tensors = dict[str, torch.Tensor]


class State(NamedTuple):
    """What a training needs to go on."""

    head: dict[str, Any]
    """JSON values, "step" among them: updates done."""
    tensors: Tensors


@contextmanager
def held(out: Path) -> Iterator[Path]:
    """Train into `out` alone; gives the folder of the work, which may not exist yet.

    Raises:
        ConflictError: If `out` exists, or another process trains into it.
        OutputError: If it cannot be written.
    """
    with _files.reported(out):
        out = out.resolve()
    if not out.name:
        raise ConflictError(f"{printable(out, 200)} exists; choose another folder")
    lock = out.with_name(out.name + LOCK_SUFFIX)
    with _lock.exclusive(lock, f"{printable(out, 200)} is being trained"):
        try:
            if out.exists():
                raise ConflictError(
                    f"{printable(out, 200)} exists; choose another folder, or remove it yourself"
                )
            yield out.with_name(out.name + WORK_SUFFIX)
        finally:
            with _files.reported(lock):
                lock.unlink(missing_ok=True)


def begin(work: Path, job: Mapping[str, Any], *, restart: bool) -> None:
    """Make the folder of a job, or see that the one which is there is of the same.

    A folder of another job in which no state was saved yet gives way: nothing is lost with it.

    Args:
        work: Of `held`.
        job: JSON values that the result depends on.
        restart: Remove what is there.

    Raises:
        ConflictError: If it is of another job; says what differs.
        OutputError: If it cannot be written.
    """
    with _files.reported(work):
        if work.exists() and not (work / JOB).exists():
            _refuse_strange(work)
        if restart or not ((work / STATE).exists() or is_finished(work)):
            # The job goes first: what is left of a removal that was cut short is nobody's.
            (work / JOB).unlink(missing_ok=True)
        if not (work / JOB).exists():
            if work.exists():
                shutil.rmtree(work)
            (work / SAMPLES).mkdir(parents=True)
            _files.write_whole(work / JOB, (json.dumps(job, indent=1) + "\n").encode())
            return
    old = _files.read_json(work / JOB)
    differences = list(_differences(old, json.loads(json.dumps(job)), ""))
    if differences:
        more = f" and {len(differences) - SHOWN} more" if len(differences) > SHOWN else ""
        raise ConflictError(
            f"{printable(work, 200)} is unfinished work of another training: "
            f"{'; '.join(differences[:SHOWN])}{more}; give the same command to finish it, or "
            "restart (--restart) to drop it"
        )


def save(work: Path, head: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a state in place of the last one; a crash leaves one of the two.

    Raises:
        OutputError: If it cannot be written.
    """
    safetensors = require("safetensors.torch", extra="edit", to=TO)
    path = work / STATE
    temporary = path.with_name(path.name + _files.TEMPORARY_SUFFIX)
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with _files.reported(path):
        try:
            safetensors.save_file(plain, temporary, metadata={HEAD: json.dumps(dict(head))})
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException as error:
            temporary.unlink(missing_ok=True)
            if type(error).__name__ == "SafetensorError":
                # Its own error for a full disk.
                raise OutputError(
                    f"cannot write {printable(path, 200)}: {printable(error, 200)}"
                ) from None
            raise
        _files.sync_folder(work)


def load(work: Path) -> State | None:
    """The last state; None where there is none.

    Raises:
        DataError: If the file is damaged.
    """
    safetensors = require("safetensors", extra="edit", to=TO)
    path = work / STATE
    if not path.exists():
        return None
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            head = json.loads(file.metadata()[HEAD])
            return State(head, {name: file.get_tensor(name) for name in file.keys()})
    except Exception as error:
        raise DataError(
            f"{printable(path, 200)} is damaged ({printable(error)}); restart (--restart) to train "
            "anew"
        ) from None


def publish(work: Path, out: Path) -> None:
    """Put a finished adapter in its place.

    Raises:
        OutputError: If it cannot be written.
    """
    with _files.reported(out):
        (work / STATE).unlink(missing_ok=True)
        for folder in (work, work / SAMPLES):
            _files.remove_temporaries(folder)
        work.rename(out)
        _files.sync_folder(out.parent)


def is_finished(work: Path) -> bool:
    """Whether the adapter is whole and only its folder's name is missing."""
    return (work / CARD).is_file()


def cut_log(work: Path, step: int) -> None:
    """Remove from the log what came after a step: it will come again."""
    path = work / LOG
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    kept = [line for line in lines if line.endswith(b"\n") and json.loads(line)["step"] <= step]
    _files.write_whole(path, b"".join(kept))


def add_to_log(work: Path, entry: Mapping[str, Any]) -> None:
    """Append an entry; `sync_log` makes it survive a power cut."""
    path = work / LOG
    with _files.reported(path), path.open("ab") as file:
        file.write(json.dumps(dict(entry)).encode() + b"\n")


def sync_log(work: Path) -> None:
    """See that all entries are on the disk."""
    path = work / LOG
    with _files.reported(path), path.open("rb") as file:
        os.fsync(file.fileno())


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The entries of a training's log."""
    return [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def optimiser_state(optimiser: Any, names: Sequence[str]) -> tuple[Tensors, dict[str, Any]]:
    """What an optimiser knows of its parameters.

    Args:
        optimiser: Of torch's kind, with one group of parameters.
        names: Of its parameters, in its order.

    Returns:
        Tensors by "name/key", and JSON values likewise; parameters that never had a gradient have
        none.
    """
    tensors: Tensors = {}
    values: dict[str, Any] = {}
    for index, known in optimiser.state_dict()["state"].items():
        for key, value in _flat(known, names[index]):
            if isinstance(value, torch.Tensor):
                tensors[key] = value
            else:
                values[key] = value
    return tensors, values


def load_optimiser(
    optimiser: Any,
    names: Sequence[str],
    tensors: Mapping[str, torch.Tensor],
    values: Mapping[str, Any],
) -> None:
    """Let an optimiser go on; see `optimiser_state`."""
    index_of = {name: index for index, name in enumerate(names)}
    known: dict[int, Any] = {}
    for key, value in {**tensors, **values}.items():
        name, *parts = key.split("/")
        place = known.setdefault(index_of[name], {})
        for part in parts[:-1]:
            place = place.setdefault(part, {})
        place[parts[-1]] = value
    optimiser.load_state_dict(
        {"state": known, "param_groups": optimiser.state_dict()["param_groups"]}
    )


def prefixed(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Any]:
    """The same under "prefix/name"."""
    return {f"{prefix}/{name}": value for name, value in tensors.items()}


def under(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Those under "prefix/", without it."""
    start = prefix + "/"
    return {
        name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)
    }


def _flat(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _flat(inner, f"{key}/{name}")
    else:
        yield key, value


def _differences(old: Any, new: Any, where: str) -> Iterator[str]:
    """What differs, such as "options.steps was 8, is 6"."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            inner = f"{where}.{key}" if where else key
            yield from _differences(old.get(key), new.get(key), inner)
    elif old != new:
        yield f"{where} was {printable(old)}, is {printable(new)}"


def _refuse_strange(work: Path) -> None:
    """Nothing that was not made here is removed."""
    ours = {JOB, LOG, STATE, STATE + _files.TEMPORARY_SUFFIX, SAMPLES, CARD, WEIGHTS, TRAINED_ON}
    _files.remove_temporaries(work)
    for path in work.iterdir():
        if path.name not in ours:
            raise ConflictError(
                f"{printable(work, 200)} exists and is no unfinished training (no {JOB}); move it "
                "elsewhere"
            )
