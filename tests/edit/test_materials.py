"""What each class does with water and snow: no class forgotten, nobody snowed in."""

import numpy as np
import pytest

from weather_aug.edit.physical import materials
from weather_aug.edit.physical.materials import MATERIALS, Material, material_table
from weather_aug.taxonomy import CLASSES, GROUND, IGNORE, ROAD, SKY, TRAIN_ID

PEOPLE = (TRAIN_ID["person"], TRAIN_ID["rider"])
COLUMNS = {name: index for index, name in enumerate(Material._fields)}


def check_bare(table):
    """No snow on people and the sky, nothing at all on what has no class."""
    snowy = [COLUMNS[name] for name in ("cover", "cap_m", "leaf", "level", "buried")]
    for index in (*PEOPLE, SKY):
        assert not table[index, snowy].any()
    assert not table[SKY].any()
    assert not table[len(CLASSES) :].any()


@pytest.mark.parametrize("labelled", [True, False])
def test_people_the_sky_and_the_unknown_stay_bare(labelled):
    check_bare(material_table(labelled=labelled))


@pytest.mark.parametrize("name", ["person", "rider", "sky"])
def test_snow_on_them_is_found(monkeypatch, name):
    snowed = {**MATERIALS, name: MATERIALS[name]._replace(cover=0.2)}
    monkeypatch.setattr(materials, "MATERIALS", snowed)
    with pytest.raises(AssertionError):
        check_bare(material_table(labelled=True))


def test_the_columns_have_their_names():
    table = material_table(labelled=True)
    names = ("POROSITY", "MIRROR", "COVER", "CAP_M", "LEAF", "LEVEL", "BURIED")
    assert tuple(name.lower() for name in names) == Material._fields
    for name in CLASSES:
        row = [table[TRAIN_ID[name], getattr(materials, column)] for column in names]
        np.testing.assert_array_equal(row, np.float32(MATERIALS[name]))


def test_every_class_has_a_material_and_shares_are_shares():
    assert set(MATERIALS) == set(CLASSES)
    table = material_table(labelled=True)
    assert table.shape == (256, len(Material._fields) + 2)
    assert table.dtype == np.float32
    assert table.min() >= 0
    assert table.max() <= 1


def test_ground_and_road_are_those_of_the_taxonomy():
    table = material_table(labelled=True)
    assert set(np.flatnonzero(table[:, materials.GROUND])) == set(GROUND)
    assert set(np.flatnonzero(table[:, materials.ROAD])) == {ROAD}
    assert not table[IGNORE].any()


def test_only_the_ground_mirrors_and_grass_does_not():
    table = material_table(labelled=True)
    mirrors = {CLASSES[i] for i in np.flatnonzero(table[:, materials.MIRROR])}
    assert mirrors == {"road", "sidewalk"}


def test_guessed_walls_hold_snow_on_their_edges_only():
    labelled, guessed = (material_table(labelled=known) for known in (True, False))
    assert labelled[TRAIN_ID["building"], materials.LEVEL] > 0
    assert not guessed[:, materials.LEVEL].any()
    others = [i for i in range(guessed.shape[1]) if i != materials.LEVEL]
    np.testing.assert_array_equal(labelled[:, others], guessed[:, others])


def test_it_cannot_be_written():
    assert not material_table(labelled=True).flags.writeable
