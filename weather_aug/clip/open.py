"""From "scheme:path?option=value&…" to a reader.

A reader is a class; its options are the keyword arguments of its constructor, converted from text
by their type hints. Percent escapes stand for characters that would otherwise separate parts.
"""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints
from urllib.parse import quote, unquote

from weather_aug.clip.dgp import DgpClip
from weather_aug.clip.folder import FolderClip
from weather_aug.clip.kitti import KittiOdometryClip, KittiRawClip
from weather_aug.clip.types import Clip
from weather_aug.errors import ArgumentError, printable

Reader = Callable[..., Clip]


def open_clip(uri: str) -> Clip:
    """Open a recorded drive.

    Args:
        uri: "scheme:path?option=value&option=value". Schemes are kitti-odometry, kitti-raw, dgp,
            folder and street; options are the keyword arguments of KittiOdometryClip,
            KittiRawClip, DgpClip, FolderClip and StreetClip. A slice is written "a:b", a list
            "one,two". "%3F" stands for "?" in a path, "%25" for "%".

    Returns:
        The clip.

    Raises:
        ArgumentError: If the scheme or an option is unknown, or a value malformed.
        ClipError: If the path or a file of the clip is missing or damaged.
        CalibrationError: If the clip's calibration or poses cannot be used.

    Example:
        >>> clip = open_clip("street:?frames=4&width=96&height=64")  # doctest: +SKIP
    """
    parsed = parse_uri(uri)
    if len(parsed.scheme) == 1:
        raise ArgumentError(
            f"{printable(uri)!r} is a path on a drive of Windows and has no scheme; write "
            f"scheme:{printable(uri)} with a scheme of {', '.join(_READERS)}"
        )
    if parsed.scheme not in _READERS:
        raise ArgumentError(
            f"no scheme {printable(parsed.scheme)!r} in {printable(uri)!r}; there are "
            f"{', '.join(_READERS)}"
        )
    reader = _READERS[parsed.scheme]()
    types_by_option = _options(reader)
    options: dict[str, Any] = {}
    for name, text in parsed.options.items():
        if name not in types_by_option:
            raise ArgumentError(
                f"{parsed.scheme} has no option {printable(name)!r}; it has "
                f"{', '.join(types_by_option)}"
            )
        options[name] = _converted(name, text, types_by_option[name])
    if _takes_root(reader):
        if not parsed.path:
            raise ArgumentError(f"{parsed.scheme} needs a path: {parsed.scheme}:PATH")
        return reader(parsed.path, **options)
    if parsed.path:
        raise ArgumentError(
            f"{parsed.scheme} takes no path, got {printable(parsed.path)!r}; write "
            f"{parsed.scheme}:?option=value"
        )
    return reader(**options)


class ClipUri(NamedTuple):
    """The parts of a clip's address, escapes resolved."""

    scheme: str
    path: str
    options: dict[str, str]

    def __str__(self) -> str:
        """The address that `parse_uri` splits into these parts."""
        query = "&".join(
            f"{quote(name, safe='')}={quote(value, safe=':,/.')}"
            for name, value in self.options.items()
        )
        path = quote(self.path, safe="/:\\. ~,;=@!$'()*+&")
        return f"{self.scheme}:{path}" + (f"?{query}" if query else "")


def parse_uri(uri: str) -> ClipUri:
    """Split a clip's address into scheme, path and options.

    Raises:
        ArgumentError: If there is no scheme, an option has no value or stands twice, or an escape
            is malformed.
    """
    if not isinstance(uri, str):
        raise ArgumentError(f"a clip's address must be text, got {type(uri).__name__}")
    scheme, colon, rest = uri.partition(":")
    if not colon or not scheme:
        raise ArgumentError(
            f"{printable(uri)!r} has no scheme; write scheme:path with a scheme of "
            f"{', '.join(_READERS)}"
        )
    path, _, query = rest.partition("?")
    options: dict[str, str] = {}
    for part in query.split("&") if query else ():
        name, equals, value = part.partition("=")
        name = _unescaped(name)
        if not equals or not name:
            raise ArgumentError(f"option {printable(part)!r} must be written name=value")
        if name in options:
            raise ArgumentError(f"option {printable(name)!r} stands twice")
        options[name] = _unescaped(value)
    return ClipUri(scheme, _unescaped(path), options)


def _unescaped(text: str) -> str:
    try:
        plain = unquote(text, errors="strict")
    except UnicodeDecodeError:
        raise ArgumentError(f"{printable(text)!r} has escapes that are not UTF-8") from None
    escapes = text.split("%")[1:]
    if any(len(part) < 2 or not set(part[:2]) <= _HEX for part in escapes) or "\0" in plain:
        raise ArgumentError(f"{printable(text)!r} has a malformed escape; write %25 for a % sign")
    return plain


_HEX = set("0123456789abcdefABCDEF")


def _street() -> Reader:
    from weather_aug.clip.street import StreetClip

    return StreetClip


_READERS: dict[str, Callable[[], Reader]] = {
    "kitti-odometry": lambda: KittiOdometryClip,
    "kitti-raw": lambda: KittiRawClip,
    "dgp": lambda: DgpClip,
    "folder": lambda: FolderClip,
    "street": _street,
}


def _takes_root(reader: Reader) -> bool:
    return "root" in inspect.signature(reader).parameters


def _options(reader: Reader) -> dict[str, Any]:
    """Type of each keyword argument that can be written as text."""
    hints = get_type_hints(vars(reader).get("__init__", reader))
    names = [name for name in inspect.signature(reader).parameters if name != "root"]
    plain = {name: _without_none(hints[name]) for name in names if name in hints}
    return {name: hint for name, hint in plain.items() if hint in _CONVERTERS}


def _without_none(hint: Any) -> Any:
    if get_origin(hint) not in (Union, types.UnionType):
        return hint
    rest = [part for part in get_args(hint) if part is not type(None)]
    return rest[0] if len(rest) == 1 else hint


def _converted(name: str, text: str, hint: Any) -> Any:
    convert, expected = _CONVERTERS[hint]
    try:
        return convert(text)
    except ValueError:
        raise ArgumentError(f"{name} must be {expected}, got {printable(text)!r}") from None


def _integer(text: str) -> int:
    if not text.isascii() or len(text) > 20 or "_" in text:
        raise ValueError(text)
    return int(text)


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number) or "_" in text:
        raise ValueError(text)
    return number


def _slice(text: str) -> slice:
    start, colon, stop = text.partition(":")
    if not colon:
        raise ValueError(text)
    return slice(*(_integer(part) if part else None for part in (start, stop)))


def _words(text: str) -> tuple[str, ...]:
    words = tuple(text.split(","))
    if not all(words):
        raise ValueError(text)
    return words


_CONVERTERS: dict[Any, tuple[Callable[[str], Any], str]] = {
    str: (str, "text"),
    int: (_integer, "a whole number"),
    float: (_number, "a finite number"),
    slice: (_slice, "a range a:b"),
    tuple[str, ...]: (_words, "words separated by commas"),
}
