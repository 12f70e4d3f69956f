"""Importing the package costs nothing; its names come when they are used."""

from __future__ import annotations

import importlib
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

import weather_aug

HEAVY = ("torch", "cv2", "numba", "scipy", "albumentations", "matplotlib", "PIL", "tqdm", "tyro")
RUNS = 5
MOST_TIMES_NUMPY = 2.0

_TIMED = """
import time
start = time.perf_counter()
import {module}
print(time.perf_counter() - start)
"""


def _fresh(code: str) -> str:
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return run.stdout


def _loaded_by(statement: str) -> set[str]:
    return set(_fresh(f"{statement}\nimport sys\nprint(*sys.modules, sep='\\n')").splitlines())


def test_import_loads_nothing_heavy() -> None:
    assert not _loaded_by("import weather_aug") & set(HEAVY)


def test_a_heavy_import_would_be_seen() -> None:
    """The check above finds what a name's room imports, so it can fail."""
    assert "cv2" in _loaded_by("import weather_aug; weather_aug.open_clip")


def test_a_weather_needs_nothing_heavy() -> None:
    """Plans and configurations are made where no picture is."""
    loaded = _loaded_by("import weather_aug; weather_aug.Weather.rain('heavy').to_json()")
    assert not loaded & {*HEAVY, "numpy"}


def test_import_is_at_most_twice_as_slow_as_numpy() -> None:
    times_s: dict[str, list[float]] = {"numpy": [], "weather_aug": []}
    for _ in range(RUNS):
        for module, found in times_s.items():
            found.append(float(_fresh(_TIMED.format(module=module))))
    ours, theirs = (statistics.median(times_s[name]) for name in ("weather_aug", "numpy"))
    assert ours <= MOST_TIMES_NUMPY * theirs, f"{ours:.3f} s against numpy's {theirs:.3f} s"


@pytest.mark.parametrize("name", weather_aug.__all__)
def test_public_names_resolve(name: str) -> None:
    assert getattr(weather_aug, name) is not None
    assert name in dir(weather_aug)


def test_names_for_type_checkers_are_the_names_at_run_time() -> None:
    """The block for type checkers and the table of homes are written by hand, twice."""
    text = Path(weather_aug.__file__).read_text(encoding="utf-8")
    for name, home in weather_aug._HOMES.items():
        assert f"    from {home} import {name} as {name}\n" in text
        assert getattr(importlib.import_module(home), name) is getattr(weather_aug, name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Hail'"):
        weather_aug.Hail  # noqa: B018 - the access is what is tested
