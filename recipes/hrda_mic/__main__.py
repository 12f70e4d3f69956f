"""Write a config that trains HRDA or MIC, unmodified, on an export of weather_aug.

python recipes/hrda_mic --role source --data exports/weather --checkout ../MIC \
    --out ../MIC/seg/configs/weather_aug/source.py

It needs nothing but Python 3.8 or later, so that it also runs where HRDA and MIC run. The export is
checked first: what would stop a training after minutes stops here, with the cure.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

from checkouts import ROLES, Checkout, open_checkout
from exported import Exported, read_export
from refused import Refused
from settings import config_text, notes

HELP = {
    "role": "source: labelled, in place of Cityscapes; target: unlabelled, in place of ACDC; "
    "source-only: labelled, and no target (HRDA, branch dg)",
    "data": "folder that `weather-aug export` or, of a source, `weather-aug merge` wrote",
    "checkout": "unmodified clone of HRDA or MIC",
    "out": "config to write, below the checkout's folder configs",
    "seed": "of the training",
}


def main(arguments: list[str] | None = None) -> int:
    """Write the config and say how to start; 2 and one sentence if it would not train."""
    parser = argparse.ArgumentParser(prog="recipes/hrda_mic", description=__doc__.split("\n")[0])
    parser.add_argument("--role", choices=ROLES, required=True, help=HELP["role"])
    for name in ("data", "checkout", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True, help=HELP[name])
    parser.add_argument("--seed", type=int, default=0, help=HELP["seed"])
    given = parser.parse_args(arguments)
    try:
        checkout = open_checkout(given.checkout, given.role)
        relative = _below_configs(given.out, checkout)
        exported = read_export(given.data, labelled=given.role != "target")
        _write(given.out, config_text(checkout, given.role, exported, given.seed, given.out))
    except Refused as refusal:
        print(f"error: {refusal}", file=sys.stderr)
        return 2
    print(f"wrote {given.out}: {exported.samples} samples as {given.role} of {checkout.name}")
    for note in notes(exported, given.role) + _leakage(exported):
        print(f"note: {note}")
    print("not checked here, because nothing of the checkout was run:")
    for item in _unchecked(checkout, given.role):
        print(f"  {item}")
    print("start, in the environment of the checkout (Python 3.8, torch 1.7.1, mmcv-full 1.3.7):")
    print(f"  cd {checkout.root}")
    print(f"  python run_experiments.py --config {relative}")
    return 0


def _below_configs(out: Path, checkout: Checkout) -> str:
    """The config's path as the trainer's command takes it."""
    configs = checkout.configs.resolve()
    try:
        below = out.resolve().relative_to(configs).as_posix()
    except ValueError:
        raise Refused(
            f"--out {out} must lie below {configs}, because run_experiments.py finds configs "
            f"there only; take {configs / 'weather_aug' / out.name}"
        ) from None
    if "configs" in below or not re.fullmatch(r"[\w/-]+\.py", below):
        raise Refused(
            f"--out {below} must end in .py and be of letters, digits, '-' and '_', without the "
            "word configs, which run_experiments.py replaces wherever it stands; rename it"
        )
    return f"configs/{below}"


def _write(out: Path, text: str) -> None:
    if out.exists() and out.read_text(encoding="utf-8") != text:
        raise Refused(f"{out} exists and holds something else; remove it, or give another --out")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = out.with_suffix(".tmp")
        partial.write_text(text, encoding="utf-8")
        partial.replace(out)
    except OSError as error:
        raise Refused(f"{out} cannot be written ({error.strerror}); check the folder") from None


def _leakage(exported: Exported) -> list[str]:
    """What an evaluation must leave out."""
    if exported.editors is None:
        return [
            "the export does not record what trained the editor of its backgrounds; if any picture "
            "of ACDC did, do not evaluate on ACDC"
        ]
    found = []
    for editor in exported.editors:
        lists = ", ".join(_pair_lists(editor["card"]))
        made = f"the editor {editor['editor']} made backgrounds"
        found.append(
            f"{made}, trained on {lists}: do not evaluate on any picture of that (`weather-aug "
            "inspect EXPORT --against data/acdc/rgb_anon/val` looks each up)"
            if lists
            else f"{made}, and its card names no pictures that trained it: find out before you "
            "evaluate on ACDC"
        )
    return found


def _pair_lists(card: Any) -> list[str]:
    """Names of what an editor was trained on, from its card, which may hold others' cards."""
    if not isinstance(card, dict):
        return []
    own = [card["pair_list"]] if isinstance(card.get("pair_list"), str) else []
    return own + [name for value in card.values() for name in _pair_lists(value)]


def _unchecked(checkout: Checkout, role: str) -> list[str]:
    """What only a run can tell, and what the authors' configs expect on disk."""
    needed = ["pretrained/mit_b5.pth", "data/acdc/rgb_anon/val", "data/acdc/gt/val"]
    if role == "source":
        needed += ["data/acdc/rgb_anon/train"]
    if role == "target":
        needed += ["data/cityscapes/leftImg8bit/train", "data/cityscapes/gtFine/train"]
        needed += ["data/cityscapes/sample_class_stats.json"]
        needed += ["data/cityscapes/samples_with_class.json"]
    missing = [path for path in needed if not (checkout.root / path).exists()]
    found = ["that the training runs: start it, and watch its first hundred iterations"]
    found += ["that its GPU has the memory: the authors' had 24 GB"]
    found += [f"{path} is not in the checkout; its README says how to get it" for path in missing]
    return found


if __name__ == "__main__":
    sys.exit(main())
