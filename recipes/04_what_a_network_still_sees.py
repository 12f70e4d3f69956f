"""What a frozen network still sees: its labels in weather against its own on the clear picture.

python recipes/04_what_a_network_still_sees.py --weights deeplab.tflite scenes/kitti02 scenes/ddad02

The network maps a uint8 picture to Cityscapes train ids, such as google-coral/test_data's
deeplab_mobilenet_edgetpu_slim_cityscapes_quant.tflite. Without scenes a small street is built.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import weather_aug as wa
from weather_aug.clip.labelled import Teacher
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.render.options import EFFECTS
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.scores.agreement import Agreement, agreement
from weather_aug.severity import NAMED_SEVERITIES
from weather_aug.taxonomy import SKY

NONE = Agreement(np.zeros((19, 19), np.int64))
RISE, STEP = 0.01, 0.7  # A steady fall never rises by more; no step of a smooth one is more of it.


def teacher(weights: Path) -> Teacher:
    """The network of a TFLite file, as `LabelledClip` takes it, too."""
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise MissingExtraError("a TFLite network needs: pip install ai-edge-litert") from error
    if not weights.is_file():
        raise ArgumentError(f"weights: there is no file {weights}; give a TFLite network")
    network = Interpreter(str(weights), num_threads=1)
    network.allocate_tensors()
    into, out = network.get_input_details()[0], network.get_output_details()[0]

    def labels(image: np.ndarray) -> np.ndarray:
        # Letterboxed, a KITTI frame has 155 rows of 513 left, and half its road becomes sidewalk.
        squeezed = cv2.resize(image, into["shape"][2:0:-1].tolist(), interpolation=cv2.INTER_AREA)
        network.set_tensor(into["index"], squeezed[None])
        network.invoke()
        ids = network.get_tensor(out["index"])[0].astype(np.uint8)
        return cv2.resize(ids, image.shape[1::-1], interpolation=cv2.INTER_NEAREST)

    return labels


def compare(scene: wa.WeatherScene, see: Teacher, given: argparse.Namespace) -> list[list[float]]:
    """Print how far the network agrees with itself; (weathers, severities) pixel agreements."""
    keys = scene.keys[:: max(1, len(scene.keys) // given.frames)][: given.frames]
    clear = {key: see(scene.frame(key).image.copy()) for key in keys}
    # A blue sky that passes for a building is no label to keep: depth knows what is sky.
    sure = {key: (clear[key] == SKY) == np.isinf(scene.frame(key).depth_m) for key in keys}
    share, out = np.mean([mask.mean() for mask in sure.values()]), " ".join(given.without)
    print(f"{scene.name}, {len(keys)} frames, {share:.0%} of pixels, without {out or 'nothing'}")
    print(f"{'':16}agreement  flipped     mIoU  agreement where visible")
    # Without particles their veil stays: what is not drawn becomes extinction.
    count = 0 if "particles" in given.without else wa.RenderOptions.max_particles
    options = wa.RenderOptions(count, without=tuple(set(given.without) & set(EFFECTS)))
    found: list[list[float]] = []
    for kind in given.weathers:
        found.append([])
        for severity in given.severities:
            total = visible = NONE
            for key in keys:
                shot = scene.render(key, weather_of(kind, severity), seed=1, options=options)
                seen = see(shot.image.copy())
                total += agreement(clear[key], seen, mask=sure[key])
                visible += agreement(clear[key], seen, mask=sure[key] & (shot.invalid == 0))
            found[-1].append(total.pixel_agreement)
            row = total.pixel_agreement, total.flipped, total.miou, visible.pixel_agreement
            print(f"{kind + ' ' + severity:16}" + "".join(f"{v:9.3f}" for v in row), flush=True)
        print(f"{kind}: {verdict(found[-1])}")
    return found


def verdict(agreements: Sequence[float]) -> str:
    """Whether agreement falls, from 1 in clear weather, and whether one step takes it all."""
    steps, fall = -np.diff([1.0, *agreements]), 1.0 - agreements[-1]
    if (steps < -RISE).any():
        return f"does not fall steadily: rises by {-steps.min():.3f} at step {steps.argmin() + 1}"
    if fall <= RISE:
        return "does not fall"
    how = "smoothly" if steps.max() <= STEP * fall else "with a jump"
    return f"falls {how}: by {fall:.3f} in all, {steps.max():.3f} at step {steps.argmax() + 1}"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--weathers", nargs="+", default=list(TYPES[1:]))
    parser.add_argument("--severities", nargs="+", default=list(NAMED_SEVERITIES))
    parser.add_argument("--frames", type=int, default=4, help="of each scene, evenly apart")
    parser.add_argument("--without", choices=("particles", *EFFECTS), nargs="+", default=[])
    return parser.parse_args(words)


def main() -> None:
    """Compare on the scenes given, or on a small street."""
    given = arguments()
    see, scenes = teacher(given.weights), [wa.WeatherScene.load(path) for path in given.scenes]
    with tempfile.TemporaryDirectory() as folder:
        if not scenes:
            clip = wa.open_clip("street:?frames=2&width=320&height=180")
            scenes = [wa.WeatherScene.build(clip, Path(folder) / "street")]
        for scene in scenes:
            compare(scene, see, given)


if __name__ == "__main__":
    main()
