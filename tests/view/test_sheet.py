"""Sheets: the right pictures in the right places, with their names."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, OutputError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import PALETTE, coloured
from weather_aug.timeline import WeatherTimeline
from weather_aug.view import sheet as sheets
from weather_aug.view.sheet import (
    STATES,
    contact_sheet,
    grid,
    left_to_right,
    rig_still,
    states,
    sweep,
    transmittance_picture,
    write_png,
)
from weather_aug.weather import Weather

HEADER, MARGIN = 26, 4
PAPER = (250, 250, 250)

UInt8 = NDArray[np.uint8]


def plain(colour: tuple[int, int, int], height: int = 48, width: int = 64) -> UInt8:
    return np.full((height, width, 3), colour, np.uint8)


def tile(sheet: UInt8, row: int, column: int, height: int = 48, width: int = 64) -> UInt8:
    """The picture in a row and column of a sheet whose tiles are all of one size."""
    top = HEADER + row * (height + MARGIN)
    left = HEADER + column * (width + MARGIN)
    return sheet[top : top + height, left : left + width]


def test_a_grid_has_room_for_its_tiles_and_names() -> None:
    rows = [[plain((200, 0, 0)), plain((0, 200, 0))], [plain((0, 0, 200)), plain((9, 9, 9))]]
    sheet = grid(rows, ["a", "b"], ["c", "d"], 64)
    assert (sheet.dtype, sheet.shape) == (
        np.uint8,
        (HEADER + 2 * (48 + MARGIN), HEADER + 2 * (64 + MARGIN), 3),
    )
    for row in range(2):
        for column in range(2):
            assert (tile(sheet, row, column) == rows[row][column]).all()


def test_names_are_drawn_beside_and_above_and_nowhere_else() -> None:
    rows = [[plain((9, 9, 9))], [plain((9, 9, 9))]]
    named = grid(rows, ["rain", "snow"], ["light"], 64)
    blank = grid(rows, ["", ""], [""], 64)
    drawn = (named != blank).any(axis=-1)
    assert drawn[:HEADER, HEADER:].any()
    for row in range(2):
        top = HEADER + row * (48 + MARGIN)
        assert drawn[top : top + 48, :HEADER].any()
    assert not drawn[HEADER:, HEADER:].any()
    assert (blank[:HEADER] == PAPER).all()
    assert (named[:HEADER].min(), named[:HEADER].max()) == (pytest.approx(30, abs=40), 250)


def test_other_names_give_other_sheets() -> None:
    sheets = {grid([[plain((0, 0, 0))]], [name], [""], 64).tobytes() for name in ("rain", "snow")}
    assert len(sheets) == 2


@pytest.mark.parametrize(("size", "width"), [((48, 64), 32), ((48, 64), 128), ((31, 77), 50)])
def test_tiles_are_scaled_in_proportion(size: tuple[int, int], width: int) -> None:
    sheet = grid([[plain((10, 20, 30), *size)]], [""], [""], width)
    height = round(size[0] * width / size[1])
    assert sheet.shape == (HEADER + height + MARGIN, HEADER + width + MARGIN, 3)
    assert (tile(sheet, 0, 0, height, width) == (10, 20, 30)).all()


def test_rows_of_different_heights_do_not_overlap() -> None:
    rows = [[plain((1, 1, 1), 20)], [plain((2, 2, 2), 70)], [plain((3, 3, 3), 48)]]
    sheet = grid(rows, ["", "", ""], [""], 64)
    assert sheet.shape[0] == HEADER + 20 + 70 + 48 + 3 * MARGIN
    for colour, height in ((1, 20), (2, 70), (3, 48)):
        assert int((sheet == colour).all(axis=-1).sum()) == height * 64


@pytest.mark.parametrize(
    ("rows", "width", "says"),
    [
        ([], 64, "at least one"),
        ([[]], 64, "at least one"),
        ([[plain((0, 0, 0))]], 0, "tile_width"),
        ([[plain((0, 0, 0))]], -3, "tile_width"),
        ([[plain((0, 0, 0))]], 10**6, "tile_width"),
    ],
)
def test_an_empty_or_boundless_sheet_is_refused(rows: Any, width: int, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        grid(rows, [""] * len(rows), [], width)


def test_a_sweep_shows_each_weather_and_severity(tiny_scene: WeatherScene) -> None:
    key = tiny_scene.keys[2]
    sheet = sweep(tiny_scene, key, seed=3, tile_width=64)
    assert sheet.shape == (HEADER + 3 * (48 + MARGIN), HEADER + 5 * (64 + MARGIN), 3)
    for row, make in enumerate((Weather.rain, Weather.snow, Weather.fog)):
        assert (tile(sheet, row, 0) == tiny_scene.frame(key).image).all()
        for column, severity in enumerate(("light", "moderate", "heavy", "extreme"), start=1):
            weather = make(severity)
            expected = tiny_scene.render(key, weather, seed=3, air=Air.held(weather)).image
            assert (tile(sheet, row, column) == expected).all(), (row, severity)


def test_a_sweep_shows_the_middle_frame_unless_told(tiny_scene: WeatherScene) -> None:
    middle = sweep(tiny_scene, FrameKey(2, "front"), kinds=["fog"], severities=[0.3], tile_width=64)
    assert (sweep(tiny_scene, kinds=["fog"], severities=[0.3], tile_width=64) == middle).all()
    assert middle.shape == (HEADER + 48 + MARGIN, HEADER + 2 * (64 + MARGIN), 3)


@pytest.mark.parametrize(
    "arguments",
    [
        {"kinds": ["hail"]},
        {"kinds": []},
        {"severities": ["mild"]},
        {"key": FrameKey(99, "front")},
        {"tile_width": 0},
    ],
    ids=str,
)
def test_a_sweep_of_nothing_known_is_refused(
    tiny_scene: WeatherScene, arguments: dict[str, Any]
) -> None:
    with pytest.raises(ArgumentError):
        sweep(tiny_scene, **arguments)


def test_a_contact_sheet_shows_label_and_transmittance_below(tiny_scene: WeatherScene) -> None:
    keys = tiny_scene.keys[:2]
    sheet = contact_sheet(tiny_scene, keys, severities=("heavy",), tile_width=64)
    columns = ["clear", *STATES, "rain", "snow", "fog"]
    assert sheet.shape == (HEADER + 6 * (48 + MARGIN), HEADER + 8 * (64 + MARGIN), 3)
    assert (tile(sheet, 0, 0) == tiny_scene.frame(keys[0]).image).all()
    weathers = {"snow": Weather.snow("heavy"), "fresh snow, clear air": None}
    for name, weather in weathers.items():
        weather = weather or STATES[name]
        shot = tiny_scene.render(keys[1], weather, air=Air.held(weather))
        assert shot.label is not None
        column = columns.index(name)
        assert (tile(sheet, 3, column) == shot.image).all()
        assert (tile(sheet, 4, column) == coloured(shot.label)).all()
        assert (tile(sheet, 5, column) == transmittance_picture(shot.transmittance)).all()


def test_a_contact_sheet_without_labels_has_no_row_for_them(unlabelled_scene: WeatherScene) -> None:
    keys = unlabelled_scene.keys[:1]
    sheet = contact_sheet(unlabelled_scene, keys, severities=("heavy",), tile_width=64)
    assert sheet.shape[0] == HEADER + 2 * (48 + MARGIN)


def state_tile(sheet: UInt8, row: int, column: int) -> UInt8:
    """A picture of a sheet of states, whose rows have a heading each."""
    return tile(sheet[row * (HEADER + 48 + MARGIN) :], 0, column)


def check_states(scene: WeatherScene) -> None:
    """The recorded frame, the four states in order, and what the fog leaves of the label."""
    key = scene.keys[2]
    sheet = states(scene, key, seed=3, tile_width=64)
    assert sheet.shape == (2 * (HEADER + 48 + MARGIN), HEADER + 3 * (64 + MARGIN), 3)
    assert (state_tile(sheet, 0, 0) == scene.frame(key).image).all()
    places = ((0, 1), (0, 2), (1, 0), (1, 1))
    shots = [scene.render(key, w, seed=3, air=Air.held(w)) for w in STATES.values()]
    for place, shot in zip(places, shots, strict=True):
        assert (state_tile(sheet, *place) == shot.image).all(), place
    left = shots[2]
    painted = (
        transmittance_picture(left.transmittance) if left.label is None else coloured(left.label)
    )
    assert (state_tile(sheet, 1, 2) == painted).all()


def test_states_stand_in_their_places(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene
) -> None:
    check_states(tiny_scene)
    check_states(unlabelled_scene)


def test_pictures_in_wrong_places_would_be_seen(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sheets, "STATES", dict(reversed(STATES.items())))
    with pytest.raises(AssertionError):
        check_states(tiny_scene)


def test_the_states_are_those_of_ground_air_and_glass() -> None:
    wet, snow, fog, glass = STATES.values()
    assert (wet.wetness, wet.rain_mm_per_h, wet.lens_drops) == (1.0, 0.0, 0.0)
    assert (snow.snow_mm_per_h, snow.mist_per_km) == (0.0, 0.0)
    assert snow.snow_cover >= 0.9
    assert snow.visibility_m == np.inf
    assert fog.visibility_m < 100
    assert fog.lamps == 1.0
    assert glass.rain_mm_per_h >= 20
    assert glass.lens_drops > Weather.rain("heavy").lens_drops


def test_sheets_pass_options_on(tiny_scene: WeatherScene) -> None:
    key = tiny_scene.keys[0]
    bare = RenderOptions(without=("relight", "sky", "film", "mirror", "puddles", "exposure"))
    weather = Weather.rain("heavy", falling=False)
    expected = tiny_scene.render(key, weather, air=Air.held(weather), options=bare).image
    assert (
        state_tile(states(tiny_scene, key, tile_width=64, options=bare), 0, 1) == expected
    ).all()
    keyed = contact_sheet(tiny_scene, [key], severities=(), tile_width=64, options=bare)
    assert (tile(keyed, 0, 1) == expected).all()
    fog = Weather.fog(0.3)
    expected = tiny_scene.render(key, fog, air=Air.held(fog), options=bare).image
    swept = sweep(tiny_scene, key, kinds=["fog"], severities=[0.3], tile_width=64, options=bare)
    assert (tile(swept, 0, 1) == expected).all()
    plain_sweep = sweep(tiny_scene, key, kinds=["fog"], severities=[0.3], tile_width=64)
    assert (plain_sweep != swept).any()


def test_a_rig_still_shows_all_cameras_of_a_moment(tiny_scene: WeatherScene) -> None:
    weather = WeatherTimeline.transition(Weather.clear(), Weather.snow("heavy"), 0.1, 0.3)
    sheet = rig_still(tiny_scene, 2, weather, seed=3, tile_width=64)
    assert sheet.shape == (HEADER + 48 + MARGIN, HEADER + 2 * (64 + MARGIN), 3)
    for column, camera in enumerate(("front", "right")):
        expected = tiny_scene.render(FrameKey(2, camera), weather, seed=3).image
        assert (tile(sheet, 0, column) == expected).all()
    with pytest.raises(ArgumentError, match="it has 0 to 3"):
        rig_still(tiny_scene, 4, weather)


@pytest.mark.parametrize("heading_deg", [0, 100, 170, 190, 300])
@pytest.mark.parametrize(
    "yaws_deg",
    [{"a": 0}, {"b": 50, "a": 0, "c": -50}, {"d": 110, "b": 55, "a": 0, "c": -55, "e": -110}],
    ids=len,
)
def test_cameras_stand_from_left_to_right_wherever_the_street_leads(
    yaws_deg: dict[str, float], heading_deg: float
) -> None:
    scene = Rig({name: np.radians(yaw + heading_deg) for name, yaw in yaws_deg.items()})
    keys = [FrameKey(0, name) for name in sorted(yaws_deg)]
    assert [key.camera for key in left_to_right(scene, keys)] == list(yaws_deg)  # type: ignore[arg-type]


class Rig:
    """Cameras that look along yaws (to the left, radians), as a scene's manifest tells of them."""

    def __init__(self, yaws: dict[str, float]) -> None:
        poses = {FrameKey(0, name): np.eye(4) for name in yaws}
        for (_, name), pose in poses.items():
            pose[:3, 2] = np.cos(yaws[name]), np.sin(yaws[name]), 0
        cameras = {key: SimpleNamespace(world_from_camera=pose) for key, pose in poses.items()}
        self.manifest = SimpleNamespace(
            axes_world=np.eye(3),
            by_key={key: SimpleNamespace(camera=camera) for key, camera in cameras.items()},
        )


