"""Values of flags that are more than a number or a word."""

from __future__ import annotations

import re
from pathlib import Path

from weather_aug.errors import ArgumentError, printable

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def check_local(*paths: Path) -> None:
    """Refuse urls where only files of this machine are read.

    Raises:
        ArgumentError: If a path is one. A path has lost a slash of "://", by which messages know
            what to keep to themselves, so the sentence does not repeat it.
    """
    for path in paths:
        scheme = _SCHEME.match(str(path))
        if scheme is not None and not path.exists():
            raise ArgumentError(
                f"a url ({scheme[0]}/…) stands where only files of this machine are read; "
                "copy it here and name the copy"
            )


def numbers_by_name(flag: str, form: str, items: tuple[str, ...]) -> dict[str, float]:
    """Numbers by name of texts "name=number".

    Args:
        flag: Where they stand, such as "--types".
        form: What the flag takes, with an example, for who got it wrong.
        items: The texts.

    Raises:
        ArgumentError: If a text is no name and number, or a name stands twice.
    """
    numbers: dict[str, float] = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            number = float(text)
        except ValueError:
            number = None
        if not name or number is None:
            raise ArgumentError(f"{flag} takes {form}, got {printable(item)!r}")
        if name in numbers:
            raise ArgumentError(f"{flag}: {printable(name)!r} stands twice")
        numbers[name] = number
    return numbers
