"""Reconstruct a scene and measure it: `python -m benchmarks.reconstruction SCENE --scale 0.5`.

It takes minutes, so `make bench` leaves it out. What is held out is every fifth time step.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from benchmarks.report import Row, show, write_results
from weather_aug import WeatherScene
from weather_aug.clip.types import Frame
from weather_aug.gaussians.draw import view
from weather_aug.gaussians.fit import fit
from weather_aug.gaussians.frames import resized, split
from weather_aug.gaussians.gather import camera_of
from weather_aug.gaussians.labels import fit_labels, recorded_support
from weather_aug.gaussians.options import FitOptions
from weather_aug.gaussians.styles import fit_styles
from weather_aug.gaussians.types import Reconstruction, Style
from weather_aug.scene.reconstruct import styled_frame
from weather_aug.taxonomy import IGNORE

OUT = Path("out/bench")
HELD_OUT = 5
STYLES = ("rain", "snow", "fog", "clear")


def measure(
    scene: Path,
    /,
    name: str,
    scale: float = 1.0,
    steps: int = 6000,
    count: int = 100_000,
    densify: str = "relocation",
    threads: int = 2,
    minutes: float = 45.0,
    least_db: float = 24.0,
    styles: bool = True,
) -> None:
    """Fit, label and style a scene; write numbers and pictures of held-out frames.

    Args:
        scene: Folder of a built scene.
        name: Of the files that are written.
        scale: Of the frames' sides.
        steps: Of the fit.
        count: Of Gaussians, at the most.
        densify: "relocation", "gradient" or "none".
        threads: Of the rasteriser.
        minutes: Target for the fit.
        least_db: Target for the PSNR of held-out frames.
        styles: Whether to fit one and four weathers, too.
    """
    source = WeatherScene.load(scene)
    frames = [resized(source.frame(key), scale) for key in source.keys]
    options = FitOptions(
        steps=steps, count=count, densify=densify, threads=threads, held_out=HELD_OUT
    )
    found = fit(frames, options, progress=True)
    learnt, held_out = split(frames, HELD_OUT)
    record = found.record
    rows = [
        Row("Gaussians", record["gaussians"]),
        Row("time of the fit", record["minutes"], "min", at_most=minutes),
        Row("PSNR, learnt frames", record["psnr_db"], "dB"),
        Row("SSIM, learnt frames", record["ssim"]),
        Row("PSNR, held-out frames", record["held_out_psnr_db"], "dB", at_least=least_db),
        Row("SSIM, held-out frames", record["held_out_ssim"]),
    ]
    reconstruction = found.reconstruction
    more, reconstruction = _labels(reconstruction, learnt, held_out, threads)
    rows += more
    if styles:
        edited = {
            style: _edited(source, learnt, style, scale) for style in STYLES if style != "clear"
        }
        edited["clear"] = learnt
        rows += _styles(reconstruction, edited, record["minutes"], threads)
    title = f"{name}: {frames[0].camera.width}x{frames[0].camera.height}, {len(frames)} frames"
    result = show(title, rows)
    write_results(OUT / f"reconstruction-{name}.json", {"rows": result, "record": record})
    _pictures(reconstruction, held_out, OUT / f"reconstruction-{name}.png")


def _labels(
    reconstruction: Reconstruction, learnt: Sequence[Frame], held_out: Sequence[Frame], threads: int
) -> tuple[list[Row], Reconstruction]:
    if any(frame.label is None for frame in learnt):
        support = recorded_support(reconstruction, learnt, threads=threads)
        return [], replace(reconstruction, support=support)
    labelled = fit_labels(reconstruction, learnt, threads=threads)
    right = [
        np.mean(_drawn_label(labelled, f)[known] == f.label[known]) for f, known in _known(learnt)
    ]
    pairs = [(_drawn_label(labelled, f)[known], f.label[known]) for f, known in _known(held_out)]
    drawn, recorded = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return [
        Row("labels that agree, learnt frames", 100 * float(np.mean(right)), "%", at_least=95),
        Row("mIoU of labels, held-out frames", 100 * _mean_iou(drawn, recorded), "%"),
    ], labelled


def _known(frames: Sequence[Frame]) -> list[tuple[Any, NDArray[np.bool_]]]:
    return [(frame, np.asarray(frame.label != IGNORE)) for frame in frames]


def _drawn_label(reconstruction: Reconstruction, frame: Frame) -> NDArray[np.uint8]:
    camera = camera_of(reconstruction, frame)
    label = view(reconstruction, camera, frame.time_s, want=("label",)).label
    assert label is not None
    return label


def _mean_iou(drawn: NDArray[np.uint8], recorded: NDArray[np.uint8]) -> float:
    """Over the classes that were recorded."""
    shares = []
    for index in np.unique(recorded):
        both = np.sum((drawn == index) & (recorded == index))
        shares.append(both / np.sum((drawn == index) | (recorded == index)))
    return float(np.mean(shares))


def _edited(source: WeatherScene, frames: Sequence[Frame], style: str, scale: float) -> list[Frame]:
    edited = []
    for frame in frames:
        record = source.manifest.by_key[frame.key]
        whole = styled_frame(source.path, source.manifest, record, source.frame(frame.key), style)
        edited.append(resized(whole, scale))
    return edited


def _styles(
    reconstruction: Reconstruction, edited: dict[str, list[Frame]], fit_minutes: float, threads: int
) -> list[Row]:
    """What four weathers cost beside one: of time and of bytes, each with the scene itself."""
    minutes, bytes_ = [], []
    for names in (STYLES[:1], STYLES):
        started = time.perf_counter()
        styled = fit_styles(reconstruction, {name: edited[name] for name in names}, threads=threads)
        minutes.append(fit_minutes + (time.perf_counter() - started) / 60)
        bytes_.append(_bytes_of(styled))
    return [
        Row("styles: time of one", minutes[0] - fit_minutes, "min"),
        Row("styles: time of four", minutes[1] - fit_minutes, "min"),
        Row("scene and four styles / one: time", minutes[1] / minutes[0], "x", at_most=1.5),
        Row("scene and four styles / one: bytes", bytes_[1] / bytes_[0], "x", at_most=1.6),
    ]


def _bytes_of(reconstruction: Reconstruction) -> int:
    parts: list[Any] = [reconstruction.sky.faces, reconstruction.support, reconstruction.offsets_m]
    for gaussians in (reconstruction.background, reconstruction.actor_gaussians):
        parts += [getattr(gaussians, name) for name in gaussians.__dataclass_fields__]
    for style in reconstruction.styles.values():
        parts += [getattr(style, name) for name in Style.__dataclass_fields__]
    return sum(part.nbytes for part in parts)


def _pictures(reconstruction: Reconstruction, frames: Sequence[Frame], path: Path) -> None:
    """Drawn above recorded, three held-out frames."""
    columns = []
    for frame in frames[:: max(len(frames) // 3, 1)][:3]:
        camera = camera_of(reconstruction, frame)
        image = view(reconstruction, camera, frame.time_s, key=frame.key, want=("image",)).image
        assert image is not None
        columns.append(np.concatenate([image, frame.image]))
    sizes = {column.shape for column in columns}
    Image.fromarray(np.concatenate(columns, axis=int(len(sizes) == 1))).save(path)


if __name__ == "__main__":
    tyro.cli(measure)
