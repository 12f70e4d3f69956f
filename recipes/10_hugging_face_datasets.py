"""Weather in a Hugging Face dataset: one function for `with_transform`.

python recipes/10_hugging_face_datasets.py      (needs: pip install datasets)
"""

from __future__ import annotations

import numpy as np
import torch
from datasets import Dataset, Features, Image, Value
from PIL import Image as Picture
from torch.utils.data import DataLoader

import weather_aug as wa
from weather_aug.transforms.huggingface import RandomWeather


def street(frames: int, width: int, height: int) -> Dataset:
    """Frames of the procedural street, as a data set of the hub would hold them."""
    clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
    shots = [clip.frame(key) for key in clip.keys[:frames]]
    columns = {
        "image": [Picture.fromarray(shot.image) for shot in shots],
        "annotation": [Picture.fromarray(shot.label) for shot in shots],
        "id": [str(shot.key) for shot in shots],
    }
    return Dataset.from_dict(
        columns, Features({"image": Image(), "annotation": Image(), "id": Value("string")})
    )


def collate(rows: list[dict]) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures of PIL as a batch of tensors."""
    images = [torch.from_numpy(np.array(row["image"])).permute(2, 0, 1) for row in rows]
    labels = [torch.from_numpy(np.array(row["annotation"])).long() for row in rows]
    return torch.stack(images), torch.stack(labels)


def main(frames: int = 4, width: int = 320, height: int = 180) -> None:
    """Two epochs of one data set, in other weathers."""
    policy = wa.WeatherPolicy(types={"rain": 2, "snow": 2, "fog": 1})
    # With `sample` an item's weather hangs on its id and the epoch, on no worker and no order.
    weather = RandomWeather(policy, p=0.7, mask="annotation", sample="id")
    dataset = street(frames, width, height).with_transform(weather)
    loader = DataLoader(dataset, batch_size=2, collate_fn=collate)
    for epoch in range(2):
        weather.set_epoch(epoch)
        for images, labels in loader:
            ignored = (labels == 255).float().mean()
            print(f"epoch {epoch}: images {tuple(images.shape)}, ignored {ignored:.1%}")


if __name__ == "__main__":
    main()
