"""Class tables: each id and colour of each data set against tables written without the package.

The numbers below are written from the data sets' own lists; they share nothing with the package.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from weather_aug import _class_tables
from weather_aug.taxonomy import CLASSES, IGNORE, TAXONOMIES, Taxonomy, taxonomy

Ids = dict[int, int]


def _ids(text: str) -> Ids:
    """`7:0 8,9:1` as {7: 0, 8: 1, 9: 1}."""
    pairs = (word.split(":") for word in text.split())
    return {int(i): int(train) for ids, train in pairs for i in ids.split(",")}


CITYSCAPES = """7:0 8:1 11:2 12:3 13:4 17:5 19:6 20:7 21:8 22:9 23:10 24:11 25:12 26:13 27:14 28:15
    31:16 32:17 33:18"""
TRAIN = " ".join(f"{i}:{i}" for i in range(19))
NUSCENES_OBJECTS = "2,3,4,6:11 14:18 15,16:15 17,20:13 21:17 23:14 24:0"
NUSCENES_OBJECTS_RELAXED = "5:12 9:4 18,19:14"

# Declared ids, id to train id where it is trained on, and what `relaxed` adds.
EXPECTED: dict[str, tuple[Iterable[int], str, str]] = {
    "train_ids": ([*range(19), 255], TRAIN, ""),
    "bdd100k": ([*range(19), 255], TRAIN, ""),
    "cityscapes": ([*range(35), 255], CITYSCAPES, ""),
    "kitti360": ([*range(45), 255], CITYSCAPES + " 34:2 35:4 37:5", ""),
    "bdd100k_raw": (
        range(41),
        """7:0 8:1 10:2 11:4 15:3 20:5 25:6 26:7 28:9 29:8 30:10 31:11 32:12 33:18 34:15 35:13
        37:17 39:16 40:14""",
        "",
    ),
    "waymo": (
        range(29),
        """2:13 3:14 4:15 6:18 7:17 9:11 10:12 11:12 15:5 17:7 18:6 19:2 20:0 21:0 22:0 23:1 24:8
        25:10""",
        "26:9",
    ),
    "pandaset": (
        range(43),
        """5:8 6:9 7,8,9,10:0 11:1 13:13 14:14 15,16:14 18,25:17 23:15 26:18 27,28,29:16 30,31:11
        36:7 41:2""",
        "12:0 38:7 35:4",
    ),
    "nuscenes_lidarseg": (
        range(32),
        NUSCENES_OBJECTS + " 26:1 27:9 30:8",
        NUSCENES_OBJECTS_RELAXED + " 28:2",
    ),
    "nuimages": ([*range(25), 31], NUSCENES_OBJECTS, NUSCENES_OBJECTS_RELAXED),
    "camvid11": (
        [*range(12), 255],
        "0:10 1:2 2:5 3:0 4:1 5:8 6:7 7:4 8:13 9:11 10:12",
        "",
    ),
    "camvid32": (
        range(32),
        """4:2 31:3 9:4 8:5 24:6 20:7 26,29:8 21:10 16,7:11 2:12 5,22:13 25:16 13:17 17,10,11:0
        19:1""",
        "27:14 18:0",
    ),
    "mapillary_v1.2": (
        range(66),
        """13,24,41:0 2,15:1 17:2 6:3 3:4 45,47:5 48:6 50:7 30:8 29:9 27:10 19:11 20,21,22:12 55:13
        61:14 54:15 58:16 57:17 52:18""",
        "7,8,14,23,43:0 9:1",
    ),
    "mapillary_v2.0": (
        range(124),
        """21,35,36,37,38,39,40,41,42,43,44,46,47,48,49,50,51,52,53,54,55,57,58,74:0 4,24:1 27,28:2
        12:3 5:4 85,88:5 90,91,92,93,94,95:6 99,100,101,103:7 64:8 63:9 61:10 30,31:11 32,33,34:12
        108:13 114:14 107:15 111:16 110:17 105:18""",
        "13,14,16,18,22,23,45,56,77:0 15:1 86:5 115:13",
    ),
}

# A few ids of each, by the name in the data set's own list.
SPOT_NAMES = {
    "train_ids": {0: "road", 18: "bicycle"},
    "bdd100k": {10: "sky"},
    "cityscapes": {0: "unlabeled", 17: "pole", 23: "sky", 33: "bicycle"},
    "kitti360": {34: "garage", 37: "smallpole", 40: "vending machine", 44: "unknown object"},
    "bdd100k_raw": {9: "bridge", 18: "lane divider", 28: "terrain", 40: "truck"},
    "waymo": {0: "TYPE_UNDEFINED", 16: "TYPE_PEDESTRIAN_OBJECT", 28: "TYPE_STATIC"},
    "pandaset": {1: "Smoke", 25: "Motorized Scooter", 38: "Construction Signs", 41: "Building"},
    "nuscenes_lidarseg": {0: "noise", 12: "movable_object.trafficcone", 31: "vehicle.ego"},
    "nuimages": {1: "animal", 23: "vehicle.truck", 24: "flat.driveable_surface", 31: "vehicle.ego"},
    "camvid11": {3: "Road", 6: "SignSymbol", 10: "Bicyclist"},
    "camvid32": {0: "Animal", 15: "ParkingBlock", 21: "Sky", 22: "SUVPickupTruck", 31: "Wall"},
    "mapillary_v1.2": {
        28: "nature--snow",
        47: "object--support--utility-pole",
        65: "void--unlabeled",
    },
    "mapillary_v2.0": {
        35: "marking--continuous--dashed",
        58: "marking-only--discrete--text",
        66: "object--banner",
        90: "object--traffic-light--general-single",
        91: "object--traffic-light--pedestrians",
        101: "object--traffic-sign--information-parking",
        123: "void--unlabeled",
    },
}


def _expected(name: str, relaxed: bool) -> Ids:
    declared, strict, added = EXPECTED[name]
    trained = _ids(strict) | (_ids(added) if relaxed else {})
    return {index: trained.get(index, IGNORE) for index in declared}


def _mismatches(table: Taxonomy, expected: Ids) -> list[int]:
    """Ids at which a table is not as expected, one by one and through a picture."""
    every = np.array(sorted(expected), np.uint8).reshape(1, -1)
    if set(table.class_by_id) != set(expected):
        return sorted(set(table.class_by_id) ^ set(expected))
    found = table.train_ids(every, where="every id")
    return [int(i) for i, t in zip(every[0], found[0], strict=True) if expected[int(i)] != t]


def _swapped(table: Taxonomy, first: int, second: int) -> Taxonomy:
    classes = dict(table.class_by_id)
    classes[first], classes[second] = classes[second], classes[first]
    return Taxonomy(table.name, classes, table.names)


def test_every_table_is_tested() -> None:
    assert set(EXPECTED) == set(SPOT_NAMES) == set(TAXONOMIES)


@pytest.mark.parametrize("relaxed", [False, True])
@pytest.mark.parametrize("name", EXPECTED)
def test_each_id_has_its_train_id(name: str, relaxed: bool) -> None:
    assert _mismatches(taxonomy(name, relaxed=relaxed), _expected(name, relaxed)) == []


@pytest.mark.parametrize("name", EXPECTED)
def test_two_ids_swapped_are_found(name: str) -> None:
    table = taxonomy(name)
    expected = _expected(name, relaxed=False)
    first = next(index for index, train in expected.items() if train != IGNORE)
    for second in expected:
        if expected[first] != expected[second]:
            assert _mismatches(_swapped(table, first, second), expected) == sorted([first, second])


@pytest.mark.parametrize("name", EXPECTED)
def test_every_id_has_a_name_and_every_class_is_one_of_the_19(name: str) -> None:
    for relaxed in (False, True):
        table = taxonomy(name, relaxed=relaxed)
        assert table.names.keys() == table.class_by_id.keys()
        assert all(table.names.values())
        assert set(table.class_by_id.values()) <= {*CLASSES, None}
    assert {index: table.names[index] for index in SPOT_NAMES[name]} == SPOT_NAMES[name]


@pytest.mark.parametrize("name", EXPECTED)
def test_relaxed_adds_what_is_stated_and_changes_nothing_else(name: str) -> None:
    strict, relaxed = taxonomy(name), taxonomy(name, relaxed=True)
    differing = {i for i in strict.class_by_id if strict.class_by_id[i] != relaxed.class_by_id[i]}
    assert differing == set(_ids(EXPECTED[name][2]))
    assert all(strict.class_by_id[index] is None for index in differing)
    assert strict.name == name
    assert ("relaxed" in relaxed.name) == bool(differing)


@pytest.mark.parametrize("name", EXPECTED)
def test_every_name_in_a_table_leads_somewhere(name: str) -> None:
    """A misspelt name would silently ignore its class."""
    table = _class_tables.TABLES[name]
    assert {*table.classes, *table.relaxed} <= set(table.names.values())
    assert not table.classes.keys() & table.relaxed.keys()
    assert not set(table.other_names) & set(table.names.values())


@pytest.mark.parametrize("name", EXPECTED)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.int64, np.uint64])
def test_pictures_of_any_integer_and_points_are_mapped(name: str, dtype: type) -> None:
    expected = _expected(name, relaxed=False)
    ids = np.array(sorted(expected), dtype)
    ids.setflags(write=False)
    trains = [expected[int(index)] for index in ids]
    points = taxonomy(name).train_ids(ids, where="points")
    picture = taxonomy(name).train_ids(np.stack([ids, ids[::-1]]), where="picture")
    assert (points.dtype, points.tolist()) == (np.uint8, trains)
    assert picture.tolist() == [trains, trains[::-1]]


def test_train_ids_come_back_from_every_class_that_has_one_id() -> None:
    label = np.arange(19, dtype=np.uint8).reshape(1, -1)
    for name in ("cityscapes", "bdd100k_raw"):
        id_of = {c: i for i, c in taxonomy(name).class_by_id.items() if c is not None}
        written = np.array([[id_of[c] for c in CLASSES]], np.uint8)
        np.testing.assert_array_equal(label, taxonomy(name).train_ids(written, where="written"))


# CamVid by colour: colours and train ids written from the colour table.
CAMVID_COLOURS = {
    (64, 128, 64): 255,
    (192, 0, 128): 255,
    (0, 128, 192): 12,
    (0, 128, 64): 255,
    (128, 0, 0): 2,
    (64, 0, 128): 13,
    (64, 0, 192): 255,
    (192, 128, 64): 11,
    (192, 192, 128): 5,
    (64, 64, 128): 4,
    (128, 0, 192): 0,
    (192, 0, 64): 0,
    (128, 128, 64): 255,
    (192, 0, 192): 17,
    (128, 64, 64): 255,
    (64, 192, 128): 255,
    (64, 64, 0): 11,
    (128, 64, 128): 0,
    (128, 128, 192): 255,
    (0, 0, 192): 1,
    (192, 128, 128): 7,
    (128, 128, 128): 10,
    (64, 128, 192): 13,
    (0, 0, 64): 255,
    (0, 64, 64): 6,
    (192, 64, 128): 16,
    (128, 128, 0): 8,
    (192, 128, 192): 255,
    (64, 0, 64): 255,
    (192, 192, 0): 8,
    (0, 0, 0): 255,
    (64, 192, 0): 3,
}


def _wrong_colours(table: Taxonomy) -> list[tuple[int, int, int]]:
    rgb = np.array([list(CAMVID_COLOURS)], np.uint8)
    found = table.train_ids_of_colours(rgb, where="a.png")[0]
    return [c for c, t in zip(CAMVID_COLOURS, found, strict=True) if CAMVID_COLOURS[c] != t]


def test_each_colour_of_camvid_has_its_train_id() -> None:
    table = taxonomy("camvid32")
    assert len(set(table.colours.values())) == len(table.colours) == 32
    assert set(table.colours.values()) == set(CAMVID_COLOURS)
    assert _wrong_colours(table) == []


def test_two_colours_swapped_are_found() -> None:
    table = taxonomy("camvid32")
    table.colours[17], table.colours[21] = table.colours[21], table.colours[17]
    assert sorted(_wrong_colours(table)) == [(128, 64, 128), (128, 128, 128)]


LABELS_PAGE = Path(__file__).parents[1] / "docs" / "labels.md"


def _spans(ids: Iterable[int]) -> str:
    """`0, 3-5` of 0, 3, 4, 5."""
    spans: list[list[int]] = []
    for index in sorted(ids):
        if spans and index == spans[-1][1] + 1:
            spans[-1][1] = index
        else:
            spans.append([index, index])
    return ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in spans)


def _page_rows() -> list[str]:
    """The rows of the page's tables of ids: strict, then what `relaxed` adds."""
    shown = [name for name in TAXONOMIES if name not in ("train_ids", "bdd100k")]
    strict = {name: _expected(name, relaxed=False) for name in shown}
    rows = []
    for train, label in enumerate(CLASSES):
        cells = [_spans(i for i, t in strict[name].items() if t == train) for name in shown]
        rows.append(f"| {train} {label} | {' | '.join(cells)} |")
    for name in shown:
        added = _ids(EXPECTED[name][2])
        names = taxonomy(name).names
        cells = [f"{i} {names[i]} → {CLASSES[added[i]]}" for i in sorted(added)]
        if cells:
            rows.append(f"| `{name}` | {'; '.join(cells)} |")
    return rows


def test_the_page_about_labels_shows_these_tables() -> None:
    lines = LABELS_PAGE.read_text(encoding="utf-8").splitlines()
    for row in _page_rows():
        assert row in lines
    for name in TAXONOMIES:
        assert any(f"`{name}`" in line for line in lines)
