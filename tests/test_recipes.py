"""Every recipe runs as it stands, on a CPU."""

import subprocess
import sys
from pathlib import Path

import pytest

RECIPES = sorted((Path(__file__).parents[1] / "recipes").glob("[0-9]*.py"))


def test_there_are_recipes():
    assert RECIPES


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_recipe_runs(recipe):
    done = subprocess.run(
        [sys.executable, str(recipe)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert len(recipe.read_text(encoding="utf-8").splitlines()) <= 120
