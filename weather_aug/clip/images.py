"""Pictures and label maps from disk: PNG and JPEG, measured before they are decoded.

The header decides, not the file's name: size and kind are checked on the first bytes, so that a
file of a few kilobytes that claims a billion pixels costs nothing. Pillow decodes, because it
refuses truncated data where OpenCV returns a wrong picture without a word.
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, JpegImagePlugin, PngImagePlugin

from weather_aug._checks import MAX_PIXELS
from weather_aug.errors import ClipError, printable

Scalar = TypeVar("Scalar", bound=np.generic)

MAX_FILE_BYTES = 256 * 2**20
MAX_PIXELS_PER_BYTE = 2000

_PNG_MAGIC, _JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_PNG_END, _JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
_TAIL_BYTES = 2**16
_GREY, _PALETTE = 0, 3
_DECODER_FAULTS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    MemoryError,
    OverflowError,
    LookupError,
    TypeError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


class ImageHeader(NamedTuple):
    """What the first bytes of an image file declare."""

    kind: str
    """"PNG" or "JPEG"."""
    width: int
    height: int
    bits: int
    """Bits a channel."""
    colour_type: int
    """PNG's colour type (0 grey, 2 RGB, 3 palette, 4 grey + alpha, 6 RGBA); JPEG's channels."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an 8-bit PNG or JPEG as (H, W, 3) uint8 RGB.

    Grey becomes three equal channels, a palette its colours, an alpha channel is accepted only
    where it is opaque everywhere. EXIF rotation, colour profiles, text and further frames of an
    animation are not applied.

    Raises:
        ClipError: If the file is missing, neither PNG nor JPEG, larger than 256 MiB or 64
            megapixels, truncated or damaged, of 16 bits, CMYK, or partly transparent.
    """
    data, header = _checked_bytes(path)
    if header.bits > 8:
        raise ClipError(f"{_shown(path)} has {header.bits} bits a channel; convert it to 8 bits")
    with _opened(path, data, header) as picture:
        if picture.mode == "CMYK":
            raise ClipError(f"{_shown(path)} is a CMYK JPEG; convert it to RGB")
        see_through = picture.mode in ("LA", "RGBA", "PA") or "transparency" in picture.info
        decoded = _decoded(path, picture, "RGBA" if see_through else "RGB")
    if see_through and decoded[..., 3].min() < 255:
        raise ClipError(f"{_shown(path)} is partly transparent; flatten it onto a background")
    return np.ascontiguousarray(decoded[..., :3])


def read_label(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Read a label PNG as (H, W) ids: grey of 8 or 16 bits, or a palette's indices.

    Raises:
        ClipError: If the file is not such a PNG, or is missing, too large, truncated or damaged.
    """
    data, header = _checked_bytes(path)
    if header.kind != "PNG":
        raise ClipError(f"{_shown(path)} is a JPEG, which changes label ids; store labels as PNG")
    single = header.colour_type == _PALETTE or (
        header.colour_type == _GREY and header.bits in (8, 16)
    )
    if not single:
        raise ClipError(
            f"{_shown(path)} has colour type {header.colour_type} with {header.bits} bits; a label "
            "must be a grey PNG of 8 or 16 bits or a palette PNG whose indices are the ids"
        )
    with _opened(path, data, header) as picture:
        decoded = _decoded(path, picture, None)
    if decoded.dtype == np.uint8:
        return decoded
    return decoded.astype(np.uint16)


def image_header(path: Path) -> ImageHeader:
    """Kind and size of a PNG or JPEG file, without decoding it.

    Raises:
        ClipError: As `read_image`, for what the header shows.
    """
    return _checked_bytes(path)[1]


def resized_image(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(H, W, 3) picture averaged down to `width` x `height`."""
    if image.shape[:2] == (height, width):
        return image
    smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, np.uint8)


def resized_label(label: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(H, W) label sampled to `width` x `height`; ids are never mixed."""
    if label.shape == (height, width):
        return label
    sampled = cv2.resize(label, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(sampled, np.uint8)


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return `array`, locked against writing."""
    array.flags.writeable = False
    return array


def _checked_bytes(path: Path) -> tuple[bytes, ImageHeader]:
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise ClipError(f"{_shown(path)} has {size} bytes, more than {MAX_FILE_BYTES}")
        data = path.read_bytes()
    except FileNotFoundError:
        raise ClipError(f"{_shown(path)} is missing; restore the file") from None
    except OSError as error:
        raise ClipError(f"{_shown(path)} cannot be read: {error.strerror}") from None
    header = _header(path, data)
    pixels = header.width * header.height
    if not 0 < pixels <= min(MAX_PIXELS, MAX_PIXELS_PER_BYTE * len(data)):
        raise ClipError(
            f"{_shown(path)} claims {header.width}x{header.height} pixels in {len(data)} bytes; "
            f"up to {MAX_PIXELS} pixels and {MAX_PIXELS_PER_BYTE} a byte are read"
        )
    # Pillow can be told, process-wide, to accept truncated files; the end mark is checked here so
    # that another library's switch does not turn half a picture into training data.
    end = _PNG_END if header.kind == "PNG" else _JPEG_END
    if end not in data[-_TAIL_BYTES:]:
        raise ClipError(f"{_shown(path)} is truncated: its end mark is missing; copy it again")
    return data, header


def _header(path: Path, data: bytes) -> ImageHeader:
    if data.startswith(_PNG_MAGIC) and data[12:16] == b"IHDR" and len(data) >= 26:
        width, height, bits, colour_type = struct.unpack(">IIBB", data[16:26])
        return ImageHeader("PNG", width, height, bits, colour_type)
    if data.startswith(_JPEG_MAGIC):
        return _jpeg_header(path, data)
    raise ClipError(
        f"{_shown(path)} is neither PNG nor JPEG (its first bytes are {data[:4].hex() or 'none'}); "
        "convert it to PNG"
    )


def _jpeg_header(path: Path, data: bytes) -> ImageHeader:
    """Walk the segments up to the frame header (ITU-T T.81, B.2.2)."""
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width, channels = struct.unpack(">BHHB", data[at + 4 : at + 10])
            return ImageHeader("JPEG", width, height, bits, channels)
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ClipError(f"{_shown(path)} is a JPEG without a frame header; copy it again")


def _opened(path: Path, data: bytes, header: ImageHeader) -> Image.Image:
    # The plug-in's class, not Image.open: that one warns about sizes and multi-picture files.
    plugin = PngImagePlugin.PngImageFile if header.kind == "PNG" else JpegImagePlugin.JpegImageFile
    try:
        return plugin(io.BytesIO(data))
    except _DECODER_FAULTS as error:
        raise _damaged(path, error) from None


def _decoded(path: Path, picture: Image.Image, mode: str | None) -> NDArray[np.uint8]:
    try:
        return np.array(picture if mode is None else picture.convert(mode))
    except _DECODER_FAULTS as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> ClipError:
    return ClipError(f"{_shown(path)} is damaged: {printable(error)}; copy it again")


def _shown(path: Path) -> str:
    return printable(path, 300)
