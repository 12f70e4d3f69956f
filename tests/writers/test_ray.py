"""Ray actors: the tree of any other engine, whoever dies, and a process left as it was."""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from export_faults import DEADLY_UNIT
from tiny_export import tree_of

from weather_aug import _files
from weather_aug.errors import (
    ArgumentError,
    ConflictError,
    IntegrityError,
    MissingExtraError,
    OutputError,
    WeatherAugError,
)
from weather_aug.writers import ray_engine
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.ray_engine import run_ray
from weather_aug.writers.target import LocalFolder

HERE = Path(__file__).parent
PATHS = os.pathsep.join([str(HERE), str(HERE.parents[1])])
"""Where actors find their faults, and this package."""

ENVIRONMENT = os.environ | {"PYTHONPATH": PATHS}
OPEN = ENVIRONMENT | {"RAY_AUTH_MODE": "disabled"}
QUIET: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def script(plan: ExportPlan, out: Path, *, fault: str = "Renderer", **options: Any) -> str:
    """A program that exports `plan`."""
    return f"""
from pathlib import Path
import ray_faults
from tiny_export import POLICY
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import ray_engine
from weather_aug.writers.export import export
from weather_aug.writers.plan import plan_export
ray_engine.Renderer = ray_faults.{fault}
scene = WeatherScene.load({str(plan.scenes[0].path)!r})
plan = plan_export([scene], POLICY, count=10, seed=3)
export(plan, Path({str(out)!r}), engine="ray", workers=2, **{options!r})
"""


@pytest.fixture(scope="session")
def ray() -> Any:
    return pytest.importorskip("ray", reason="ray is not installed")


