"""RandomWeather of torchvision, checked in a process of its own; without torchvision, its error.

torchvision is no dependency, and beside a CPU build of torch it breaks what imports it: it is
installed into an environment that this test makes. The folder is not named `torchvision`, because
`tests` is on the path and a folder of that name would pass for the package.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CHECKS = HERE / "checks.py"
RECIPE = ROOT / "recipes" / "08_torchvision_v2.py"
TORCHVISION = "torchvision==0.28.0"
"""The release that belongs to the torch of constraints.txt."""


def run(*command: str | Path, timeout: float = 900) -> subprocess.CompletedProcess[str]:
    known = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE)]), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env=os.environ | known,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def assert_checks_pass(python: Path | str) -> None:
    plugins = ("-p", "declared_schemas", "-p", "no:cacheprovider")
    done = run(python, "-m", "pytest", CHECKS, *plugins, "-m", "not slow")
    passed = re.search(r"(\d+) passed", done.stdout)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert passed is not None, done.stdout
    assert int(passed[1]) > 90, "a part of the checks was not collected"


def assert_recipe_runs(python: Path | str) -> None:
    code = "import declared_schemas, runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__')"
    done = run(python, "-c", code, RECIPE)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "ignored" in done.stdout, done.stdout


def test_what_is_installed() -> None:
    """Where users have torchvision, all checks run with it, as it is."""
    if importlib.util.find_spec("torchvision") is None:
        pytest.skip("torchvision is not installed, and must not be beside a CPU build of torch")
    if run(sys.executable, "-c", "import torchvision").returncode != 0:
        pytest.skip("the installed torchvision does not load beside this torch")
    assert_checks_pass(sys.executable)
    assert_recipe_runs(sys.executable)


@pytest.mark.slow
def test_in_an_environment_of_its_own(tmp_path: Path) -> None:
    """All checks, with torch, this checkout and torchvision where nobody else looks."""
    environment = tmp_path / "environment"
    assert run(sys.executable, "-m", "venv", environment).returncode == 0
    python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    pip = (python, "-m", "pip", "--disable-pip-version-check")
    reached = run(*pip, "download", "--no-deps", "-d", tmp_path / "probe", TORCHVISION)
    if reached.returncode != 0:
        listed = run(*pip, "download", "--no-deps", "-d", tmp_path / "probe", "packaging")
        if listed.returncode != 0:
            pytest.skip("no package registry can be reached")
        pytest.fail(reached.stderr[-2000:])
    install = (*pip, "install", "--quiet", "--constraint", ROOT / "constraints.txt")
    for packages in (
        ("--editable", ROOT, "pytest", "hypothesis"),
        ("--no-deps", "--no-index", "--find-links", tmp_path / "probe", TORCHVISION),
    ):
        done = run(*install, *packages, timeout=1800)
        assert done.returncode == 0, done.stderr[-2000:]
    assert_checks_pass(python)
    assert_recipe_runs(python)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("sys.modules['torchvision'] = None", "import of torchvision halted"),
        (
            "class Broken:\n"
            "    def find_spec(self, name, path, target=None):\n"
            "        if name == 'torchvision':\n"
            "            raise RuntimeError('operator torchvision::nms does not exist')\n"
            "sys.meta_path.insert(0, Broken())",
            "operator torchvision::nms does not exist",
        ),
    ],
    ids=["absent", "of another torch"],
)
def test_without_torchvision_the_error_names_the_cure(fault: str, says: str) -> None:
    code = (
        f"import sys\n{fault}\n"
        "from weather_aug.errors import MissingExtraError\n"
        "try:\n    import weather_aug.transforms.torchvision\n"
        "except MissingExtraError as error:\n    print(error)"
    )
    done = run(sys.executable, "-c", code, timeout=120)
    assert says in done.stdout, done.stderr
    assert "pip install torchvision" in done.stdout


def test_the_recipe_says_what_it_misses() -> None:
    if importlib.util.find_spec("torchvision") is not None:
        pytest.skip("torchvision is installed")
    done = run(sys.executable, RECIPE, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "pip install torchvision" in done.stdout


def test_the_schemas_are_declared_only_where_nothing_loads() -> None:
    """A second declaration would end the process; a torchvision that loads is stood in for."""
    code = (
        "import subprocess, sys\n"
        "ran = subprocess.run\n"
        "subprocess.run = lambda *a, **k: ran([sys.executable, '-c', sys.argv[1]], **k)\n"
        "import declared_schemas\n"
        "print(declared_schemas.declared)"
    )
    loads = run(sys.executable, "-c", code, "pass", timeout=120)
    assert loads.stdout.strip() == "None", loads.stderr
    fails = run(sys.executable, "-c", code, "import no_such_package", timeout=120)
    assert ("Library" in fails.stdout) == (torch.version.cuda is None), fails.stderr
