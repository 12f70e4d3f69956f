"""Reading pictures: what is accepted is exact, the rest is one typed error naming the file."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile

from weather_aug.clip.images import image_header, read_image, read_label
from weather_aug.errors import ClipError

RGB = np.random.default_rng(0).integers(0, 256, (17, 23, 3), dtype=np.uint8)


def _saved(path: Path, picture: Image.Image, **options: object) -> Path:
    picture.save(path, **options)
    return path


def _png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    data = zlib.compress(bytes(100_000))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    )


def test_png_comes_back_exactly_whatever_its_name(tmp_path: Path) -> None:
    path = _saved(tmp_path / "really_a.jpg", Image.fromarray(RGB), format="PNG")
    np.testing.assert_array_equal(RGB, read_image(path))


def test_grey_and_palette_pictures_become_rgb(tmp_path: Path) -> None:
    grey = Image.fromarray(RGB[..., 0])
    expected = np.repeat(RGB[..., :1], 3, axis=2)
    np.testing.assert_array_equal(expected, read_image(_saved(tmp_path / "g.png", grey)))
    palette = Image.fromarray(RGB).quantize(8)
    expected = np.array(palette.convert("RGB"))
    np.testing.assert_array_equal(expected, read_image(_saved(tmp_path / "p.png", palette)))


def test_opaque_alpha_is_dropped_and_transparency_refused(tmp_path: Path) -> None:
    opaque = np.dstack([RGB, np.full((17, 23), 255, np.uint8)])
    path = _saved(tmp_path / "opaque.png", Image.fromarray(opaque))
    np.testing.assert_array_equal(RGB, read_image(path))
    opaque[3, 4, 3] = 254
    path = _saved(tmp_path / "glass.png", Image.fromarray(opaque))
    with pytest.raises(ClipError, match=r"glass\.png.*transparent; flatten"):
        read_image(path)


def test_palette_with_transparency_leaves_no_warning(tmp_path: Path) -> None:
    palette = Image.fromarray(RGB).quantize(4)
    path = _saved(tmp_path / "p.png", palette, transparency=bytes([0, 255, 255, 255]))
    with pytest.raises(ClipError, match="transparent"):
        read_image(path)


def test_exif_rotation_is_not_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    path = _saved(tmp_path / "turned.jpg", Image.fromarray(RGB), exif=exif)
    assert read_image(path).shape == RGB.shape


def test_sixteen_bit_and_cmyk_pictures_are_refused(tmp_path: Path) -> None:
    deep = _saved(tmp_path / "deep.png", Image.fromarray(RGB[..., 0].astype(np.uint16)))
    with pytest.raises(ClipError, match=r"deep\.png has 16 bits.*8 bits"):
        read_image(deep)
    cmyk = _saved(tmp_path / "print.jpg", Image.new("CMYK", (9, 9)))
    with pytest.raises(ClipError, match=r"print\.jpg is a CMYK"):
        read_image(cmyk)


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a" + bytes(99), b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]
)
def test_other_files_are_refused_by_their_first_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "odd.png"
    path.write_bytes(content)
    with pytest.raises(ClipError, match=r"odd\.png"):
        read_image(path)


def test_missing_file_and_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match=r"gone\.png is missing"):
        read_image(tmp_path / "gone.png")
    with pytest.raises(ClipError, match="cannot be read"):
        read_image(tmp_path)


@pytest.mark.parametrize("side", [(30_000, 30_000), (8_001, 8_000), (0, 5), (2**31, 2**31)])
def test_a_header_that_claims_too_much_is_refused_before_decoding(
    tmp_path: Path, side: tuple[int, int]
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(_png_claiming(*side))
    with pytest.raises(ClipError, match=r"bomb\.png claims"):
        read_image(path)


@settings(max_examples=60, deadline=None)
@given(kind=st.sampled_from(["PNG", "JPEG"]), share=st.floats(0, 0.999))
def test_no_truncated_picture_is_read(kind: str, share: float) -> None:
    path = _temporary(kind, share)
    with pytest.raises(ClipError):
        read_image(path)


def test_truncation_is_seen_although_another_library_told_pillow_to_accept_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    for kind in ("PNG", "JPEG"):
        with pytest.raises(ClipError, match="truncated"):
            read_image(_temporary(kind, 0.8))


def test_label_ids_come_back_exactly(tmp_path: Path) -> None:
    ids = RGB[..., 1]
    np.testing.assert_array_equal(ids, read_label(_saved(tmp_path / "8.png", Image.fromarray(ids))))
    deep = ids.astype(np.uint16) * 257
    path = _saved(tmp_path / "16.png", Image.fromarray(deep))
    np.testing.assert_array_equal(deep, read_label(path))
    indexed = Image.fromarray(ids % 16)
    indexed.putpalette([200, 10, 30] * 256)
    path = _saved(tmp_path / "p.png", indexed)
    np.testing.assert_array_equal(ids % 16, read_label(path))


def test_labels_that_are_colours_jpeg_or_few_bits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match=r"c\.png has colour type 2.*indices are the ids"):
        read_label(_saved(tmp_path / "c.png", Image.fromarray(RGB)))
    with pytest.raises(ClipError, match=r"j\.jpg is a JPEG"):
        read_label(_saved(tmp_path / "j.jpg", Image.fromarray(RGB[..., 0])))
    # Pillow would stretch one-bit values to 0 and 255.
    with pytest.raises(ClipError, match="1 bits"):
        read_label(_saved(tmp_path / "b.png", Image.new("1", (40, 40))))


def test_header_gives_the_size(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg"):
        header = image_header(_saved(tmp_path / name, Image.fromarray(RGB)))
        assert (header.width, header.height, header.bits) == (23, 17, 8)


_SCRATCH: list[Path] = []


@pytest.fixture(autouse=True)
def _scratch(tmp_path: Path) -> None:
    _SCRATCH[:] = [tmp_path]


def _temporary(kind: str, share: float) -> Path:
    """A picture of `kind`, cut after `share` of its bytes."""
    stream = io.BytesIO()
    Image.fromarray(np.tile(RGB, (5, 5, 1))).save(stream, kind)
    whole = stream.getvalue()
    path = _SCRATCH[0] / f"cut.{kind.lower()}"
    path.write_bytes(whole[: int(share * len(whole))])
    return path


@settings(max_examples=80, deadline=None)
@given(
    kind=st.sampled_from(["PNG", "JPEG"]),
    flips=st.lists(st.tuples(st.floats(0, 0.9999), st.integers(0, 7)), min_size=1, max_size=6),
)
def test_a_damaged_picture_is_read_or_a_typed_error(
    kind: str, flips: list[tuple[float, int]]
) -> None:
    path = _temporary(kind, 1.0)
    data = bytearray(path.read_bytes())
    for share, bit in flips:
        data[int(share * len(data))] ^= 1 << bit
    path.write_bytes(data)
    for read in (read_image, read_label):
        try:
            read(path)
        except ClipError as error:
            assert path.name in str(error)
