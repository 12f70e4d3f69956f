"""A file is whole or absent, whoever else writes it; what killed writers leave can be removed."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug import _files
from weather_aug.errors import OutputError

FIRST, SECOND = b"first " * 1000, b"second" * 2000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "picture.png"


def interleaved(path: Path, order: list[int]) -> list[bytes | None]:
    """Two writers of one path, of which `order` says whose step is next; what stands there then.

    A writer's steps: it opens, writes its first half, its second half, and ends.
    """

    def steps(data: bytes, held: ExitStack) -> list[Callable[[], object]]:
        files: list[_files.BinaryIO] = []
        half = len(data) // 2

        def write(part: bytes) -> None:
            files[0].write(part)
            files[0].flush()

        return [
            lambda: files.append(held.enter_context(_files.whole_file(path))),
            lambda: write(data[:half]),
            lambda: write(data[half:]),
            held.close,
        ]

    seen = []
    with ExitStack() as one, ExitStack() as other:
        left = [iter(steps(FIRST, one)), iter(steps(SECOND, other))]
        for writer in order:
            next(left[writer])()
            seen.append(path.read_bytes() if path.exists() else None)
    return seen


orders = st.permutations([0] * 4 + [1] * 4)


@given(orders)
def test_two_writers_of_one_path_leave_the_file_of_one(
    tmp_path_factory: pytest.TempPathFactory, order: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("two")
    seen = interleaved(folder / "file", order)
    assert set(seen) <= {None, FIRST, SECOND}
    assert seen[-1] == (FIRST, SECOND)[order[-1]]
    assert [path.name for path in folder.iterdir()] == ["file"]


def test_one_name_for_all_writers_would_be_noticed(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fault that unique names cure: one writer renames what the other has half written."""
    real = Path.open

    def shared(self: Path, mode: str = "r", *args: int) -> object:
        return real(self, mode.replace("x", "w"), *args)

    monkeypatch.setattr(Path, "open", shared)
    monkeypatch.setattr(os, "urandom", bytes)
    with pytest.raises((AssertionError, OutputError)):
        assert set(interleaved(path, [0, 1, 0, 1, 0, 0, 1, 1])) <= {None, FIRST, SECOND}


def test_many_threads_that_write_one_path_leave_a_whole_file(path: Path) -> None:
    texts = [bytes([65 + k]) * (10_000 + k) for k in range(8)]

    def write(text: bytes) -> None:
        for _ in range(20):
            _files.write_whole(path, text)
            assert path.read_bytes() in texts

    errors: list[BaseException] = []

    def caught(text: bytes) -> None:
        try:
            write(text)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=caught, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert list(path.parent.iterdir()) == [path]


def test_an_error_within_leaves_the_old_file_alone(path: Path) -> None:
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), _files.whole_file(path) as file:
        file.write(b"new")
        raise ZeroDivisionError
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_a_full_disk_is_one_sentence_and_leaves_the_old_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"picture\.png: No space left on device; free some"):
        _files.write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed_and_nothing_else(path: Path) -> None:
    writer = _files.whole_file(path)
    writer.__enter__().write(b"half")
    (left,) = path.parent.iterdir()
    assert left.name.startswith("picture.png.")
    assert left.name.endswith(_files.TEMPORARY_SUFFIX)
    mine = [path.with_name(name) for name in ("notes.tmp", "a.12.tmp", ".tmp", "x.tmp.old")]
    for other in mine:
        other.write_bytes(b"mine")
    _files.remove_temporaries(path.parent)
    assert sorted(path.parent.iterdir()) == sorted(mine)
    with pytest.raises(OutputError):
        writer.__exit__(None, None, None)
