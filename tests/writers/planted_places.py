"""File systems of fsspec that fail on purpose."""

from __future__ import annotations

from typing import Any, ClassVar

from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem


class NetworkError(Exception):
    """What a store's client may raise: no OSError."""


class FlakyStore(MemoryFileSystem):
    """A store of objects whose network fails at every `every`-th put, after `grace` of them."""

    protocol = ("flaky", "s3")
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    puts: ClassVar[list[str]] = []
    every: ClassVar[int] = 0
    unreadable: ClassVar[bool] = False

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("flaky://")))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **kwargs: Any) -> None:
        self._fail_in_turn(path)
        super().pipe_file(path, value, mode, **kwargs)

    def put_file(self, lpath: str, rpath: str, callback: Any = None, **kwargs: Any) -> None:
        with open(lpath, "rb") as file:  # noqa: PTH123
            self.pipe_file(rpath, file.read())

    def info(self, path: str, **kwargs: Any) -> Any:
        if self.unreadable:
            raise NetworkError("no route to host")
        return super().info(path, **kwargs)

    def _fail_in_turn(self, path: str) -> None:
        self.puts.append(path)
        if self.every and len(self.puts) % self.every == 0:
            raise NetworkError("connection reset")


class StrictDisk(LocalFileSystem):
    """A disk that renames onto no file, as some servers do."""

    protocol = ("strict",)

    def mv(self, path1: str, path2: str, **kwargs: Any) -> None:
        if self.exists(path2):
            raise FileExistsError(path2)
        super().mv(path1, path2, **kwargs)


class Copier(LocalFileSystem):
    """A place that renames by copying, as fsspec does where a place knows no renames."""

    protocol = ("copier",)
    mv = AbstractFileSystem.mv
