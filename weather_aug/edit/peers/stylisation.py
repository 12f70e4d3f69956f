"""Stylisation: a style network paints the clip like a picture of the weather, one style for all.

Two networks of Magenta: one reads a picture's style as 100 numbers, the other paints a picture of
any size with them, by the mean and scale that its layers' features get. As in stylised 3D scenes,
one vector holds for the whole clip; what a picture's own features are is still found picture by
picture, so that it flickers a little where they change.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._extras import require
from weather_aug._files import sha256_of_file
from weather_aug.clip.images import read_image
from weather_aug.clip.types import Frame
from weather_aug.edit.background import STYLES, Moment
from weather_aug.edit.peers.options import PeerOptions, check_style
from weather_aug.edit.peers.pictures import fitted, restored
from weather_aug.edit.weights import readable
from weather_aug.errors import ArgumentError, DataError, printable

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]

ENDINGS = (".png", ".jpg", ".jpeg")
READER, PAINTER = "*predict*.tflite", "*transfer*.tflite"
"""Names of the networks' files."""
STYLE_NUMBERS = 100
_FROM = (
    "https://storage.googleapis.com/download.tensorflow.org/models/tflite/task_library/"
    "style_transfer/android/magenta_arbitrary-image-stylization-v1-256_int8_{}_1.tflite"
)
_TO = "stylise backgrounds"


class Stylisation:
    """A `BackgroundEditor` that paints with the style of a picture of each weather.

    Options: `weights` (folder of both networks), `pictures` (folder with rain, snow, fog, each .png
    or .jpg); a weather without a picture is none of its styles.

    Convention:
        As `BackgroundEditor`. Nothing is random; the networks run on one thread of the CPU.

    Source:
        Ghiasi et al., "Exploring the structure of a real-time, arbitrary neural artistic
        stylization network", BMVC 2017.
    """

    name = "stylisation"

    def __init__(
        self,
        painter: Painter,
        vectors: Mapping[str, Float32],
        card: Mapping[str, Any],
        rows: int | None,
    ) -> None:
        self._painter, self._vectors = painter, dict(vectors)
        self._card, self._rows = dict(card), rows

    @classmethod
    def load(cls, options: PeerOptions) -> Stylisation:
        """Read networks and pictures, and each picture's style.

        Raises:
            ArgumentError: If an option is not of this peer, or one of its folders is not given.
            DataError: If a network or the pictures are not there, or one cannot be read.
            MissingExtraError: If ai-edge-litert is not installed.
        """
        options = options.of(cls.name, weights=None, pictures=None)
        paths = style_pictures(options.pictures)
        reader_path, painter_path = _networks(options.weights)
        reader = StyleReader(reader_path)
        vectors = {style: reader.style_of(read_image(path)) for style, path in paths.items()}
        card = {
            "editor": cls.name,
            "reader_sha256": sha256_of_file(reader_path),
            "painter_sha256": sha256_of_file(painter_path),
            "pictures_sha256": {style: sha256_of_file(path) for style, path in paths.items()},
            "versions": {"ai-edge-litert": version("ai-edge-litert")},
            **options.card("height"),
        }
        return cls(Painter(painter_path), vectors, card, options.height)

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is a picture of."""
        return tuple(style for style in STYLES if style in self._vectors)

    @property
    def card(self) -> Mapping[str, Any]:
        """Digests of networks and pictures, and options."""
        return self._card

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `BackgroundEditor.edit`."""
        check_style(style, self.styles)
        return tuple(self._edited(frame, style) for frame in moment.now)

    def _edited(self, frame: Frame, style: str) -> UInt8:
        painted = self._painter.painted(fitted(frame.image, self._rows), self._vectors[style])
        return restored(painted, frame, self._rows)


