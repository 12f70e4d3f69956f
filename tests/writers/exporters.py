"""Exporters in processes of their own, which can be killed, and what is left of them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import weather_aug
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import engines, ray_engine
from weather_aug.writers import export as exporter
from weather_aug.writers.plan import ExportPlan, plan_export

HERE = Path(__file__).parent


def command_of(
    plan: ExportPlan, out: Path, *, workers: int, engine: str = "process", fault: str = ""
) -> list[str]:
    """A command that exports `plan`, which is of `POLICY` and seed 3.

    Args:
        plan: What to export.
        out: Where to.
        workers: Processes or actors; one process is one beside the exporter's, 0 is that itself.
        engine: As `export` takes it.
        fault: Of the workers, a name in `export_faults` or `ray_faults`.
    """
    arguments = [plan.scenes[0].path, out, plan.layout.name, plan.count, engine, workers, fault]
    return [sys.executable, str(HERE / "exporters.py"), *map(str, arguments)]


def environment() -> dict[str, str]:
    """In which an exporter finds this folder and the package."""
    folders = (HERE, Path(weather_aug.__file__).parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}


def started(plan: ExportPlan, out: Path, **how: Any) -> subprocess.Popen[bytes]:
    """An exporter in a session of its own; see `command_of`."""
    return subprocess.Popen(
        command_of(plan, out, **how),
        start_new_session=True,
        env=environment(),
        stderr=subprocess.PIPE,
    )


def committed_lines(out: Path) -> int:
    """Samples that the journal lists, whole or cut."""
    try:
        return max(0, (out / ".export" / "journal").read_bytes().count(b"\n") - 1)
    except FileNotFoundError:
        return 0


def wait_for_lines(process: subprocess.Popen[bytes], out: Path, lines: int) -> None:
    """Until so many samples are committed."""
    deadline = time.monotonic() + 60
    while committed_lines(out) < lines:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.001)


def live_members(session: int) -> list[int]:
    """Processes of a session that are not zombies."""
    members = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(its_session) == session and state != "Z":
            members.append(int(stat.parent.name))
    return members


def busy_s(seconds: float) -> float:
    """A limit in seconds, in proportion to how many processes wait for each core."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def assert_all_leave(session: int, since_s: float, *, within_s: float = 2.0) -> None:
    """Workers and the helper that multiprocessing starts end soon after their parent."""
    while left := live_members(session):
        if time.monotonic() - since_s > busy_s(within_s):
            os.killpg(session, signal.SIGKILL)
            pytest.fail(f"workers {left} outlive their parent")
        time.sleep(0.01)


@contextmanager
def ray_folder() -> Iterator[Path]:
    """A folder for RAY_TMPDIR; pytest's own are too long for the names of Ray's sockets."""
    folder = Path(tempfile.mkdtemp(prefix="ray-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _main(scene: str, out: str, layout: str, count: str, engine: str, *how: str) -> None:
    import export_faults
    from tiny_export import POLICY

    workers, fault = how
    # A shell starts what runs behind it deaf to interrupts; an exporter in a terminal is not.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if fault and engine == "ray":
        import ray_faults

        ray_engine.Renderer = getattr(ray_faults, fault)  # type: ignore[misc]
    elif fault:
        engines.work = getattr(export_faults, fault)
    if engine == "process" and workers == "1":
        # One worker is a process, too, not this one.
        exporter.run_inline = lambda *args: engines.run_processes(*args, workers=1)
    scenes = [WeatherScene.load(scene)]
    plan = plan_export(scenes, POLICY, count=int(count), seed=3, layout=layout)
    try:
        exporter.export(plan, Path(out), workers=int(workers), engine=engine)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    _main(*sys.argv[1:])
