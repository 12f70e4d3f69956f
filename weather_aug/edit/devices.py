"""Where an editor's networks compute."""

from __future__ import annotations

import torch

from weather_aug.errors import ArgumentError, printable


def device_of(name: str) -> torch.device:
    """A device of torch that is there.

    Raises:
        ArgumentError: If torch knows no such device, or finds none on this machine.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        cause = str(error).partition("\n")[0]
        raise ArgumentError(
            f"device {printable(name)!r}: {printable(cause, 200)}; take cpu, or a GPU that torch "
            "finds"
        ) from None
    return device
