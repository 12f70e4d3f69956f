"""Which trainer a checkout holds, and whether it has the files and keys that a config overrides.

Read as text and syntax trees: nothing of a checkout is run.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any, NamedTuple

from refused import Refused

DATASET = "datasets/uda_cityscapesHR_to_acdcHR_1024x1024.py"
"""Cityscapes as the source, ACDC as the target, validation on ACDC."""

ROLES = ("source", "target", "source-only")


class Checkout(NamedTuple):
    """A trainer on disk."""

    name: str
    """hrda or mic."""
    root: Path
    """Where training is started: MIC's is the folder seg."""

    @property
    def configs(self) -> Path:
        """Folder of its configs."""
        return self.root / "configs"

    def bases(self, role: str) -> list[str]:
        """Configs that a config for a role is built on, below `configs/_base_`."""
        uda = "dacs_fdthings_srconly" if role == "source-only" else "dacs_a999_fdthings"
        return [
            "default_runtime.py",
            "models/daformer_sepaspp_mitb5.py",
            DATASET,
            f"uda/{uda}.py",
            "schedules/adamw.py",
            "schedules/poly10warm.py",
        ]


def open_checkout(path: Path, role: str) -> Checkout:
    """The trainer in a folder, fit for a role.

    Raises:
        Refused: If it is neither HRDA nor MIC, or lacks what the role needs.
    """
    checkout = _found(path)
    if role == "source-only":
        if checkout.name == "mic":
            raise Refused(
                f"{path} is MIC, which cannot train without a target; use HRDA, branch dg"
            )
        if not (checkout.root / "mmseg/datasets/dg_dataset.py").is_file():
            raise Refused(
                f"{path} is not on the branch that trains without a target; "
                f"run `git -C {path} checkout dg`"
            )
    for base in checkout.bases(role):
        if not (checkout.configs / "_base_" / base).is_file():
            raise Refused(
                f"{path} has no configs/_base_/{base}; take an unmodified checkout of "
                f"{checkout.name.upper()}, at its newest commit"
            )
    _check_keys(checkout.configs / "_base_" / DATASET)
    _check_start(checkout.root / "run_experiments.py")
    return checkout


def _found(path: Path) -> Checkout:
    for root in (path, path / "seg"):
        for name, config in (
            ("mic", "configs/mic/gtaHR2csHR_mic_hrda.py"),
            ("hrda", "configs/hrda/gtaHR2csHR_hrda.py"),
        ):
            if (root / config).is_file() and (root / "run_experiments.py").is_file():
                return Checkout(name, root)
    raise Refused(
        f"{path} is no checkout of HRDA or MIC (no configs/hrda or configs/mic beside "
        "run_experiments.py); clone https://github.com/lhoyer/HRDA or https://github.com/lhoyer/MIC"
    )


def _check_keys(path: Path) -> None:
    """The keys that are overridden must be there, or mmcv would add them silently."""
    data = keywords(path).get("data", {})
    for role in ("source", "target"):
        keys = set(data.get("train", {}).get(role, {}))
        missing = {"type", "data_root", "img_dir", "ann_dir", "pipeline"} - keys
        if missing:
            raise Refused(
                f"{path} has no data.train.{role}.{sorted(missing)[0]}, which this config "
                "overrides; take an unmodified checkout"
            )


def _check_start(path: Path) -> None:
    """MIC's first commit could not start a config: a dict has no pretty_text (lhoyer/MIC#2)."""
    if "write(child_cfg.pretty_text)" in path.read_text(encoding="utf-8"):
        raise Refused(
            f"{path} is older than the authors' fix of its option --config; "
            f"run `git -C {path.parent} pull`"
        )


def keywords(path: Path) -> dict[str, Any]:
    """Names that a config assigns, with the keywords of nested `dict(...)`."""
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, UnicodeDecodeError):
        raise Refused(f"{path} is no Python config; take an unmodified checkout") from None
    return {
        target.id: _keywords(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def _keywords(node: ast.expr) -> dict[str, Any]:
    if not isinstance(node, ast.Call):
        return {}
    return {word.arg: _keywords(word.value) for word in node.keywords if word.arg is not None}
