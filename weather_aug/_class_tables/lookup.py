"""From what a caller writes to a table's name."""

from __future__ import annotations

import difflib

from weather_aug._class_tables import ALIASES, AMBIGUOUS, TABLES
from weather_aug.errors import ArgumentError, printable


def known_name(name: str) -> str:
    """The table that `name` spells.

    Raises:
        ArgumentError: If there is none, or more than one.
    """
    spelt = plain(name)
    for known in (*TABLES, *ALIASES):
        if plain(known) == spelt:
            return ALIASES.get(known, known)
    for unclear, cure in AMBIGUOUS.items():
        if plain(unclear) == spelt:
            raise ArgumentError(f"taxonomy {printable(name)!r} fits more than one: {cure}")
    table_by_spelling = {plain(known): known for known in TABLES}
    near = difflib.get_close_matches(spelt, table_by_spelling, 1)
    guess = f"; did you mean {table_by_spelling[near[0]]!r}?" if near else ";"
    raise ArgumentError(f"no taxonomy {printable(name)!r}{guess} there are {', '.join(TABLES)}")


def plain(name: str) -> str:
    """`name` as far as spellings agree: its letters and digits, without case."""
    return "".join(c for c in str(name).casefold() if c.isalnum())
