"""nuScenes' category.json: which class has which id in one copy of the data set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from weather_aug._class_tables.nuscenes import NUSCENES_LIDARSEG
from weather_aug._files import read_json
from weather_aug.errors import DataError, printable


def name_by_index(path: Path) -> dict[int, str]:
    """The 32 class names of nuScenes-lidarseg by id.

    Raises:
        DataError: If the file cannot be read, or does not give each of them its own id.
    """
    where = printable(path)
    found = _name_by_index(read_json(path), where)
    expected = set(NUSCENES_LIDARSEG.names.values())
    missing, unknown = expected - set(found.values()), set(found.values()) - expected
    if missing or unknown:
        what = f"lacks {min(missing)}" if missing else f"has {printable(min(unknown))} as well"
        raise DataError(f"{where} {what}; it must have the 32 classes of nuScenes-lidarseg")
    return found


def _name_by_index(records: Any, where: str) -> dict[int, str]:
    if not isinstance(records, list):
        raise DataError(f"{where} must hold a list of categories; choose nuScenes' category.json")
    found: dict[int, str] = {}
    for record in records:
        name = record.get("name") if isinstance(record, dict) else None
        index = record.get("index") if isinstance(record, dict) else None
        if not isinstance(name, str) or type(index) is not int or not 0 <= index <= 255:
            raise DataError(
                f"{where} has a category without a name and an index in 0..255 "
                f"({printable(record)}); nuScenes' own file has no index until nuScenes-lidarseg "
                "is unpacked over it"
            )
        if index in found or name in found.values():
            raise DataError(f"{where} has {printable(name)} or the index {index} twice")
        found[index] = name
    return found
