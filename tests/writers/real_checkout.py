"""What HRDA's and MIC's own code draws by a config, as JSON and arrays; see test_real_checkout.

    python real_checkout.py CONFIG DRAWS OUT

Runs where a checkout does (Python 3.8 or later), with the checkout on PYTHONPATH, in a folder that
holds the checkout's `data`. OUT.json says what was drawn, OUT.npz holds each drawn sample thinned.
"""

import json
import sys
from pathlib import Path

import numpy as np
from mmcv import Config
from mmseg.datasets import build_dataset
from mmseg.datasets.pipelines import RandomCrop

LABEL_STEP, IMAGE_STEP = 4, 16


class Watched:
    """A source that remembers the crops of each load."""

    def __init__(self, source):
        self.source, self.load, self.loads = source, source.prepare_train_img, []
        self.bbox = RandomCrop.get_crop_bbox
        source.prepare_train_img = self.prepare
        RandomCrop.get_crop_bbox = lambda crop, img: self.cropped(crop, img)

    def prepare(self, index):
        self.loads.append({"index": int(index), "corners": []})
        sample = self.load(index)
        values, counts = np.unique(sample["gt_semantic_seg"].data.numpy(), return_counts=True)
        self.loads[-1]["pixels"] = {str(c): int(n) for c, n in zip(values, counts)}  # noqa: B905
        self.loads[-1]["flip"] = bool(sample["img_metas"].data["flip"])
        return sample

    def cropped(self, crop, img):
        box = self.bbox(crop, img)
        # A target is cropped too; its loads are not remembered.
        if self.loads and "pixels" not in self.loads[-1]:
            self.loads[-1]["corners"].append([int(box[0]), int(box[2])])
        return box


def chosen_in(draw):
    """What a draw returns, and what it chose of numpy's: a class and a file first."""
    choices, choice = [], np.random.choice

    def watched(*given, **named):
        choices.append(choice(*given, **named))
        return choices[-1]

    np.random.choice = watched
    try:
        return draw(), choices
    finally:
        np.random.choice = choice


def thinned(sample):
    """Label and picture as a network gets them, the picture in BGR of 8 bits again, unpadded."""
    meta = sample["img_metas"].data
    norm = meta["img_norm_cfg"]
    rgb = sample["img"].data.numpy().transpose(1, 2, 0) * norm["std"] + norm["mean"]
    height, width = meta["img_shape"][:2]
    rgb[height:], rgb[:, width:] = 0, 0
    image = np.rint(rgb[..., ::-1]).astype(np.uint8)[::IMAGE_STEP, ::IMAGE_STEP]
    return sample["gt_semantic_seg"].data.numpy()[0, ::LABEL_STEP, ::LABEL_STEP], image


def listed(dataset):
    return {
        "type": type(dataset).__name__,
        "files": [[info["filename"], info["ann"]["seg_map"]] for info in dataset.img_infos],
    }


def main(config, draws, out):
    cfg = Config.fromfile(config)
    whole = build_dataset(cfg.data.train)
    pairs = whole.dataset if type(whole).__name__ == "RepeatDataset" else whole
    target = getattr(pairs, "target", None)
    found = {
        "config": cfg._cfg_dict.to_dict(),
        "pretty": len(cfg.pretty_text),
        "epoch": len(whole),
        "source": listed(pairs.source),
        "target": None if target is None else listed(target),
        "classes": [int(c) for c in pairs.rcs_classes],
        "probabilities": [float(p) for p in pairs.rcs_classprob],
        "files": {str(c): list(files) for c, files in pairs.samples_with_class.items()},
        "index_by_file": pairs.file_to_idx,
        "draws": [],
    }
    watched = Watched(pairs.source)
    np.random.seed(0)  # noqa: NPY002  their pipelines read the global generator
    labels, images = [], []
    for index in range(draws):
        watched.loads = []
        sample, choices = chosen_in(lambda: whole[index % len(whole)])  # noqa: B023
        label, image = thinned(sample)
        labels.append(label.astype(np.uint8))
        images.append(image)
        found["draws"].append(
            {
                "train_id": int(choices[0]),
                "file": str(choices[1]),
                "loads": watched.loads,
                "target": list(sample["target_img"].data.shape) if target is not None else None,
            }
        )
    np.savez_compressed(out + ".npz", labels=np.stack(labels), images=np.stack(images))
    Path(out + ".json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
