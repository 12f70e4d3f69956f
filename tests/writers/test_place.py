"""A url is opened, read and named; what is secret of it is told to nobody."""

from __future__ import annotations

from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from weather_aug.errors import ArgumentError, DataError, MissingExtraError, OutputError
from weather_aug.writers.place import Place


class Gossip(MemoryFileSystem):
    """A file system that tells all it knows when something fails."""

    protocol = ("gossip",)

    def __init__(self, told: str = "", **options: Any) -> None:
        super().__init__(**options)
        self.told = f"{told} {options}"

    def info(self, path: str, **_: Any) -> Any:
        raise RuntimeError(f"403 for {path} with {self.told}")


@pytest.fixture(autouse=True)
def gossip() -> None:
    fsspec.register_implementation("gossip", Gossip, clobber=True)


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("s3://bucket/rainy/", "s3://bucket/rainy"),
        ("s3://KEY:SEC@bucket/rainy", "s3://bucket/rainy"),
        ("s3://KEY:SEC/RET@bucket/rainy", "s3://bucket/rainy"),
        ("s3://KEY:S@C@bucket/rainy", "s3://bucket/rainy"),
        ("s3://KEY:S?C@bucket/rainy", "s3://…"),
        ("s3://bucket/rainy?token=abc", "s3://bucket/rainy"),
        ("https://host?x=u:p@SEC", "https://…"),
        ("sftp://me@host:22/a@b", "sftp://host:22/a@b"),
        ("sftp://host:22/a@b", "sftp://host:22/a@b"),
    ],
)
def test_a_url_is_told_without_its_secrets(url: str, told: str) -> None:
    assert told == str(Place(url)) == repr(Place(url))


def test_nor_does_the_file_system_tell_them() -> None:
    url = "gossip://name:pass%2Fword@host/x?signature=topsecret"
    options = {"told": url, "token": "hidden"}
    with pytest.raises(OutputError) as caught:
        Place(url, options).size("a.png")
    message = str(caught.value)
    assert message.startswith("cannot read gossip://host/x/a.png: RuntimeError 403 for ")
    for secret in ("name:", "pass", "word", "topsecret", "hidden"):
        assert secret not in message


def test_files_are_read() -> None:
    place = Place("memory://places/one")
    fsspec.filesystem("memory").pipe({"/places/one/a/b.txt": b"hello\nyou", "/places/one/c": b""})
    assert [*place.files()] == ["a/b.txt", "c"]
    assert (place.size("a/b.txt"), place.size("c")) == (9, 0)
    assert place.read("a/b.txt") == b"hello\nyou"
    assert place.read("a/b.txt", 2, 3) == b"llo"
    with place.open("a/b.txt") as file:
        assert [*file] == [b"hello\n", b"you"]
    assert [*Place("memory://places/none").files()] == []
    for relative in ("a", "d", "a/c"):
        with pytest.raises(DataError, match=f"memory://places/one/{relative} is missing"):
            place.size(relative)
    with pytest.raises(DataError, match="not a plain path"):
        place.read("../one/c")


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("simplecache::memory://x", ArgumentError),
        ("nosuch://x", ArgumentError),
        ("s3://bucket/x", MissingExtraError),
    ],
)
def test_what_cannot_be_opened(url: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        Place(url).size("a")
