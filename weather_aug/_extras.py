"""Optional packages: imported where needed, named with their extra where absent."""

from __future__ import annotations

import importlib
from types import ModuleType

from weather_aug.errors import MissingExtraError


def require(module: str, *, extra: str, to: str) -> ModuleType:
    """Import `module`, or say in one sentence which extra of this package brings it.

    Raises:
        MissingExtraError: If the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module} is needed to {to}; install it with: pip install 'weather-aug[{extra}]'"
        ) from error