@pytest.fixture(scope="module")
def standing(ray: Any) -> Iterator[Any]:
    """A Ray that the user started, for tests that need no start of their own."""
    environment = dict(os.environ)
    os.environ["PYTHONPATH"] = PATHS
    ray.init("local", num_cpus=2, include_dashboard=False, configure_logging=False)
    yield ray
    ray.shutdown()
    os.environ.clear()
    os.environ.update(environment)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Put a faulty actor in the place of `Renderer`."""
    import ray_faults

    def put(name: str) -> None:
        monkeypatch.setattr(ray_engine, "Renderer", getattr(ray_faults, name))

    return put


def committed(out: Path) -> set[int]:
    lines = (out / ".export" / "journal").read_text().splitlines()[1:]
    return {json.loads(line.partition(" ")[2])["item"] for line in lines}


def process_state() -> dict[str, Any]:
    return {
        "environment": dict(os.environ),
        "sigterm": signal.getsignal(signal.SIGTERM),
        "sigint": signal.getsignal(signal.SIGINT),
        "excepthook": sys.excepthook,
        "faulthandler": faulthandler.is_enabled(),
        "logging": logging.getLogger("ray").level,
    }


# Before `standing` is: here Ray is started and ended by the export.
@pytest.mark.slow
def test_two_actors_give_the_same_tree_and_leave_the_process_as_it_was(
    ray: Any, plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    assert not ray.is_initialized()
    before = process_state()
    assert export(plan, out, engine="ray", workers=2).rendered == 10
    assert tree_of(out) == expected_tree
    assert process_state() == before
    assert not ray.is_initialized()


@pytest.mark.slow
def test_the_exporter_may_be_killed(
    ray: Any, plan: ExportPlan, out: Path, expected_tree: dict[str, str], tmp_path: Path
) -> None:
    exporter = subprocess.Popen(
        [sys.executable, "-c", script(plan, out, fault="Slow")], env=ENVIRONMENT, **QUIET
    )
    deadline = time.monotonic() + 120
    while not (out / ".export/journal").exists() or len(committed(out)) < 3:
        assert exporter.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    exporter.kill()
    exporter.wait()
    rest = 10 - len(committed(out))
    # Waits for the orphans, which Ray ends.
    assert export(plan, out).rendered == rest
    tree = tree_of(out)
    assert tree == expected_tree
    time.sleep(3)
    assert tree_of(out) == tree


@pytest.mark.slow
def test_a_ray_that_stands_is_used_and_left(
    standing: Any, plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    # As many as there are cores, which stops Ray Data for ever.
    finished = run_ray(plan, target_of(out), iter([]), actors=2, cpus_per_actor=1.0)
    assert list(finished) == []
    export(plan, out, engine="ray", workers=4)
    assert tree_of(out) == expected_tree
    assert standing.is_initialized()
    assert signal.getsignal(signal.SIGTERM) == handler


@pytest.mark.slow
def test_actors_on_all_cores_do_not_hang(standing: Any, plan: ExportPlan, out: Path) -> None:
    finished = run_ray(plan, target_of(out, plan), iter([0, 1]), actors=2, cpus_per_actor=1.0)
    assert sorted(unit for unit, _ in finished) == [0, 1]


@pytest.mark.slow
def test_actors_that_find_no_room_end_the_run(
    standing: Any, plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_engine, "START_WAIT_S", 1.0)
    finished = run_ray(plan, target_of(out, plan), iter([0]), actors=1, cpus_per_actor=99.0)
    with pytest.raises(WeatherAugError, match=r"no Ray actor could start .* has 2 CPUs"):
        list(finished)


def target_of(out: Path, plan: ExportPlan | None = None) -> LocalFolder:
    target = LocalFolder(out)
    target.make_folders([".export", *(plan.folders() if plan else [])])
    return target


@pytest.mark.slow
def test_an_actor_that_dies_after_writing_costs_nothing(
    standing: Any, plan: ExportPlan, out: Path, faults: Any, expected_tree: dict[str, str]
) -> None:
    faults("DiesOnce")
    export(plan, out, engine="ray", workers=2)
    assert (out.parent / "died").exists()
    assert tree_of(out) == expected_tree


@pytest.mark.slow
def test_what_a_dead_actor_half_wrote_goes_with_the_run(
    standing: Any, plan: ExportPlan, out: Path, faults: Any, expected_tree: dict[str, str]
) -> None:
    faults("DiesWhileWriting")
    export(plan, out, engine="ray", workers=2)
    assert (out.parent / "died").read_text().endswith(_files.TEMPORARY_SUFFIX)
    assert tree_of(out) == expected_tree


@pytest.mark.slow
def test_an_item_that_kills_its_actors_is_quarantined(
    standing: Any, plan: ExportPlan, out: Path, faults: Any, expected_tree: dict[str, str]
) -> None:
    faults("DiesAlways")
    with pytest.raises(IntegrityError, match=rf"killed 3 .* missing: {DEADLY_UNIT} "):
        export(plan, out, engine="ray", workers=2)
    quarantined = json.loads((out / ".export" / "quarantine.jsonl").read_text())
    assert quarantined == {"item": DEADLY_UNIT, "recipe": plan.recipe(DEADLY_UNIT)}
    assert committed(out) == set(range(10)) - {DEADLY_UNIT}
    assert export(plan, out).rendered == 1
    assert tree_of(out) == expected_tree


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("FindsTheDiskFull", OutputError, "No space left on device"),
        ("NeverStarts", WeatherAugError, "Ray actors end while they start"),
        ("HasAnotherPackage", ConflictError, r"package_version is 0\.0\.0"),
        ("SeesAnotherDisk", OutputError, "does not see what the exporter wrote"),
    ],
)
def test_errors_arrive_as_they_were_raised_and_it_can_be_continued(
    standing: Any,
    plan: ExportPlan,
    out: Path,
    faults: Any,
    fault: str,
    error: type[Exception],
    message: str,
    expected_tree: dict[str, str],
) -> None:
    faults(fault)
    with pytest.raises(error, match=message) as caught:
        export(plan, out, engine="ray", workers=2)
    assert type(caught.value) is error
    export(plan, out)
    assert tree_of(out) == expected_tree


@pytest.mark.slow
def test_actors_write_to_a_url(
    standing: Any, plan: ExportPlan, tmp_path: Path, expected_tree: dict[str, str]
) -> None:
    out = tmp_path / "out"
    export(plan, f"file://{out}", state=tmp_path / "state", engine="ray", workers=2)
    assert tree_of(out) == expected_tree


@pytest.fixture
def cluster(ray: Any) -> Iterator[str]:
    """Address of a Ray that was started outside this process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [str(Path(sys.executable).parent / "ray"), "start", "--head", "--block"]
    options = ["--num-cpus=2", "--include-dashboard=false", "--disable-usage-stats"]
    head = subprocess.Popen(
        [*command, *options, "--node-ip-address=127.0.0.1", f"--port={port}"], env=OPEN, **QUIET
    )
    yield f"127.0.0.1:{port}"
    head.terminate()
    head.wait(30)


@pytest.mark.slow
def test_a_cluster_renders_the_same_tree_and_stays(
    cluster: str, plan: ExportPlan, out: Path, expected_tree: dict[str, str]
) -> None:
    for folder in (out, out.with_name("again")):
        deadline = time.monotonic() + 60
        program = [sys.executable, "-c", script(plan, folder, address=cluster)]
        while subprocess.run(program, env=OPEN, check=False, timeout=60, **QUIET).returncode:
            assert time.monotonic() < deadline
        assert tree_of(folder) == expected_tree


@pytest.mark.slow
def test_an_address_without_a_ray_is_named(ray: Any, plan: ExportPlan, out: Path) -> None:
    ray.shutdown()
    start_s = time.monotonic()
    with pytest.raises(WeatherAugError, match=r"no Ray could be reached at 127\.0\.0\.1:1:"):
        export(plan, out, engine="ray", address="127.0.0.1:1")
    assert time.monotonic() - start_s < 20


@pytest.mark.parametrize("bad", [{"actors": 0}, {"cpus_per_actor": 0.0}])
def test_senseless_numbers_are_refused(plan: ExportPlan, out: Path, bad: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError, match=next(iter(bad))):
        list(run_ray(plan, LocalFolder(out), iter([]), **bad))


def test_without_ray_one_sentence_says_how_to_get_it(
    plan: ExportPlan, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'weather-aug\[ray\]'"):
        export(plan, out, engine="ray")
