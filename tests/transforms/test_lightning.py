"""WeatherDataset under Lightning: the hooks of recipes/11 tell it the epoch before it is asked."""

from __future__ import annotations

import importlib.util
import multiprocessing
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.dataset import WeatherDataset

lightning = pytest.importorskip("lightning")
RECIPE = Path(__file__).resolve().parents[2] / "recipes" / "11_lightning.py"
MIXED = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.6, 1.0))

pytestmark = [
    # Lightning's own: hints for long trainings, and what it calls of newer versions of torch.
    pytest.mark.filterwarnings("ignore::UserWarning:lightning"),
    pytest.mark.filterwarnings("ignore::FutureWarning:lightning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:lightning"),
]


def recipe() -> Any:
    spec = importlib.util.spec_from_file_location("lightning_recipe", RECIPE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recording(
    dataset: WeatherDataset, workers: int, hooks: bool = True, ahead_s: float = 0.0
) -> Any:
    """The recipe's module, which writes down the pictures it is trained on.

    `ahead_s` is how long workers fetch before the hook of an epoch is called.
    """

    class Recording(recipe().Segmentation):
        def train_dataloader(self) -> DataLoader:
            if hooks:
                super().train_dataloader()
            how: dict[str, Any] = {"num_workers": workers, "persistent_workers": workers > 0}
            if workers:
                how["multiprocessing_context"] = multiprocessing.get_context("fork")
            return DataLoader(self.dataset, batch_size=2, **how)

        def on_train_epoch_start(self) -> None:
            self.seen: list[torch.Tensor] = []
            time.sleep(ahead_s)
            if hooks:
                super().on_train_epoch_start()

        def training_step(self, batch: dict, index: int) -> torch.Tensor:
            self.seen += batch["image"]
            return super().training_step(batch, index)

    return Recording(dataset)


def trained(module: Any, folder: Path, epochs: int, checkpoint: Path | None = None) -> Any:
    trainer = lightning.Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
    )
    trainer.fit(module, ckpt_path=checkpoint)
    return trainer


def pictures(scene: Any, epoch: int) -> torch.Tensor:
    dataset = WeatherDataset([scene], MIXED)
    dataset.set_epoch(epoch)
    return torch.stack([dataset[index]["image"] for index in range(len(dataset))])


@pytest.mark.parametrize("workers", [0, 1])
def test_each_epoch_has_its_own_weather(tiny_scene: Any, tmp_path: Path, workers: int) -> None:
    """And a training that is resumed has that of the epoch it resumes with."""
    first = recording(WeatherDataset([tiny_scene], MIXED), workers)
    trainer = trained(first, tmp_path, epochs=2)
    assert (torch.stack(first.seen) == pictures(tiny_scene, 1)).all()
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    resumed = recording(WeatherDataset([tiny_scene], MIXED), workers, ahead_s=workers)
    trained(resumed, tmp_path, epochs=3, checkpoint=tmp_path / "last.ckpt")
    assert (torch.stack(resumed.seen) == pictures(tiny_scene, 2)).all()


def test_without_the_hooks_weather_repeats(tiny_scene: Any, tmp_path: Path) -> None:
    """So the check above can fail."""
    module = recording(WeatherDataset([tiny_scene], MIXED), workers=0, hooks=False)
    trained(module, tmp_path, epochs=2)
    assert (torch.stack(module.seen) == pictures(tiny_scene, 0)).all()
