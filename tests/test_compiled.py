"""Compiled code is cached, and never outlives the sources it was made from."""

import shutil
import subprocess
import sys
from pathlib import Path

import weather_aug
from weather_aug._compiled import _package_stamp
from weather_aug.render.planes import clean_depth

PROBE = """
import numpy as np
from weather_aug.render.planes import clean_depth
depth = np.array([50000.0], np.float32)
clean_depth(depth)
print(depth[0], sum(clean_depth.stats.cache_hits.values()))
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
    assert clean_depth._cache._cache_file._source_stamp == _package_stamp()


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
