"""`ls` shows the data flow: a stage imports only from stages before it, and leaves only leaves."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import weather_aug

PACKAGE = Path(weather_aug.__file__).parent
STAGES = (
    "clip",
    "edit",
    "gaussians",
    "particles",
    "render",
    "scene",
    "scores",
    "transforms",
    "view",
    "writers",
)
LEAVES = ("weather", "severity", "air", "timeline", "taxonomy", "colour", "errors")
FREE = ("cli", "doctor", "preview")
"""They stand outside the flow and may know everybody."""


def breaches(path: str, source: str) -> list[str]:
    """Imports of a module (its path below the package) that go against the order."""
    room = path.split("/")[0].removesuffix(".py")
    if room in FREE:
        return []
    found = []
    for line, module in _imports(ast.parse(source), path):
        parts = module.split(".")
        if parts[0] != "weather_aug" or len(parts) == 1:
            continue
        if not _may_know(room, parts[1]):
            found.append(f"{path}:{line} imports {module}")
    return found


def _may_know(room: str, other: str) -> bool:
    if _is_leaf(other):
        return True
    if other not in STAGES or _is_leaf(room):
        return False
    return STAGES.index(other) <= STAGES.index(room)


def _is_leaf(name: str) -> bool:
    return name in LEAVES or name.startswith("_")


def _imports(tree: ast.AST, path: str) -> Iterator[tuple[int, str]]:
    """Line and module of every import but those for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _imports(ast.Module(node.orelse, []), path)
        elif isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node, path)
            # `from weather_aug import _files` names a module; a function's name does no harm.
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        else:
            yield from _imports(node, path)


def _absolute(node: ast.ImportFrom, path: str) -> str:
    if node.level == 0:
        return node.module or ""
    parents = ["weather_aug", *path.split("/")[:-1]]
    return ".".join([*parents[: len(parents) - node.level + 1], *filter(None, [node.module])])


MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES)
def test_imports_follow_the_order(path: str) -> None:
    assert breaches(path, (PACKAGE / path).read_text(encoding="utf-8")) == []


def test_stages_are_in_the_order_of_ls() -> None:
    assert list(STAGES) == sorted(STAGES)


def test_every_module_has_a_place() -> None:
    """A new folder or top-level file is a stage, a leaf, or an edit of this test."""
    rooms = {path.split("/")[0] for path in MODULES}
    known = {*STAGES, *FREE, *(f"{name}.py" for name in (*LEAVES, *FREE))}
    assert {room for room in rooms if not room.startswith("_")} <= known


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("clip/kitti.py", "from weather_aug.scene.store import read_frame"),
        ("clip/kitti.py", "import weather_aug.render.compose"),
        ("clip/kitti.py", "def late():\n    from weather_aug.view import sheet"),
        ("render/label.py", "from weather_aug import scene"),
        ("render/label.py", "from ..scene import store"),
        ("edit/physical/overcast.py", "from ...gaussians import fit"),
        ("weather.py", "from weather_aug.clip.types import Camera"),
        ("_keys.py", "try:\n    import weather_aug.clip\nexcept ImportError:\n    pass"),
        ("scene/scene.py", "from weather_aug.cli import main"),
        ("scene/scene.py", "import weather_aug.unheard_of"),
        ("render/label.py", "if TYPE_CHECKING:\n    pass\nelse:\n    import weather_aug.scene"),
    ],
)
def test_a_breach_is_found(path: str, source: str) -> None:
    assert len(breaches(path, source)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        (
            "scene/store.py",
            "from weather_aug import _files\nfrom weather_aug.clip.types import Camera",
        ),
        ("scene/store.py", "from weather_aug.scene import policy\nfrom . import build"),
        ("weather.py", "from weather_aug._checks import finite"),
        (
            "clip/types.py",
            "if TYPE_CHECKING:\n    from weather_aug.scene.scene import WeatherScene",
        ),
        ("clip/types.py", "import numpy\nfrom weather_augment import scene"),
        ("cli.py", "from weather_aug.writers.export import export"),
    ],
)
def test_the_way_of_the_data_is_no_breach(path: str, source: str) -> None:
    assert breaches(path, source) == []
