"""Compiled code is cached, and never outlives the sources it was made from."""

import shutil
import subprocess
import sys
from pathlib import Path

import weather_aug
from weather_aug._compiled import _package_stamp
from weather_aug.render.surface import depth_row

PROBE = """
import numpy as np
from weather_aug.render.surface import Surface, depth_row
bytes_, halves = np.empty(0, np.uint8), np.empty(0, np.uint16)
depth = np.array([50000.0], np.float32)
surface = Surface(bytes_.reshape(0, 3), (0, 0, 1, 1), halves, depth, bytes_, 1)
out = np.empty(1, np.float32)
depth_row(surface, 0, 0, out.view(np.int32), out)
print(out[0], sum(depth_row.stats.cache_hits.values()))
"""


def probe(folder):
    done = subprocess.run(
        [sys.executable, "-c", PROBE],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout.split()


def test_the_cache_carries_the_digest_of_the_whole_package():
    assert depth_row._cache._cache_file._source_stamp == _package_stamp()


def test_a_constant_changed_in_another_module_changes_the_result(tmp_path):
    """Numba alone would look only at the file of the function and keep the old constant."""
    package = tmp_path / "weather_aug"
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(weather_aug.__file__).parent, package, ignore=ignore)
    assert probe(tmp_path) == ["50000.0", "0"]
    assert probe(tmp_path) == ["50000.0", "1"]
    medium = package / "render" / "medium.py"
    source = medium.read_text(encoding="utf-8")
    assert "FAR_DEPTH_M = 60000.0" in source
    medium.write_text(source.replace("FAR_DEPTH_M = 60000.0", "FAR_DEPTH_M = 40000.0"))
    assert probe(tmp_path) == ["inf", "0"]
