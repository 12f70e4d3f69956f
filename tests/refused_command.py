"""A command that must fail, as the command line runs it."""

from __future__ import annotations

import pytest

from weather_aug.cli import main

Captured = pytest.CaptureFixture[str]


def refused(arguments: list[str], capsys: Captured) -> tuple[int, str]:
    """Exit code and the one line on stderr of a command that must fail."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert isinstance(caught.value.code, int)
    return caught.value.code, line
