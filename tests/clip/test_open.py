"""Addresses of clips: what can be written is read back, what cannot is refused with the choices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from weather_aug.clip.open import ClipUri, open_clip, parse_uri
from weather_aug.clip.types import Clip
from weather_aug.errors import ArgumentError, ClipError, WeatherAugError

WORDS = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), min_size=1)
SCHEMES = st.from_regex(r"[a-z][a-z0-9-]{0,12}", fullmatch=True)


@given(SCHEMES, WORDS, st.dictionaries(WORDS, st.one_of(st.just(""), WORDS), max_size=4))
def test_an_address_survives_the_round_trip(
    scheme: str, path: str, options: dict[str, str]
) -> None:
    uri = ClipUri(scheme, path, options)
    assert uri == parse_uri(str(uri))


@given(st.text())
def test_any_text_opens_or_is_a_typed_error(text: str) -> None:
    try:
        parse_uri(text)
    except ArgumentError as error:
        assert str(error).isprintable()


@given(st.sampled_from(["folder", "dgp", "kitti-raw", "kitti-odometry"]), st.text(max_size=30))
def test_any_options_are_a_typed_error_on_a_missing_path(scheme: str, query: str) -> None:
    with pytest.raises(WeatherAugError):
        open_clip(f"{scheme}:no/such/folder?{query}")


def test_plain_addresses_split_as_written() -> None:
    uri = parse_uri("dgp:../data/dgp ddad?scene=scene_02&frames=1:3&cameras=A,B")
    assert uri.path == "../data/dgp ddad"
    assert uri.options == {"scene": "scene_02", "frames": "1:3", "cameras": "A,B"}
    assert parse_uri("folder:/a/50%25%3F").path == "/a/50%?"


def test_unknown_scheme_lists_the_schemes() -> None:
    with pytest.raises(ArgumentError, match=r"no scheme 'kiti'.*kitti-odometry, kitti-raw, dgp"):
        open_clip("kiti:/data")


def test_a_drive_of_windows_is_no_scheme() -> None:
    with pytest.raises(ArgumentError, match=r"has no scheme; write scheme:C:.*folder, street"):
        open_clip(r"C:\data\camvid")
    assert parse_uri(r"folder:C:\data\camvid?images=train").path == r"C:\data\camvid"


def test_unknown_option_lists_the_options(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"no option 'label'; it has .*labels.*fps"):
        open_clip(f"folder:{tmp_path}?label=x")


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("fps=fast", "fps must be a finite number"),
        ("fps=nan", "fps must be a finite number"),
        ("frames=3", "frames must be a range a:b"),
        ("frames=a:b", "frames must be a range a:b"),
        ("scale=2", r"scale must be in \(0, 1\]"),
        ("fps", "must be written name=value"),
        ("fps=1&fps=2", "stands twice"),
        ("fps=%zz", "malformed escape"),
        ("taxonomy=cityscape", "no taxonomy 'cityscape'"),
    ],
)
def test_malformed_options_are_refused(tmp_path: Path, option: str, expected: str) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    with pytest.raises(ArgumentError, match=expected):
        open_clip(f"folder:{tmp_path}?{option}")


@pytest.mark.parametrize("scheme", ["folder", "dgp", "kitti-raw", "kitti-odometry"])
def test_missing_path_is_named(scheme: str) -> None:
    with pytest.raises(ClipError, match="no/such/place does not exist"):
        open_clip(f"{scheme}:no/such/place")
    with pytest.raises(ArgumentError, match="needs a path"):
        open_clip(f"{scheme}:")


def test_options_reach_the_reader_with_their_types(tmp_path: Path) -> None:
    for index in range(4):
        Image.fromarray(np.full((6, 8, 3), index, np.uint8)).save(tmp_path / f"{index}.png")
    clip = open_clip(f"folder:{tmp_path}?frames=1:3&fps=20&focal_px=12.5&speed_m_per_s=4")
    assert isinstance(clip, Clip)
    assert [key.time_index for key in clip.keys] == [1, 2]
    frame = clip.frame(clip.keys[1])
    assert frame.time_s == pytest.approx(0.1)
    assert frame.camera.focal_px[0] == pytest.approx(12.5)
    assert frame.camera.centre_world[2] == pytest.approx(0.4)
    assert frame.image[0, 0, 0] == 2


def test_street_takes_no_path() -> None:
    pytest.importorskip("weather_aug.clip.street")
    with pytest.raises(ArgumentError, match="street takes no path"):
        open_clip("street:somewhere?frames=2")
