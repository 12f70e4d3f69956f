"""A diffusion editor trained from nothing on made-up streets, and what each of its parts is for.

python recipes/07_small_diffusion_editor.py --out runs/small_editor

Draws streets, pre-trains a small model of SD-Turbo's shape, trains adapters with the real command
and prints a table on streets that were held out. What is there already is not made again; --quick
goes through all of it in a minute and proves nothing. The model is a small stand-in: its numbers
say that the parts work together, not how good the real one is.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
from small_editor.measure import HeldOut, Row, measured_row, measured_targets, report
from small_editor.stages import QUICK, Plan, prepared, trained
from small_editor.streets import STYLES

from weather_aug._png import png_bytes
from weather_aug.edit.background import BackgroundEditor, Moment
from weather_aug.edit.diffusion.editor import DiffusionEditor
from weather_aug.edit.diffusion.options import (
    RELEASE_WEIGHTS,
    SELF_ONLY,
    AttentionWeights,
    DiffusionOptions,
    paper_weights,
)
from weather_aug.view.sheet import grid

ATTENTIONS = {
    "self-attention": SELF_ONLY,
    "+ view": AttentionWeights(0.72, 0.28, 0.0, 0.0),
    "+ temporal": AttentionWeights(0.88, 0.0, 0.06, 0.06),
    "+ both (release)": RELEASE_WEIGHTS,
    "+ both (paper's equation)": paper_weights(),
}


def measured_all(plan: Plan, out: Path, streets: list[HeldOut], seeds: int) -> dict[str, list[Row]]:
    """Train and measure each editor; by name, one row of numbers for each seed."""
    rows: dict[str, list[Row]] = {
        "clear": [measured_row(streets, None)],
        "physical editor": [measured_targets(streets)],
    }

    def add(name: str, adapter: Path, attention: AttentionWeights = SELF_ONLY) -> None:
        row = measured_row(streets, editor_of(out, adapter, attention))
        rows.setdefault(name, []).append(row)

    for seed in range(seeds):
        words = ("--seed", str(seed))
        adapter = trained(plan, out, f"all_{seed}", plan.steps, *words)
        for name, attention in ATTENTIONS.items():
            add(name, adapter, attention)
        words = (*words, "--conditioning", "none")
        add("without labels", trained(plan, out, f"unlabelled_{seed}", plan.steps, *words))
    for style in STYLES if plan.singles else ():
        # As many steps as the style has among those of all.
        trained(plan, out, f"single/{style}", plan.steps // 4, "--styles", style)
    if plan.singles:
        add("single styles", out / "single")
    return rows


def editor_of(out: Path, adapter: Path, attention: AttentionWeights) -> BackgroundEditor:
    """An editor as anyone loads it."""
    return DiffusionEditor.load(DiffusionOptions(str(out / "base"), adapter, attention))


def sheet(streets: list[HeldOut], editor: BackgroundEditor) -> bytes:
    """A PNG: two held-out moments clear, edited, and as the physical editor has them."""
    rows, names = [], []
    for street in streets[:2]:
        keys = street.scene.keys[:3]
        now = tuple(street.frames[key] for key in keys)
        edited = {style: editor.edit(Moment(now), style) for style in STYLES}
        for at, key in enumerate(keys):
            goals = [street.targets[style][key] for style in STYLES]
            rows.append([now[at].image, *(edited[style][at] for style in STYLES), *goals])
            names.append(key.camera)
    columns = ["clear", *STYLES, *(f"{style}, physical" for style in STYLES)]
    return png_bytes(grid(rows, names, columns, 320))


def main() -> None:
    """Train and measure; print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="kept; a temporary folder if not given")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    plan, seeds = (QUICK, 1) if given.quick else (Plan(), given.seeds)
    torch.set_num_threads(plan.threads)
    with tempfile.TemporaryDirectory() as folder:
        out = given.out or Path(folder)
        streets = prepared(plan, out)
        rows = measured_all(plan, out, streets, seeds)
        picture = sheet(streets, editor_of(out, out / "all_0", RELEASE_WEIGHTS))
        (out / "sheet.png").write_bytes(picture)
    print(report(rows))


if __name__ == "__main__":
    main()
