"""Parts of a benchmark in processes of their own, and the memory that processes hold."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def resident_mib(field: str, pid: int | None = None) -> float:
    """Resident memory of a process in MiB, by the name of its line in /proc/<pid>/status.

    Args:
        field: "VmRSS", what it holds now, or "VmHWM", the most that it ever held.
        pid: Of this process if None.
    """
    status = Path(f"/proc/{pid or 'self'}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith(f"{field}:"))
    return int(line.split()[1]) / 1024


def alone(module: str, *arguments: object) -> Any:
    """The JSON value that a module prints as its last line, run in a fresh Python."""
    command = [sys.executable, "-m", module, *(str(argument) for argument in arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])
