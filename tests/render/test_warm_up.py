"""`warm_up` leaves nothing to compile, else each worker compiles for itself, all at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import warm_up_probe

import weather_aug

REACHED = {
    *("dress", "draw_lines", "smear", "_guess"),
    *("scatter", "keep_exposed", "add_patches", "add_puffs", "_draws", "shade", "read_labels"),
    *("_shine", "_mirror", "draw_drops", "draw_blade", "draw_smears", "expose"),
}
"""What the probe's renders must use, so that it says something about them."""


def probed(*arguments: str) -> Any:
    """What the probe finds in a new process."""
    done = subprocess.run(
        [sys.executable, str(Path(warm_up_probe.__file__)), *arguments],
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_warm_up_leaves_nothing_to_compile() -> None:
    found = probed()
    assert found["cold"] == {}
    # The probe's renders reach all parts of a picture in weather.
    reached = {name.rpartition(".")[2] for name in found["used"]}
    assert REACHED <= reached, REACHED - reached


def test_a_frame_that_it_forgets_is_found_out() -> None:
    """The planted fault: no unlabelled frame is warmed up, whose classes are guessed."""
    assert "weather_aug.edit.physical.site._guess" in probed("--fault")["cold"]
