"""A place that fsspec reaches, opened, read, and named without its secrets."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from urllib.parse import unquote

from weather_aug import _files
from weather_aug._extras import require
from weather_aug.errors import (
    ArgumentError,
    DataError,
    MissingExtraError,
    OutputError,
    WeatherAugError,
    printable,
)

# A password may hold a slash, where it should not; a port may be followed by one.
_USER = re.compile(r"[^/]*@|[^/:@?]*:(?!\d+/).*@")
_PART = 4
"""Characters from which on a part of what is secret is no accident."""


@dataclass(frozen=True, repr=False)
class Place:
    """A folder at a url; see `Source`."""

    url: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the file system, such as credentials."""

    def size(self, relative: str) -> int:
        """As the place says."""
        with self._found(relative) as path:
            return int(self._info(path)["size"])

    def read(self, relative: str, offset: int = 0, size: int | None = None) -> bytes:
        """In one request."""
        end = None if size is None else offset + size
        with self._found(relative) as path:
            return bytes(self.fs.cat_file(path, offset or None, end))

    def open(self, relative: str) -> io.BufferedReader:
        """As fsspec does: block by block."""
        with self._found(relative) as path:
            # fsspec's own lines copy a block each.
            return io.BufferedReader(self.fs.open(path, "rb"))

    def files(self) -> Iterator[str]:
        """All below the url."""
        root = len(self.path("")) + 1
        with self.reported("", "read"):
            found = sorted(self.below([""]))
        return (path[root:] for path in found)

    @cached_property
    def fs(self) -> Any:
        """The file system.

        Raises:
            ArgumentError: If fsspec does not know the url.
            MissingExtraError: If the package of the file system is not installed.
            OutputError: If the place cannot be reached.
        """
        return self._opened[0]

    def path(self, relative: str) -> str:
        """What a file is called in the file system."""
        return f"{self._opened[1]}/{relative}".rstrip("/")

    def entries(self) -> list[str]:
        """Paths at the root."""
        # What other processes wrote since a listing was kept must be seen.
        self.fs.invalidate_cache()
        try:
            return list(self.fs.ls(self.path(""), detail=False))
        except FileNotFoundError:
            return []

    def below(self, folders: Iterable[str]) -> Iterator[str]:
        """Paths of all files in some folders."""
        self.fs.invalidate_cache()
        for folder in folders:
            yield from self.fs.find(self.path(folder))

    @contextmanager
    def reported(self, relative: str, verb: str) -> Iterator[None]:
        """Turn whatever a file system raises into one sentence that names the url.

        Args:
            relative: What was to be read or written.
            verb: What could not be done, "read" or "write".
        """
        try:
            yield
        except (WeatherAugError, MemoryError):
            raise
        except Exception as error:
            where = f"{self}/{printable(relative, 200)}".rstrip("/")
            raise OutputError(f"cannot {verb} {where}: {self._told(error)}") from error

    @contextmanager
    def _found(self, relative: str) -> Iterator[str]:
        """The path of a file that should be there."""
        _files.check_plain(str(self), relative)
        with self.reported(relative, "read"):
            try:
                yield self.path(relative)
            except (FileNotFoundError, IsADirectoryError):
                raise DataError(f"{self}/{printable(relative, 200)} is missing") from None

    def _info(self, path: str) -> Any:
        info = self.fs.info(path)
        if info.get("type") == "directory":
            raise IsADirectoryError(path)
        return info

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        """File system, and the folder's path in it."""
        if "::" in self.url:
            raise ArgumentError(f"{self} is a chain of file systems; give the url of the last one")
        core = require("fsspec.core", extra="remote", to="use a url")
        try:
            fs, root = core.url_to_fs(self.url, **self.options)
        except ImportError as error:
            raise MissingExtraError(f"{self} needs a package: {self._told(error)}") from error
        except (ValueError, TypeError) as error:
            raise ArgumentError(f"{self} cannot be opened: {self._told(error)}") from error
        except Exception as error:
            raise OutputError(f"{self} cannot be reached: {self._told(error)}") from error
        return fs, root.rstrip("/")

    def _told(self, error: Exception) -> str:
        """An error's text without what the url keeps to itself."""
        text = f"{type(error).__name__} {error}".rstrip()
        for secret in self._secrets():
            text = text.replace(secret, "…")
        return printable(text, 300)

    def _secrets(self) -> list[str]:
        """What no message may hold, longer texts first; a file system may tell parts of them."""
        user, rest = self._parted
        query = rest.partition("?")[2]
        secrets = [user, user[:-1].partition(":")[2], query]
        secrets += [part for part in re.split("[/@?:&=]", user + query) if len(part) >= _PART]
        secrets += [value for value in self.options.values() if isinstance(value, str)]
        told = {secret for text in secrets for secret in (text, unquote(text)) if secret}
        return sorted(told, key=len, reverse=True)

    @property
    def _parted(self) -> tuple[str, str]:
        """User and password up to "@", and the rest behind the protocol."""
        rest = self.url.partition("://")[2]
        user = _USER.match(rest)
        length = user.end() if user else 0
        return rest[:length], rest[length:]

    @property
    def name(self) -> str:
        """Last part of the url, for a file beside it."""
        return str(self).rpartition("/")[2]

    def __str__(self) -> str:
        """The url without user, password and query."""
        user, rest = self._parted
        # Whose the part behind "@" is, a query's or a place's, cannot be told then.
        place = "…" if "?" in user else rest.partition("?")[0].rstrip("/")
        return printable(f"{self.url.partition('://')[0]}://{place}", 200)

    __repr__ = __str__
