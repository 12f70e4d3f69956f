"""Numbers beside their targets: on the terminal, and in a file that machines can read."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGES = ("weather-aug", "albumentations", "numpy", "numba", "opencv", "torch")
_DISTRIBUTIONS = {"opencv": "opencv-contrib-python-headless"}


@dataclass(frozen=True)
class Row:
    """One number, and what it should be where there is a target."""

    name: str
    value: float
    unit: str = ""
    at_most: float | None = None
    at_least: float | None = None

    @property
    def verdict(self) -> str:
        """Whether the target is met or missed; empty without one."""
        if self.at_most is None and self.at_least is None:
            return ""
        low = self.at_least is None or self.value >= self.at_least
        high = self.at_most is None or self.value <= self.at_most
        return "met" if low and high else "missed"

    def line(self) -> str:
        """The row as it is printed."""
        text = f"  {self.name:58s} {self.value:10.4g} {self.unit:13s}"
        if self.at_most is not None:
            text += f" target <= {self.at_most:<6g}"
        if self.at_least is not None:
            text += f" target >= {self.at_least:<6g}"
        return f"{text} {self.verdict}".rstrip()


def show(title: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Print rows under a title, and give them back as JSON values."""
    print(f"\n{title}")
    for row in rows:
        print(row.line())
    print(end="", flush=True)
    return {"title": title, "rows": [asdict(row) | {"verdict": row.verdict} for row in rows]}


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write all numbers and what they were measured on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"machine": machine(), "results": results}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def machine() -> dict[str, Any]:
    """Processor, system and versions."""
    return {
        "cpu": _cpu_name(),
        "cpus": os.cpu_count(),
        "load_1_min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(_DISTRIBUTIONS.get(name, name)) for name in PACKAGES},
    }


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
