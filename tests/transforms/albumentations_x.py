"""What users of AlbumentationsX run, in a process of its own; prints what it found as JSON."""

import hashlib
import json
import pickle
import sys

import albumentations as A
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.albumentations import RandomFog, RandomRain, RandomSnow, RandomWeather

SCENE = sys.argv[1]
KEY = "000001_front"
frame = WeatherScene.load(SCENE).frame((1, "front"))
SAMPLE = {
    "image": np.array(frame.image),
    "mask": np.array(frame.label),
    "depth": np.array(frame.depth_m, np.float32),
}
STACK = {f"{name}s": np.stack([value] * 3) for name, value in SAMPLE.items()}
POLICY = WeatherPolicy.snow((2.0, 4.0))


def digest(done):
    text = b"".join(np.ascontiguousarray(done[name]).tobytes() for name in ("image", "mask"))
    return hashlib.sha256(text).hexdigest()


class Named(Dataset):
    def __init__(self, named):
        self.pipeline = A.Compose([RandomWeather(POLICY, p=0.7)], seed=3)
        self.named = named

    def __len__(self):
        return 8

    def __getitem__(self, index):
        name = {"sample_key": index} if self.named else {}
        return index, digest(self.pipeline(**SAMPLE, **name))


def items(named, workers, start=None):
    how = {"num_workers": workers, "multiprocessing_context": start, "batch_size": None}
    return dict(DataLoader(Named(named), **how))


def changed(done):
    return bool((done["image"] != SAMPLE["image"]).any())


def main():
    found = {"version": A.__version__, "hook": hasattr(A.BasicTransform, "sample_parameters")}
    pipeline = A.Compose([RandomWeather(POLICY, p=1.0)], strict=True, seed=5)
    done = pipeline(**SAMPLE, sample_key=("a", 1))
    found["picture"] = digest(done)
    found["shapes"] = [done["image"].shape == (48, 64, 3), done["mask"].shape == (48, 64)]
    found["written"] = [
        digest(each(**SAMPLE, sample_key=("a", 1))) == found["picture"]
        for each in (
            A.from_dict(json.loads(json.dumps(A.to_dict(pipeline)))),
            pickle.loads(pickle.dumps(pipeline)),
        )
    ]
    units = [RandomRain((20, 75), p=1.0), RandomSnow((1, 2), p=1.0), RandomFog((50, 60), p=1.0)]
    found["units"] = [
        changed(t(**SAMPLE)) and A.to_dict(A.from_dict(A.to_dict(t))) == A.to_dict(t) for t in units
    ]
    runs = [A.Compose([RandomWeather(POLICY, p=0.7)], seed=s) for s in (1, 1, 2)]
    digests = [[digest(each(**SAMPLE)) for _ in range(4)] for each in runs]
    found["seeds"] = [digests[0] == digests[1], digests[0] != digests[2]]
    declared = A.Compose(
        [RandomFog((20, 30), p=1.0), A.HorizontalFlip(p=1.0)],
        additional_targets={"depth": "mask"},
    )(**SAMPLE, sample_key=1)
    plain = A.Compose([RandomFog((20, 30), p=1.0)])(**SAMPLE, sample_key=1)
    found["depth as a mask"] = [
        bool((declared["depth"].squeeze() == SAMPLE["depth"][:, ::-1]).all()),
        bool((declared["mask"] == plain["mask"][:, ::-1]).all()),
        bool((plain["mask"] == 255).any()),
    ]
    boxed = A.Compose(
        [RandomSnow(p=1.0)],
        bbox_params=A.BboxParams("pascal_voc", label_fields=["classes"]),
        keypoint_params=A.KeypointParams("xy"),
    )(
        **SAMPLE,
        bboxes=[[1, 2, 30, 40]],
        classes=["car"],
        keypoints=[[3, 4]],
        masks=[SAMPLE["mask"]],
    )
    found["moves nothing"] = [
        bool(np.allclose(boxed["bboxes"], [[1, 2, 30, 40]], atol=1e-3)),
        bool(np.allclose(boxed["keypoints"], [[3, 4]], atol=1e-3)),
        bool((np.asarray(boxed["masks"][0]).squeeze() == SAMPLE["mask"]).all()),
    ]
    arrays = A.Compose([RandomSnow(p=1.0)])(**STACK, sample_key=1)
    lists = {name: list(value) for name, value in STACK.items()}
    listed = A.Compose([RandomSnow(p=1.0)])(**lists, sample_key=1)
    alone = RandomSnow(p=1.0)(**STACK, sample_key=1)
    found["stack"] = [
        bool((np.stack(listed["images"]) == arrays["images"]).all()),
        bool((np.stack(listed["masks"]) == arrays["masks"]).all()),
        bool((alone["images"] == arrays["images"]).all()),
        arrays["masks"].shape == STACK["masks"].shape,
        bool((arrays["images"][0] != arrays["images"][1]).any()),
    ]
    recorder = A.ReplayCompose([RandomSnow(p=1.0)])
    recorded = recorder(**SAMPLE)
    replayed = A.ReplayCompose.replay(json.loads(json.dumps(recorded["replay"])), **SAMPLE)
    found["replay"] = [digest(replayed) == digest(recorded), changed(recorded)]
    scene = RandomWeather(POLICY, p=1.0, scenes=[SCENE])
    in_scene = A.Compose([scene])(
        image=SAMPLE["image"], mask=SAMPLE["mask"], scene_key=KEY, sample_key=1
    )
    drawn = scene.drawn({"sample_key": 1}, None)
    shot = WeatherScene.load(SCENE).render((1, "front"), drawn.weather, seed=drawn.seed)
    found["scene"] = [
        in_scene["image"].tobytes() == shot.image.tobytes(),
        bool((in_scene["mask"] == shot.label).all()),
    ]
    tensor = torch.from_numpy(SAMPLE["image"]).permute(2, 0, 1)
    found["tensor"] = list(A.Compose([RandomSnow(p=1.0)])(image=tensor)["image"].shape)
    expected = items(True, 0)
    found["named in workers"] = [
        items(True, *how) == expected for how in ((1,), (2,), (2, "spawn"))
    ]
    found["named apart"] = len({*expected.values()})
    found["unnamed apart"] = len({*items(False, 2).values()})
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
