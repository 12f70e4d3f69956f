"""Taxonomies: how a table is found, what it maps, what it refuses, and masks of uncertainty."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from weather_aug import _class_tables
from weather_aug._class_tables.lookup import plain
from weather_aug.errors import ArgumentError, DataError
from weather_aug.taxonomy import (
    CLASSES,
    PALETTE,
    TAXONOMIES,
    Taxonomy,
    certain_train_ids,
    coloured,
    nuscenes_lidarseg,
    taxonomy,
    taxonomy_of_names,
)


@given(data=st.data(), name=st.sampled_from(TAXONOMIES))
def test_an_undeclared_id_is_refused_where_it_stands(data: st.DataObject, name: str) -> None:
    declared = sorted(taxonomy(name).class_by_id)
    label = np.full((3, 5), declared[0], np.int64)
    wrong = data.draw(st.integers(-(2**40), 2**40).filter(lambda i: i not in declared))
    row, column = data.draw(st.integers(0, 2)), data.draw(st.integers(0, 4))
    label[row, column] = wrong
    with pytest.raises(DataError, match=rf"a\.png.* {wrong} at row {row}, column {column}"):
        taxonomy(name).train_ids(label, where="a.png")


@pytest.mark.parametrize("wrong", [26_001, 7 * 256 + 3])
def test_an_instance_picture_is_told_from_a_semantic_one(wrong: int) -> None:
    with pytest.raises(DataError, match="instances"):
        taxonomy("kitti360").train_ids(np.full((2, 2), wrong, np.uint16), where="a.png")


@given(
    label=arrays.arrays(
        st.sampled_from([np.float32, np.float64, np.bool_, np.complex64]), (2, 3), fill=st.just(0)
    )
)
def test_what_is_no_integer_is_refused(label: np.ndarray) -> None:
    with pytest.raises(ArgumentError, match=r"mask must be a numpy array of integer ids"):
        taxonomy("cityscapes").train_ids(label, where="mask")


@given(shape=arrays.array_shapes(min_dims=3, max_dims=5, max_side=3) | st.just(()))
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ArgumentError, match=r"mask .*\(H, W\)"):
        taxonomy("cityscapes").train_ids(np.zeros(shape, np.uint8), where="mask")


def test_lists_are_refused() -> None:
    with pytest.raises(ArgumentError, match="got list"):
        taxonomy("cityscapes").train_ids([[7]], where="mask")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("spelt", "name"),
    [
        ("Cityscapes", "cityscapes"),
        ("KITTI-360", "kitti360"),
        ("kitti_360", "kitti360"),
        ("Mapillary Vistas v2.0", "mapillary_v2.0"),
        ("mapillary_v1", "mapillary_v1.2"),
        ("acdc_train_ids", "train_ids"),
        ("acdc_label_ids", "cityscapes"),
        ("MUSES label ids", "cityscapes"),
        ("bdd", "bdd100k"),
        ("lidarseg", "nuscenes_lidarseg"),
        ("PandaSet", "pandaset"),
    ],
)
def test_other_spellings_are_understood(spelt: str, name: str) -> None:
    assert taxonomy(spelt) == taxonomy(name)


@pytest.mark.parametrize("unclear", ["acdc", "MUSES", "nuScenes", "camvid", "Mapillary"])
def test_a_name_that_fits_two_tables_is_refused_with_both(unclear: str) -> None:
    with pytest.raises(ArgumentError, match="more than one") as caught:
        taxonomy(unclear)
    cured = [word for word in _words(str(caught.value)) if word in _known()]
    assert len(cured) == 2


def _words(text: str) -> list[str]:
    return [word.strip(",:;") for word in text.split()]


def _known() -> set[str]:
    return {*TAXONOMIES, *_class_tables.ALIASES}


def test_no_two_spellings_are_one() -> None:
    words = [plain(w) for w in (*TAXONOMIES, *_class_tables.ALIASES, *_class_tables.AMBIGUOUS)]
    assert len(set(words)) == len(words)
    assert set(_class_tables.ALIASES.values()) <= set(TAXONOMIES)


def test_an_unknown_name_lists_what_there_is() -> None:
    with pytest.raises(ArgumentError, match="no taxonomy 'cityscape'; did you mean 'cityscapes'"):
        taxonomy("cityscape")
    with pytest.raises(ArgumentError, match="no taxonomy 'zzz'; there are") as caught:
        taxonomy("zzz")
    assert all(name in str(caught.value) for name in TAXONOMIES)


def test_a_table_that_was_handed_out_can_be_spoilt_by_nobody_else() -> None:
    taxonomy("cityscapes").class_by_id[7] = "sky"
    taxonomy("cityscapes").names.clear()
    assert taxonomy("cityscapes").class_by_id[7] == "road"
    assert taxonomy("cityscapes").names[7] == "road"


def test_tables_travel_to_other_processes() -> None:
    table = taxonomy("camvid32", relaxed=True)
    assert pickle.loads(pickle.dumps(table)) == table


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"class_by_id": {256: None}}, "id 256"),
        ({"class_by_id": {-1: None}}, "id -1"),
        ({"class_by_id": {"7": "road"}}, "id 7"),
        ({"class_by_id": {1: "raod"}}, "'raod'"),
        ({"class_by_id": {1: "road"}, "names": {2: "b"}}, "names has the id 2"),
        ({"class_by_id": {1: "road"}, "colours": {2: (0, 0, 0)}}, "colours has the id 2"),
        (
            {"class_by_id": {1: "road", 2: "sky"}, "colours": {1: (0, 0, 0), 2: (0, 0, 0)}},
            "one colour",
        ),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(arguments: dict, expected: str) -> None:
    with pytest.raises(ArgumentError, match=expected):
        Taxonomy("mine", **arguments)


CAMVID_COLOURS = set(taxonomy("camvid32").colours.values())


@given(colour=st.tuples(*[st.integers(0, 255)] * 3).filter(lambda c: c not in CAMVID_COLOURS))
def test_an_undeclared_colour_is_refused_where_it_stands(colour: tuple[int, int, int]) -> None:
    rgb = np.zeros((2, 3, 3), np.uint8)
    rgb[1, 2] = colour
    with pytest.raises(DataError, match=r"a\.png: colour \(.*\) at row 1, column 2") as caught:
        taxonomy("camvid32").train_ids_of_colours(rgb, where="a.png")
    assert str(colour) in str(caught.value)


def test_colours_need_a_table_and_a_picture() -> None:
    rgb = np.zeros((2, 3, 3), np.uint8)
    with pytest.raises(ArgumentError, match="no table of colours"):
        taxonomy("mapillary_v1.2").train_ids_of_colours(rgb, where="a.png")
    for wrong in (rgb[..., 0], rgb.astype(np.int64), np.zeros((2, 3, 4), np.uint8)):
        with pytest.raises(ArgumentError, match=r"a\.png"):
            taxonomy("camvid32").train_ids_of_colours(wrong, where="a.png")
    with pytest.raises(ArgumentError, match="holds colours"):
        taxonomy("camvid32").train_ids(rgb, where="a.png")


# An order of CamVid's classes that another release has, with markings of their own.
OTHER_CAMVID = """Sky Building Column_Pole Road_marking Road Pavement Tree SignSymbol Fence Car
    Pedestrian Bicyclist Unlabelled""".split()


def test_camvid_is_read_by_name_in_any_order() -> None:
    table = taxonomy_of_names("camvid11", OTHER_CAMVID)
    expected = [10, 2, 5, 0, 0, 1, 8, 7, 4, 13, 11, 12, 255]
    label = np.array([[*range(13), 255]], np.uint8)
    assert [[*expected, 255]] == table.train_ids(label, where="a.png").tolist()
    backwards = {12 - index: name.upper() for index, name in enumerate(OTHER_CAMVID)}
    table = taxonomy_of_names("camvid11", backwards)
    assert [[*expected[::-1], 255]] == table.train_ids(label, where="a.png").tolist()


@given(name=st.sampled_from(TAXONOMIES), relaxed=st.booleans(), data=st.data())
def test_names_in_any_order_lead_to_their_classes(
    name: str, relaxed: bool, data: st.DataObject
) -> None:
    table = taxonomy(name, relaxed=relaxed)
    class_of = {table.names[index]: table.class_by_id[index] for index in table.names}
    shuffled = data.draw(st.permutations(list(class_of)))
    found = taxonomy_of_names(name, shuffled, relaxed=relaxed)
    assert [class_of[label] for label in shuffled] == [
        found.class_by_id[index] for index in range(len(shuffled))
    ]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([*OTHER_CAMVID, "Moose"], "'Moose', which is no class of camvid11"),
        ([*OTHER_CAMVID, "sky"], "twice"),
        (OTHER_CAMVID[1:], "no class for sky"),
        ("Sky", "must be a list or a mapping"),
        (dict(enumerate(OTHER_CAMVID, 250)), "id 256"),
    ],
)
def test_lists_of_names_that_do_not_fit_are_refused(names: list[str], expected: str) -> None:
    with pytest.raises(ArgumentError, match=expected):
        taxonomy_of_names("camvid11", names)


INSTRUCTIONS_ORDER = {
    25: "flat.sidewalk",
    26: "flat.terrain",
    27: "flat.other",
    28: "static.manmade",
    29: "static.vegetation",
    30: "static.other",
}


def _category_json(folder: Path, name_by_id: dict[int, str]) -> Path:
    records = [
        {"token": f"{index:032x}", "name": name, "description": "", "index": index}
        for index, name in name_by_id.items()
    ]
    path = folder / "category.json"
    path.write_text(json.dumps(records), encoding="utf-8")
    return path


def test_lidarseg_takes_its_ids_from_the_data_sets_own_file(tmp_path: Path) -> None:
    named = taxonomy("nuscenes_lidarseg")
    path = _category_json(tmp_path, named.names)
    assert nuscenes_lidarseg(path).class_by_id == named.class_by_id
    other = nuscenes_lidarseg(_category_json(tmp_path, named.names | INSTRUCTIONS_ORDER))
    label = np.arange(24, 32, dtype=np.uint8)
    assert other.train_ids(label, where="a.bin").tolist() == [0, 1, 9, 255, 255, 8, 255, 255]
    relaxed = nuscenes_lidarseg(str(_category_json(tmp_path, named.names)), relaxed=True)
    assert relaxed.class_by_id == taxonomy("nuscenes_lidarseg", relaxed=True).class_by_id


def test_a_category_file_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    names = taxonomy("nuscenes_lidarseg").names
    path = tmp_path / "category.json"

    def refused(match: str) -> None:
        with pytest.raises(DataError, match=match) as caught:
            nuscenes_lidarseg(path)
        assert "category.json" in str(caught.value)

    refused("cannot read")
    _category_json(tmp_path, {i: n for i, n in names.items() if n != "static.other"})
    refused("lacks static.other")
    _category_json(tmp_path, names | {32: "vehicle.tram"})
    refused("has vehicle.tram as well")
    _category_json(tmp_path, names | {32: "noise"})
    refused("twice")
    _category_json(tmp_path, names | {256: "vehicle.tram"})
    refused("an index in 0..255")
    path.write_text(json.dumps([{"token": "a", "name": "noise"}]), encoding="utf-8")
    refused("unpacked")
    path.write_text("{}", encoding="utf-8")
    refused("list of categories")
    path.write_text("[", encoding="utf-8")
    refused("not valid JSON")


def test_uncertain_pixels_are_ignored() -> None:
    label = np.array([[0, 10, 13, 255]], np.uint8)
    label.setflags(write=False)
    acdc = np.array([[0, 1, 0, 1]], np.uint8)
    muses = np.array([[0, 127, 255, 255]], np.uint8)
    found = certain_train_ids(label, acdc, kind="acdc", where="a.png")
    assert (found.dtype, found.tolist()) == (np.uint8, [[0, 255, 13, 255]])
    found = certain_train_ids(label, muses, kind="muses", where="a.png")
    assert found.tolist() == [[0, 10, 255, 255]]


def test_masks_of_another_kind_or_shape_are_refused() -> None:
    label = np.zeros((2, 3), np.uint8)
    mask = np.zeros((2, 3), np.uint8)
    mask[1, 2] = 255
    with pytest.raises(DataError, match=r"a\.png: value 255 at row 1, column 2 .*acdc"):
        certain_train_ids(label, mask, kind="acdc", where="a.png")
    with pytest.raises(DataError, match=r"value 1 .*muses"):
        certain_train_ids(label, mask // 255, kind="muses", where="a.png")
    with pytest.raises(DataError, match="label id 33"):
        certain_train_ids(label + 33, mask, kind="muses", where="a.png")
    with pytest.raises(ArgumentError, match=r"a\.png must have the image's shape"):
        certain_train_ids(label, mask[:1], kind="muses", where="a.png")
    with pytest.raises(ArgumentError, match="integer ids"):
        certain_train_ids(label, mask == 255, kind="acdc", where="a.png")
    with pytest.raises(ArgumentError, match="kind must be one of acdc, muses"):
        certain_train_ids(label, mask, kind="kitti", where="a.png")  # type: ignore[arg-type]


def test_classes_have_the_palettes_colours() -> None:
    label = np.array([[0, 10, 18, 255]], np.uint8)
    assert coloured(label).tolist() == [[[128, 64, 128], [70, 130, 180], [119, 11, 32], [0, 0, 0]]]
    assert len(CLASSES) == len(PALETTE) == len(set(PALETTE)) == 19


def test_importing_the_tables_imports_no_numpy() -> None:
    code = "import sys, weather_aug.taxonomy; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