class StyleReader:
    """The network that reads a picture's style.

    Raises:
        DataError: If the file is no such network.
        MissingExtraError: If ai-edge-litert is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._network = _interpreter(path)
        with readable(path):
            self._network.allocate_tensors()
            (self._into,), (self._out,) = _ends(self._network)
            self._side = int(self._into["shape"][1])

    def style_of(self, image: UInt8) -> Float32:
        """(100,) of the middle square of a picture (H, W, 3)."""
        side = min(image.shape[:2])
        top, left = ((length - side) // 2 for length in image.shape[:2])
        square = image[top : top + side, left : left + side]
        small = cv2.resize(square, (self._side, self._side), interpolation=cv2.INTER_AREA)
        self._network.set_tensor(self._into["index"], small[None].astype(np.float32) / 255)
        self._network.invoke()
        style = np.asarray(self._network.get_tensor(self._out["index"]), np.float32)
        return style.reshape(STYLE_NUMBERS)


class Painter:
    """The network that paints a picture in a style.

    Raises:
        DataError: If the file is no such network.
        MissingExtraError: If ai-edge-litert is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._network = _interpreter(path)
        with readable(path):
            into, (self._out,) = _ends(self._network)
            (self._content,) = (end for end in into if int(end["shape"][-1]) == 3)
            (self._style,) = (end for end in into if int(end["shape"][-1]) == STYLE_NUMBERS)
        self._size: tuple[int, int] | None = None

    def painted(self, image: UInt8, style: Float32) -> Float32:
        """A picture (H, W, 3) of sides that 8 divides, in a style (100,); in [0, 1]."""
        size = (image.shape[0], image.shape[1])
        if self._size != size:
            self._network.resize_tensor_input(self._content["index"], [1, *size, 3])
            self._network.allocate_tensors()
            self._size = size
        self._network.set_tensor(self._content["index"], image[None].astype(np.float32) / 255)
        self._network.set_tensor(self._style["index"], style.reshape(1, 1, 1, STYLE_NUMBERS))
        self._network.invoke()
        return np.asarray(self._network.get_tensor(self._out["index"])[0], np.float32)


def style_pictures(folder: Path | None) -> dict[str, Path]:
    """The picture of each weather in a folder.

    Raises:
        ArgumentError: If no folder is given.
        DataError: If it holds a picture of no weather, or two of one.
    """
    names = ", ".join(STYLES)
    if folder is None:
        raise ArgumentError(f"give pictures=FOLDER with a picture of each weather: {names}")
    found: dict[str, Path] = {}
    for style in STYLES:
        paths = [path for end in ENDINGS if (path := Path(folder) / f"{style}{end}").is_file()]
        if len(paths) > 1:
            raise DataError(f"{printable(folder, 200)} holds two pictures of {style}; keep one")
        if paths:
            found[style] = paths[0]
    if not found:
        raise DataError(
            f"{printable(folder, 200)} holds no picture of a weather; put {names} there, each "
            f"as {' or '.join(ENDINGS[:2])}, or use editor='physical', which needs none"
        )
    return found


def _networks(folder: Path | None) -> tuple[Path, Path]:
    where = "nothing is given" if folder is None else printable(folder, 200)
    found = [sorted(Path(folder).glob(name)) if folder else [] for name in (READER, PAINTER)]
    if any(len(paths) != 1 for paths in found):
        raise DataError(
            "the style networks arbitrary-image-stylization-v1-256 of Magenta (licence: "
            f"Apache-2.0) are not on this machine ({where} as weights, which must hold one "
            f"{READER} and one {PAINTER}); fetch them with `curl -O {_FROM.format('prediction')} "
            f"-O {_FROM.format('transfer')}` and give that folder, or use editor='physical', "
            "which needs no weights"
        )
    return found[0][0], found[1][0]


def _interpreter(path: Path) -> Any:
    litert = require("ai_edge_litert.interpreter", extra="stylisation", to=_TO)
    with readable(path):
        return litert.Interpreter(str(path), num_threads=1)


def _ends(network: Any) -> tuple[list[Any], list[Any]]:
    return list(network.get_input_details()), list(network.get_output_details())
