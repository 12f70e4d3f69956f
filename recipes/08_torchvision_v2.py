"""Weather as one line of a torchvision v2.Compose, with masks, depth and camera.

python recipes/08_torchvision_v2.py        (torchvision is yours: pip install torchvision)
"""

from __future__ import annotations

from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

import weather_aug as wa
from weather_aug.errors import MissingExtraError


class Streets(Dataset[Any]):
    """Recorded frames as (image, mask) tensors, weathered and cropped.

    The name of the sample makes its weather the same for any number of workers. Depth and camera
    are optional: without them depth is guessed from the mask.
    """

    def __init__(self, clip: wa.Clip, transform: Any) -> None:
        self.clip, self.transform = clip, transform

    def __len__(self) -> int:
        return len(self.clip.keys)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        from torchvision import tv_tensors

        from weather_aug.transforms.torchvision import Depth, SampleKey

        frame = self.clip.frame(self.clip.keys[index])
        image = tv_tensors.Image(torch.tensor(frame.image).permute(2, 0, 1))
        mask = tv_tensors.Mask(torch.tensor(frame.label, dtype=torch.int64))
        depth = Depth(torch.tensor(frame.depth_m))
        image, mask, *_ = self.transform(image, mask, depth, frame.camera, SampleKey(index))
        return image, mask


def main(frames: int = 2, width: int = 320, height: int = 180) -> None:
    """Two epochs of a procedural street, which differ in their weather and crops."""
    try:
        from weather_aug.transforms.torchvision import RandomWeather
    except MissingExtraError as error:
        print(error)
        return
    from torchvision.transforms import v2

    policy = wa.WeatherPolicy(types={"rain": 2, "snow": 2, "fog": 1})
    weather = RandomWeather(policy, p=0.7)
    transform = v2.Compose(
        [
            weather,
            v2.RandomCrop(128),
            v2.RandomHorizontalFlip(),
            v2.ToDtype(torch.float32, scale=True),
        ]
    )
    clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
    loader = DataLoader(Streets(clip, transform), batch_size=3, shuffle=True)
    for epoch in range(2):
        weather.set_epoch(epoch)
        for images, masks in loader:
            ignored = (masks == 255).float().mean()
            print(f"epoch {epoch}: images {tuple(images.shape)}, ignored {ignored:.1%}")


if __name__ == "__main__":
    main()
