"""Weather of each sample drawn on the fly, in a torch DataLoader.

python recipes/01_weather_in_a_dataloader.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from torch.utils.data import DataLoader

import weather_aug as wa


def main(frames: int = 2, width: int = 320, height: int = 180) -> None:
    """Build a small scene, then run two epochs that differ in their weather only."""
    with tempfile.TemporaryDirectory() as folder:
        clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
        scene = wa.WeatherScene.build(clip, Path(folder) / "street")

        policy = wa.WeatherPolicy(types={"clear": 1, "rain": 2, "snow": 2, "fog": 1})
        dataset = wa.WeatherDataset([scene], policy, seed=0, crop=(128, 128))
        loader = DataLoader(dataset, batch_size=3, shuffle=True)

        for epoch in range(2):
            dataset.set_epoch(epoch)
            for batch in loader:
                ignored = (batch["label"] == 255).float().mean()
                print(f"epoch {epoch}: images {tuple(batch['image'].shape)}, ignored {ignored:.1%}")


if __name__ == "__main__":
    main()
