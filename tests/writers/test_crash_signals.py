"""The real command among others: stopped by signals, and met by a second one."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from exporters import assert_all_leave, busy_s, environment, live_members, wait_for_lines
from planted_calls import assert_committed_verifies, assert_nothing_partial
from tiny_export import tree_of

from weather_aug.cli import main
from weather_aug.scene.scene import WeatherScene

COUNT = 300
START = """
import signal
from weather_aug.cli import main
# A shell starts what runs behind it deaf to interrupts; a command in a terminal is not.
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


def words(scene: WeatherScene, out: Path, workers: int) -> list[str]:
    where = f"export {scene.path} --out {out} --count {COUNT} --quiet --workers {workers}"
    return where.split()


@pytest.fixture(scope="module")
def tree(scene: WeatherScene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("plain") / "data"
    main(words(scene, out, 1))
    return tree_of(out)


def begun(scene: WeatherScene, out: Path, workers: int, lines: int = 5) -> subprocess.Popen[bytes]:
    """A command in a session of its own that has committed so many samples."""
    process = subprocess.Popen(
        [sys.executable, "-c", START, *words(scene, out, workers)],
        start_new_session=True,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    wait_for_lines(process, out, lines)
    return process


@pytest.mark.parametrize(
    ("kind", "workers", "to_group"),
    [
        (signal.SIGINT, 1, True),
        (signal.SIGINT, 2, True),
        (signal.SIGINT, 2, False),
        (signal.SIGTERM, 2, False),
    ],
)
def test_a_signal_ends_it_soon_and_it_continues(
    scene: WeatherScene,
    tree: dict[str, str],
    tmp_path: Path,
    kind: signal.Signals,
    workers: int,
    to_group: bool,
) -> None:
    """From a terminal, to all processes of the command; from a supervisor, to the first one."""
    out = tmp_path / "data"
    process = begun(scene, out, workers)
    (os.killpg if to_group else os.kill)(process.pid, kind)
    _, errors = process.communicate(timeout=busy_s(5))
    if kind == signal.SIGINT:
        assert process.returncode == 130
        assert errors == b"weather-aug: interrupted; run the same command again to continue\n"
    else:
        # What a shell tells as 143.
        assert process.returncode == -signal.SIGTERM
        assert errors == b""
    assert_all_leave(process.pid, time.monotonic())
    assert_committed_verifies(out)
    assert_nothing_partial(out, tree)
    main(words(scene, out, 1))
    assert tree_of(out) == tree


@pytest.mark.parametrize("pause_s", [0.0, 0.01])
def test_a_second_interrupt_ends_it_at_once(
    scene: WeatherScene, tree: dict[str, str], tmp_path: Path, pause_s: float
) -> None:
    out = tmp_path / "data"
    process = begun(scene, out, 2)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(pause_s)
    if live_members(process.pid):
        os.killpg(process.pid, signal.SIGINT)
    second_s = time.monotonic()
    process.communicate(timeout=busy_s(5))
    assert time.monotonic() - second_s < busy_s(1)
    # Ended by itself, or, if it was on its last line, by the signal.
    assert process.returncode in (130, -signal.SIGINT)
    assert_all_leave(process.pid, second_s)
    assert_nothing_partial(out, tree)
    main(words(scene, out, 1))
    assert tree_of(out) == tree


def test_of_two_commands_one_works_and_the_other_names_it(
    scene: WeatherScene, tree: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "data"
    holder = begun(scene, out, 2)
    os.killpg(holder.pid, signal.SIGSTOP)
    start_s = time.monotonic()
    other = subprocess.run(
        [sys.executable, "-c", START, *words(scene, out, 1)],
        env=environment(),
        capture_output=True,
        check=False,
        timeout=busy_s(10),
    )
    assert time.monotonic() - start_s < busy_s(5)
    assert other.returncode == 5
    (line,) = other.stderr.decode().splitlines()
    assert f"by process {holder.pid} on {socket.gethostname()}" in line
    assert_nothing_partial(out, tree)
    # Its lock goes with it, whatever it was doing.
    os.killpg(holder.pid, signal.SIGKILL)
    holder.communicate(timeout=busy_s(5))
    main(words(scene, out, 1))
    assert tree_of(out) == tree
