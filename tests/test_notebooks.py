"""Every notebook runs from top to bottom, shows a picture, and is kept without what it showed."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import weather_aug
from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import FrameKey
from weather_aug.render.compose import warm_up
from weather_aug.scene.scene import WeatherScene

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed: group dev")
pytest.importorskip("nbclient", reason="nbclient is not installed: group dev")
pytest.importorskip("ipykernel", reason="ipykernel is not installed: group dev")

RUNNER = Path(__file__).parent / "run_notebook.py"
FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NAMES = ["01_severity_sweep", "02_drop_into_dataloader", "03_export"]
LONGEST_S = 300.0
PNG = b"\x89PNG\r\n\x1a\n"

Cell = dict[str, Any]


def code_cells(notebook: Any) -> list[Cell]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def unclean(notebook: Any) -> list[str]:
    """What a notebook in git should not hold."""
    found = []
    for number, cell in enumerate(code_cells(notebook)):
        if cell.outputs:
            found.append(f"code cell {number} has outputs")
        if cell.execution_count is not None:
            found.append(f"code cell {number} has an execution count")
    found += [f"cell {cell.id} has metadata" for cell in notebook.cells if cell.metadata]
    expected = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    if notebook.metadata != expected:
        found.append("the metadata is not that of any Python")
    return found


def pictures(notebook: Any) -> list[bytes]:
    """PNG of all outputs."""
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    encoded = [output.get("data", {}).get("image/png") for output in outputs]
    return [base64.b64decode(png) for png in encoded if png is not None]


def executed(path: Path, folder: Path) -> Any:
    """The notebook as it is after a run in `folder`, in the Python that runs the tests."""
    done = folder / "executed.ipynb"
    ours = str(Path(weather_aug.__file__).parents[1])
    told = {"PYTHONPATH": ours, "NO_ALBUMENTATIONS_UPDATE": "1", "TMPDIR": str(folder)}
    own = {name: str(folder) for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR")}
    run = subprocess.run(
        [sys.executable, str(RUNNER), str(path), str(done)],
        cwd=folder,
        env=os.environ | told | own,
        capture_output=True,
        text=True,
        timeout=2 * LONGEST_S,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return nbformat.read(done, as_version=4)


@pytest.fixture(scope="module")
def compiled(tiny_scene: WeatherScene) -> None:
    """Kernels of building and rendering are in the cache: the first run of all takes minutes."""
    StreetClip(frames=1, width=32, height=18).frame(FrameKey(0, "front"))
    warm_up()


def test_the_notebooks_are_there() -> None:
    assert [path.stem for path in NOTEBOOKS] == NAMES


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert unclean(notebook) == []
    assert len(code_cells(notebook)) <= 10
    assert notebook.cells[0].cell_type == "markdown"


@pytest.mark.parametrize(
    "soil",
    [
        lambda n: code_cells(n)[0].outputs.append({"output_type": "stream", "text": "said"}),
        lambda n: code_cells(n)[1].update(execution_count=3),
        lambda n: n.cells[0].metadata.update(scrolled=True),
        lambda n: n.metadata.kernelspec.update(name="somebodys-venv"),
        lambda n: n.metadata.update(interpreter="python3.11"),
    ],
)
def test_what_a_run_leaves_is_seen(soil: Any) -> None:
    notebook = nbformat.read(NOTEBOOKS[0], as_version=4)
    soil(notebook)
    assert len(unclean(notebook)) == 1


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.usefixtures("compiled")
def test_a_notebook_runs_and_shows_a_picture(path: Path, tmp_path: Path) -> None:
    start_s = time.monotonic()
    done = executed(path, tmp_path)
    assert time.monotonic() - start_s < LONGEST_S
    cells = code_cells(done)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    shown = pictures(done)
    assert shown
    assert all(png.startswith(PNG) for png in shown)
    streams = [o for cell in cells for o in cell.outputs if o.output_type == "stream"]
    assert streams == []


def test_a_cell_that_fails_is_seen(tmp_path: Path) -> None:
    notebook = json.loads(NOTEBOOKS[0].read_text(encoding="utf-8"))
    code = next(cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    code["source"] = "raise ValueError('planted')"
    path = tmp_path / "broken.ipynb"
    path.write_text(json.dumps(notebook), encoding="utf-8")
    with pytest.raises(AssertionError, match="CellExecutionError") as caught:
        executed(path, tmp_path)
    assert "planted" in str(caught.value)
