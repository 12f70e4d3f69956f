"""Write the loader's ratios into the README: the last step of `make bench`.

What stands between the two markers is replaced, and nothing else; without them nothing is done.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import loader
from weather_aug._files import write_whole
from weather_aug.errors import DataError

README, RESULTS = Path("README.md"), Path("out/bench/results.json")
OPENING, CLOSING = "<!-- loader-table -->", "<!-- /loader-table -->"
NAMES = {
    loader.PLAIN: "no weather",
    loader.OURS: "`WeatherDataset` over a scene",
    loader.WITHOUT_SCENE: "`RandomWeather` without a scene, before the crop",
    loader.THEIRS_ON_CROP: "albumentations' rain, snow and fog on the crop",
    loader.THEIRS_ON_WHOLE: "albumentations' rain, snow and fog before the crop",
}
"""What the contenders are called in the README."""


def table(results: Mapping[str, Any]) -> str:
    """The Markdown table of what `make bench` wrote.

    Raises:
        DataError: If the results hold no such benchmark, or another one.
    """
    found = results.get("results", {}).get("loader", {}).get("samples_per_s", {})
    if set(found) != set(NAMES):
        raise DataError("the results hold no loader benchmark of today's loaders; run make bench")
    size = f"{loader.HEIGHT} × {loader.WIDTH} PNG to {loader.CROP} × {loader.CROP}"
    lines = [f"| {size}, {loader.WORKERS} workers | samples per second |", "|---|---:|"]
    ratios = loader.ratios(found)
    lines += [f"| {text} | {ratios[name]:.2f} × |" for name, text in NAMES.items()]
    versions = results["machine"]["versions"]
    cpu, peer = results["machine"]["cpu"], versions["albumentations"]
    lines += ["", f"Relative to no weather; albumentations {peer}, {cpu}, by benchmarks/loader.py."]
    return "\n".join(lines)


def with_table(text: str, content: str) -> str:
    """A text with new content between the markers; as it was, if it has none.

    Raises:
        DataError: If it does not have each marker once, in order.
    """
    counts = text.count(OPENING), text.count(CLOSING)
    if counts == (0, 0):
        return text
    before, _, rest = text.partition(OPENING)
    _, closing, after = rest.partition(CLOSING)
    if counts != (1, 1) or not closing:
        raise DataError(f"{OPENING} and {CLOSING} must stand in the README once each, in order")
    return f"{before}{OPENING}\n{content}\n{CLOSING}{after}"


def main(readme: Path = README, results: Path = RESULTS) -> None:
    """Write the table of the last `make bench`, and say so."""
    text = readme.read_text(encoding="utf-8")
    content = table(json.loads(results.read_text(encoding="utf-8")))
    changed = with_table(text, content)
    if changed != text:
        write_whole(readme, changed.encode("utf-8"))
    print(f"\n{content}")
    print(f"in {readme}" if OPENING in text else f"{readme} has no {OPENING}: nothing written")


if __name__ == "__main__":
    main()
