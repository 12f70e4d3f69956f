"""Every recipe runs as it stands, on a CPU."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

OPTIONS = {"02_physics_figures": ["--quick"]}
"""Of recipes that take too long, or write outside, as they stand."""
RECIPES = sorted((Path(__file__).parents[1] / "recipes").glob("[0-9]*.py"))


def test_there_are_recipes():
    assert RECIPES


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_recipe_runs(recipe, tmp_path):
    done = subprocess.run(
        [sys.executable, str(recipe), *OPTIONS.get(recipe.stem, [])],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert len(recipe.read_text(encoding="utf-8").splitlines()) <= 120


def test_every_figure_of_the_physics_has_its_recipe():
    """What the document shows is what the recipe draws, no more and no less."""
    root = Path(__file__).parents[1]
    source = (root / "recipes" / "02_physics_figures.py").read_text(encoding="utf-8")
    drawn = set(re.findall(r'"(\d\d_\w+)":', source))
    shown = set(
        re.findall(r"figures/(\w+)\.png", (root / "docs" / "physics.md").read_text("utf-8"))
    )
    assert drawn
    assert drawn == shown == {path.stem for path in (root / "docs" / "figures").glob("*.png")}
