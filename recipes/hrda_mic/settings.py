"""The settings of a config: those of the authors for Cityscapes to ACDC, and where the data is.

Source: experiments.py of HRDA (--exp 49; branch dg: --exp 50) and of MIC (--exp 80), whose
settings for this pair of data sets exist only as generated configs.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from checkouts import Checkout
from exported import MIN_PIXELS, Exported, Size

LINE = 88
BATCH, ITERATIONS = 2, 40000
DRAWN = BATCH * ITERATIONS
"""Samples that a training draws. An epoch must not be shorter: its worker starts each with one seed
and draws the same classes, files and crops again (torch < 1.8 keeps no worker alive)."""

CROP_PX = 1024
BESIDE = {"source": 1600, "target": 2975}
"""Pictures of the other side, by the export's role: ACDC's of train, Cityscapes' of train."""

BYTES_PER_PAIR = 40
"""Of an epoch's order, a list of integers in CPython; measured."""

LARGE_ORDER_GB = 4

SCALE_PX = {"source": Size(2048, 1024), "target": Size(1920, 1080)}
"""Longest long and short side that pictures are resized to, keeping their aspect."""


def settings(checkout: Checkout, role: str, exported: Exported, seed: int) -> dict[str, Any]:
    """Names of a config and their values, without `_base_`."""
    reader = exported.reader
    place = {
        "type": reader.type,
        "data_root": f"{exported.root.resolve().as_posix()}/",
        "img_dir": reader.img_dir,
        "ann_dir": reader.ann_dir,
    }
    sampling = {"min_pixels": MIN_PIXELS, "class_temp": 0.01, "min_crop_ratio": 2.0}
    train: dict[str, Any] = {role: place, "rare_class_sampling": sampling}
    if role == "source-only":
        place["pipeline"] = _SOURCE_PIPELINE
        alone = {"type": "DGDataset", "source": place, "rare_class_sampling": sampling}
        times = -(-DRAWN // exported.samples)
        train = {"_delete_": True, "type": "RepeatDataset", "times": times, "dataset": alone}
    values: dict[str, Any] = {
        "data": {"samples_per_gpu": BATCH, "workers_per_gpu": 1, "train": train},
        "model": _MODEL,
    }
    if checkout.name == "mic":
        values["uda"] = _MASKING
    name = f"weather_aug_{role.replace('-', '_')}_{checkout.name}_s{seed}"
    return {**values, **_SCHEDULE, "seed": seed, "n_gpus": 1, "name": name, "exp": "weather_aug"}


def config_text(checkout: Checkout, role: str, exported: Exported, seed: int, out: Path) -> str:
    """A config file for a checkout, to stand at `out` below its configs."""
    folder = out.resolve().parent
    bases = [
        os.path.relpath(str((checkout.configs / "_base_" / base).resolve()), str(folder))
        for base in checkout.bases(role)
    ]
    head = (
        f"# {checkout.name.upper()}, unmodified, with an export of weather_aug as {role}:\n"
        f"# {exported.samples} samples, layout {exported.layout}.\n"
        "# Written by recipes/hrda_mic; all but data.train as its authors have it for ACDC.\n"
    )
    named = {"_base_": [Path(base).as_posix() for base in bases]}
    named.update(settings(checkout, role, exported, seed))
    return head + "".join(f"{name} = {_literal(value)}\n" for name, value in named.items())


def notes(exported: Exported, role: str) -> list[str]:
    """What is not wrong with an export, but worth knowing before days of training."""
    kind = "target" if role == "target" else "source"
    found = []
    for size, count in sorted(exported.sizes.items()):
        made = resized(size, SCALE_PX[kind])
        note = f"{count} pictures of {size} are resized to {made}"
        inside = min(made.width, CROP_PX) * min(made.height, CROP_PX) / CROP_PX**2
        if inside < 1:
            note += f"; {1 - inside:.0%} of each {CROP_PX}x{CROP_PX} crop is padding"
        if made.width > 1.2 * size.width:
            times = made.width / size.width
            note += f"; enlarged {times:.1f} times, so that detail crops hold no detail"
        found.append(note)
    if kind == "source" and exported.dropped:
        found.append(
            f"train ids {', '.join(map(str, exported.dropped))} occur, but never with more than "
            f"{MIN_PIXELS} pixels in one picture: they are learnt, not sampled"
        )
    return found + pair_notes(exported.samples, role)


def pair_notes(samples: int, role: str) -> list[str]:
    """Of an epoch, every pair of a source and a target in an order that is kept in memory."""
    if role not in BESIDE:
        return []
    beside = BESIDE[role]
    pairs = samples * beside
    if pairs < DRAWN:
        return [
            f"{samples} samples make {pairs} pairs with {beside} pictures; after {pairs // BATCH} "
            "iterations the loader draws the same classes, files and crops again; "
            f"export {-(-DRAWN // beside)} or more"
        ]
    gb = pairs * BYTES_PER_PAIR / 1e9
    if gb > LARGE_ORDER_GB:
        return [
            f"the order of {samples} x {beside} pairs takes {gb:.0f} GB of memory; "
            "export fewer if that is too much"
        ]
    return []


def resized(size: Size, limits: Size) -> Size:
    """Width and height of a picture that is fitted into a long and a short side."""
    ratio = min(max(limits) / max(size), min(limits) / min(size))
    return Size(int(size.width * ratio + 0.5), int(size.height * ratio + 0.5))


def _literal(value: Any, indent: int = 0) -> str:
    """A value as Python writes it in ASCII, one item a line where it is long."""
    flat = ascii(value)
    if not isinstance(value, (dict, list)) or indent + len(flat) <= LINE:
        return flat
    inside = indent + 4
    if isinstance(value, dict):
        items = [f"{key!a}: {_literal(one, inside)}" for key, one in value.items()]
    else:
        items = [_literal(one, inside) for one in value]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    lines = "".join(f"{' ' * inside}{item},\n" for item in items)
    return f"{opening}\n{lines}{' ' * indent}{closing}"


_SOURCE_PIPELINE = [
    {"type": "LoadImageFromFile"},
    {"type": "LoadAnnotations"},
    {"type": "Resize", "img_scale": tuple(SCALE_PX["source"])},
    {"type": "RandomCrop", "crop_size": (CROP_PX, CROP_PX), "cat_max_ratio": 0.75},
    {"type": "RandomFlip", "prob": 0.5},
    {
        "type": "Normalize",
        "mean": [123.675, 116.28, 103.53],
        "std": [58.395, 57.12, 57.375],
        "to_rgb": True,
    },
    {"type": "Pad", "size": (CROP_PX, CROP_PX), "pad_val": 0, "seg_pad_val": 255},
    {"type": "DefaultFormatBundle"},
    {"type": "Collect", "keys": ["img", "gt_semantic_seg"]},
]
"""Of the authors' Cityscapes, which a data set that is repeated cannot inherit."""

_MODEL = {
    "type": "HRDAEncoderDecoder",
    "decode_head": {
        "type": "HRDAHead",
        "single_scale_head": "DAFormerHead",
        "attention_classwise": True,
        "hr_loss_weight": 0.1,
    },
    "scales": [1, 0.5],
    "hr_crop_size": [512, 512],
    "feature_scale": 0.5,
    "crop_coord_divisible": 8,
    "hr_slide_inference": True,
    "test_cfg": {
        "mode": "slide",
        "batched_slide": True,
        "stride": [512, 512],
        "crop_size": [1024, 1024],
    },
}

_MASKING = {
    # "separate" masks one source and one target picture, the authors' choice for ACDC; it asserts
    # a batch of two.
    "mask_mode": "separate",
    "mask_alpha": "same",
    "mask_pseudo_threshold": "same",
    "mask_lambda": 1,
    "mask_generator": {
        "type": "block",
        "mask_ratio": 0.7,
        "mask_block_size": 64,
        "_delete_": True,
    },
}

_SCHEDULE = {
    "optimizer_config": None,
    "optimizer": {
        "lr": 6e-05,
        "paramwise_cfg": {
            "custom_keys": {
                "head": {"lr_mult": 10.0},
                "pos_block": {"decay_mult": 0.0},
                "norm": {"decay_mult": 0.0},
            }
        },
    },
    "runner": {"type": "IterBasedRunner", "max_iters": ITERATIONS},
    "checkpoint_config": {"by_epoch": False, "interval": ITERATIONS, "max_keep_ckpts": 1},
    "evaluation": {"interval": 4000, "metric": "mIoU"},
}
