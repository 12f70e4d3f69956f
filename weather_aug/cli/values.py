"""Values of flags that are more than a number or a word."""

from __future__ import annotations

from weather_aug.errors import ArgumentError, printable


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
