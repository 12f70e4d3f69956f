"""Stand-ins for clones of HRDA and MIC, and how mmcv merges their configs.

The stand-ins have the file names and keys of the real ones, and nothing else of them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

RECIPE = Path(__file__).parents[2] / "recipes" / "hrda_mic"

PLACES = """
data = dict(
    samples_per_gpu=2,
    workers_per_gpu=4,
    train=dict(
        type='UDADataset',
        source=dict(type='CityscapesDataset', data_root='data/cityscapes/',
                    img_dir='leftImg8bit/train', ann_dir='gtFine/train', pipeline=['cut']),
        target=dict(type='ACDCDataset', data_root='data/acdc/',
                    img_dir='rgb_anon/train', ann_dir='gt/train', pipeline=['cut'])),
    val=dict(type='ACDCDataset', data_root='data/acdc/', img_dir='rgb_anon/val', ann_dir='gt/val'))
"""
DATASET = "datasets/uda_cityscapesHR_to_acdcHR_1024x1024.py"
BASES = {
    "default_runtime.py": "log_level = 'INFO'\n",
    "models/daformer_sepaspp_mitb5.py": (
        "model = dict(type='EncoderDecoder', pretrained='pretrained/mit_b5.pth',\n"
        "             decode_head=dict(type='DAFormerHead', num_classes=19),\n"
        "             test_cfg=dict(mode='whole'))\n"
    ),
    DATASET: PLACES,
    "uda/dacs_a999_fdthings.py": (
        "uda = dict(type='DACS', alpha=0.999, mask_generator=None)\nuse_ddp_wrapper = True\n"
    ),
    "uda/dacs_fdthings_srconly.py": "uda = dict(type='DACS', source_only=True)\n",
    "schedules/adamw.py": "optimizer = dict(type='AdamW', lr=6e-05, weight_decay=0.01)\n",
    "schedules/poly10warm.py": "lr_config = dict(policy='poly', warmup_iters=1500)\n",
}


def checkout_in(folder: Path, name: str) -> Path:
    """A stand-in for a clone: hrda, hrda-dg or mic."""
    root = folder / name / "seg" if name == "mic" else folder / name
    trainer = "mic" if name == "mic" else "hrda"
    example = "gtaHR2csHR_mic_hrda.py" if name == "mic" else "gtaHR2csHR_hrda.py"
    texts = {f"configs/_base_/{path}": text for path, text in BASES.items()}
    texts |= {f"configs/{trainer}/{example}": "", "run_experiments.py": ""}
    if name == "hrda-dg":
        texts["mmseg/datasets/dg_dataset.py"] = ""
    for path, text in texts.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    return folder / name


def run(
    role: str, data: Path, checkout: Path, out: Path | None = None, python: str = sys.executable
) -> subprocess.CompletedProcess[str]:
    """The recipe, run; `out` is made.py in a folder of the checkout's configs if None."""
    seg = checkout / "seg" if checkout.name == "mic" else checkout
    out = out or seg / "configs/weather_aug/made.py"
    command = [python, RECIPE, "--role", role, "--data", data, "--checkout", checkout, "--out", out]
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False, timeout=60
    )


def config_of(path: Path) -> dict[str, Any]:
    """A config and its bases, merged by mmcv's rules: bases may not share names."""
    named: dict[str, Any] = {}
    if path.suffix == ".json":
        named = json.loads(path.read_text())
    else:
        exec(path.read_text(), {}, named)
    bases = named.pop("_base_", [])
    merged: dict[str, Any] = {}
    for base in [bases] if isinstance(bases, str) else bases:
        one = config_of(path.parent / base)
        assert not merged.keys() & one.keys(), "mmcv refuses names that two bases share"
        merged |= one
    return merged_into(merged, named)


def merged_into(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`_delete_` is taken out, and heeded, only where the base has the name."""
    made = dict(base)
    for key, value in over.items():
        if not isinstance(value, dict) or key not in base:
            made[key] = value
        elif value.get("_delete_", False):
            made[key] = {k: v for k, v in value.items() if k != "_delete_"}
        else:
            assert isinstance(base[key], dict), f"mmcv merges no dict into {key}"
            made[key] = merged_into(base[key], value)
    return made
