"""What the command line says to people, and where it may write."""

from __future__ import annotations

import sys
from pathlib import Path

from weather_aug import _files
from weather_aug.errors import OutputError, printable


def check_folder(out: Path) -> None:
    """Refuse an output folder that is a file, before any work is done for it."""
    with _files.reported(out):
        is_file = out.exists() and not out.is_dir()
    if is_file:
        raise OutputError(f"{printable(out, 200)} is a file; choose a folder for the pictures")


def complain(text: str) -> None:
    """Print one line on stderr, after the program's name."""
    print(f"weather-aug: {text}", file=sys.stderr)


def say(text: str) -> None:
    """Print one line."""
    print(text, flush=True)


def to_people() -> bool:
    """Whether somebody watches the progress."""
    return sys.stderr.isatty()
