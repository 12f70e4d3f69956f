"""Every error this package raises on purpose.

    WeatherAugError
    ├── ArgumentError       (ValueError)    an argument outside what is accepted
    ├── DataError           (ValueError)    a file that is not what it should be
    │   ├── ClipError                       a recorded drive that cannot be read
    │   ├── CalibrationError                a camera or pose that cannot be used
    │   └── SceneError                      a scene folder that cannot be used
    ├── IntegrityError                      a file whose bytes are not the recorded ones
    ├── ConflictError                       another job owns, or differs from, this output
    ├── OutputError         (OSError)       the output could not be written
    └── MissingExtraError   (ImportError)   an optional package is not installed

A message names the file or argument, what was found, and what to do. `exit_code` is what the
command line returns: 2 usage, 3 bad input, 4 integrity, 5 conflict, 6 input/output.
"""

from __future__ import annotations


class WeatherAugError(Exception):
    """Base of all errors of this package."""

    exit_code = 1


class ArgumentError(WeatherAugError, ValueError):
    """An argument is outside what is accepted."""

    exit_code = 2


class DataError(WeatherAugError, ValueError):
    """A file is not what it should be."""

    exit_code = 3


class ClipError(DataError):
    """A recorded drive cannot be read."""


class CalibrationError(DataError):
    """A camera or a pose cannot be used."""


class SceneError(DataError):
    """A scene folder cannot be used."""


class IntegrityError(WeatherAugError):
    """A file's bytes are not the ones that were recorded for it."""

    exit_code = 4


class ConflictError(WeatherAugError):
    """Another job owns this output, or the output belongs to a different job."""

    exit_code = 5


class OutputError(WeatherAugError, OSError):
    """The output could not be written."""

    exit_code = 6


class MissingExtraError(WeatherAugError, ImportError):
    """An optional package is not installed."""

    exit_code = 2


def printable(value: object, limit: int = 80) -> str:
    """Text for an error message: control characters escaped, at most `limit` characters.

    What is too long loses its middle, because a path says most at its end.
    """
    text = str(value)
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    if len(text) <= limit:
        return text
    head = limit // 3
    return text[:head] + "…" + text[head + 1 - limit :]
