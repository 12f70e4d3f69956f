"""States from which a training goes on, and whether one belongs to what it is given to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from weather_aug._keys import check_seed
from weather_aug.errors import ArgumentError, ConflictError, printable

STATE_VERSION = 1


def fingerprint_of(choices: Mapping[str, Any]) -> dict[str, str]:
    """16 hexadecimal digits for each choice, of its JSON value."""
    return {
        name: hashlib.blake2b(json.dumps(value).encode(), digest_size=8).hexdigest()
        for name, value in choices.items()
    }


def checked_state(state: Any, what: str, fingerprint: Mapping[str, str]) -> dict[str, Any]:
    """A state that belongs to the choices of a fingerprint.

    Args:
        state: As JSON values: `version`, `epoch`, and the fingerprint it was saved with.
        what: Whose state it is.
        fingerprint: Of what it is loaded into.

    Raises:
        ArgumentError: If it is no such state.
        ConflictError: If a choice differs; the first that does is named.
    """
    if not isinstance(state, Mapping) or not isinstance(state.get("fingerprint"), Mapping):
        raise ArgumentError(f"state is no state_dict of a {what}: {printable(state)}")
    if state.get("version") != STATE_VERSION:
        raise ArgumentError(
            f"state has version {printable(state.get('version'))}, this program reads version "
            f"{STATE_VERSION}"
        )
    check_seed("epoch of the state", state.get("epoch"))  # type: ignore[arg-type]
    for name, digest in fingerprint.items():
        if state["fingerprint"].get(name) != digest:
            raise ConflictError(
                f"the state is of a {what} with another {name}: other samples would follow than in "
                f"the training that saved it; make the {what} with the {name} it had then"
            )
    return dict(state)
