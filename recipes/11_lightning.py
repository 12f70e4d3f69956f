"""WeatherDataset under Lightning: nothing to adapt, and one line that tells it the epoch.

python recipes/11_lightning.py      (needs: pip install lightning)
"""

from __future__ import annotations

import logging
import tempfile
import warnings
from pathlib import Path

import lightning
import torch
from torch import nn
from torch.utils.data import DataLoader

import weather_aug as wa

CLASSES, IGNORE = 19, 255


class Segmentation(lightning.LightningModule):
    """A net of four layers; the hooks below are all that weather asks for."""

    def __init__(self, dataset: wa.WeatherDataset) -> None:
        super().__init__()
        self.dataset = dataset
        self.net = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=4, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, CLASSES, 3, padding=1),
            nn.Upsample(scale_factor=4, mode="bilinear"),
        )
        self.losses: list[float] = []

    def train_dataloader(self) -> DataLoader:
        """A training that is resumed starts in a later epoch, and workers fetch before the hook."""
        self.dataset.set_epoch(self.current_epoch)
        return DataLoader(self.dataset, batch_size=2, shuffle=True)

    def on_train_epoch_start(self) -> None:
        """Each epoch in other weathers, in persistent workers, too."""
        self.dataset.set_epoch(self.current_epoch)

    def training_step(self, batch: dict, index: int) -> torch.Tensor:
        """Hidden pixels are 255 in the label, so the loss leaves them out."""
        logits = self.net(batch["image"] / 255)
        loss = nn.functional.cross_entropy(logits, batch["label"], ignore_index=IGNORE)
        self.losses.append(loss.item())
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Plain Adam."""
        return torch.optim.Adam(self.parameters(), lr=5e-3)


def main(frames: int = 4, width: int = 320, height: int = 180) -> None:
    """Train two epochs on a CPU, and leave no files."""
    # So short a training needs none of the hints for long ones.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*does not have many workers")
    lightning.seed_everything(0, verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
        scene = wa.WeatherScene.build(clip, Path(folder) / "street")
        policy = wa.WeatherPolicy(types={"clear": 1, "rain": 2, "snow": 2, "fog": 1})
        module = Segmentation(wa.WeatherDataset([scene], policy, seed=0, crop=(128, 256)))
        trainer = lightning.Trainer(
            max_epochs=2,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=folder,
        )
        trainer.fit(module)
    print(f"{trainer.current_epoch} epochs, loss {module.losses[0]:.2f} -> {module.losses[-1]:.2f}")


if __name__ == "__main__":
    main()
