"""What mmsegmentation 1.x and cityscapesScripts read of an export, as JSON; see test_real_mmseg.

    python real_mmseg.py EXPORT CONFIG

Runs where those are installed. mmsegmentation imports the compiled operations of mmcv with its data
sets, for losses that no data set has: where mmcv is mmcv-lite, a module takes their place whose
functions raise when they are called. Data sets, transforms and the evaluation are the real ones.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import tempfile
import types
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SUFFIXES = ("_leftImg8bit.png", "_gtFine_labelTrainIds.png")


class NotCompiled(types.ModuleType):
    """Operations that are there to be imported, not to be called."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def operation(*_: Any, **__: Any) -> None:
            raise RuntimeError(f"mmcv._ext.{name} is not compiled here")

        return operation


def loaded(root: Path) -> list[dict[str, Any]]:
    """Pixels by class of each sample as the real `CityscapesDataset` gives it to a network."""
    if importlib.util.find_spec("mmcv._ext") is None:
        sys.modules["mmcv._ext"] = NotCompiled("mmcv._ext")
    import mmseg.datasets.transforms  # noqa: F401  registers them
    from mmengine.registry import init_default_scope
    from mmseg.datasets import CityscapesDataset

    init_default_scope("mmseg")
    pipeline = ("LoadImageFromFile", "LoadAnnotations", "PackSegInputs")
    dataset = CityscapesDataset(
        data_root=str(root),
        data_prefix={"img_path": "leftImg8bit/train", "seg_map_path": "gtFine/train"},
        pipeline=[{"type": name} for name in pipeline],
    )
    assert (dataset.img_suffix, dataset.seg_map_suffix) == SUFFIXES
    found = []
    for sample in dataset:
        label = sample["data_samples"].gt_sem_seg.data.numpy()[0]
        values, counts = np.unique(label, return_counts=True)
        found.append(
            {
                "image": Path(sample["data_samples"].img_path).relative_to(root).as_posix(),
                "label": Path(sample["data_samples"].seg_map_path).relative_to(root).as_posix(),
                "shape": list(sample["inputs"].shape),
                # BGR, as cv2 reads it.
                "mean_bgr": sample["inputs"].numpy().mean(axis=(1, 2)).tolist(),
                "pixels": {str(c): int(n) for c, n in zip(values, counts, strict=True)},
            }
        )
    return found


def merged(config: Path) -> dict[str, Any]:
    """A config as mmengine merges it."""
    from mmengine.config import Config

    result: dict[str, Any] = Config.fromfile(str(config)).to_dict()
    return result


def scores(root: Path) -> dict[str, float]:
    """Mean IoU of the labels against themselves, and against labels of which a part is wrong.

    cityscapesScripts evaluates ids (0..33), an export has train ids: they are converted by its own
    table, as HRDA and mmsegmentation convert predictions before they call it.
    """
    from cityscapesscripts.evaluation import evalPixelLevelSemanticLabeling as evaluation
    from cityscapesscripts.helpers.labels import trainId2label

    evaluation.args.evalInstLevelScore = False
    evaluation.args.JSONOutput = False
    evaluation.args.quiet = True
    table = np.array([trainId2label[i].id if i in trainId2label else 0 for i in range(256)])
    truths, wrong = [], []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted((root / "gtFine/train").rglob(f"*{SUFFIXES[1]}")):
            with Image.open(path) as file:
                ids = table[np.asarray(file)].astype(np.uint8)
            stem = path.name.replace("_gtFine_labelTrainIds.png", "")
            truths.append(f"{folder}/{stem}_gtFine_labelIds.png")
            wrong.append(f"{folder}/{stem}_wrong.png")
            Image.fromarray(ids).save(truths[-1])
            ids[:, : ids.shape[1] // 4] = trainId2label[8].id
            Image.fromarray(ids).save(wrong[-1])
        return {
            name: evaluation.evaluateImgLists(predictions, truths, evaluation.args)[
                "averageScoreClasses"
            ]
            for name, predictions in (("itself", truths), ("wrong", wrong))
        }


if __name__ == "__main__":
    export, config = map(Path, sys.argv[1:])
    result = {"samples": loaded(export), "config": merged(config), "scores": scores(export)}
    print(json.dumps(result))  # noqa: T201