def test_transmittance_rises_from_dark_to_bright() -> None:
    picture = transmittance_picture(np.linspace(0, 1, 256, dtype=np.float32)[None])
    luminance = picture[0] @ [0.2126, 0.7152, 0.0722]
    assert picture.shape == (1, 256, 3)
    assert luminance[0] < 40
    assert luminance[-1] > 200
    assert (np.diff(luminance) > -1).all()


def test_colours_of_classes_are_the_cityscapes_palette() -> None:
    label = np.array([[0, 13, 18, 255, 30]], np.uint8)
    black = (0, 0, 0)
    expected = [[PALETTE[0], PALETTE[13], PALETTE[18], black, black]]
    assert coloured(label).tolist() == np.array(expected).tolist()


def test_pictures_and_labels_are_written_as_they_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    label = rng.integers(0, 19, (5, 7), dtype=np.uint8)
    write_png(tmp_path / "a" / "b" / "picture.png", picture)
    write_png(tmp_path / "label.png", label)
    read = cv2.imread(str(tmp_path / "a" / "b" / "picture.png"), cv2.IMREAD_COLOR_RGB)
    assert (read == picture).all()
    assert (cv2.imread(str(tmp_path / "label.png"), cv2.IMREAD_UNCHANGED) == label).all()
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["label.png", "picture.png"]


def test_what_cannot_be_written_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_png(tmp_path / "file" / "picture.png", plain((0, 0, 0)))
