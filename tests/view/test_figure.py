"""Figures: the right pictures under the right titles, in a notebook and without pyplot."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from tiny_clip import digests_of

from weather_aug import preview
from weather_aug.air import Air
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, DataError, MissingExtraError, SceneError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import PALETTE, SKY, coloured
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.picture import Drawn, Weathering
from weather_aug.view.planes import painted
from weather_aug.view.sheet import transmittance_picture
from weather_aug.view.units import in_units
from weather_aug.weather import Weather

pytest.importorskip("matplotlib", reason="matplotlib is not installed: extra notebook")

from matplotlib.backends.backend_agg import FigureCanvasAgg

from weather_aug.view import figure as figures

UInt8 = NDArray[np.uint8]
FOG = {"kinds": ["fog"], "severities": ["heavy"]}


def shown(figure: Any) -> list[UInt8]:
    """Pictures from left to right, then down."""
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes]


def titles(figure: Any) -> list[str]:
    return [axes.get_title() for axes in figure.axes]


def names(figure: Any) -> list[str]:
    """Of the rows, from the top."""
    return [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]


def check_places(figure: Any) -> None:
    """Texts and pictures lie inside the figure, and none over another."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = []
    for axes in figure.axes:
        boxes.append(axes.get_window_extent(renderer))
        texts = (axes.title, axes.yaxis.label)
        boxes += [text.get_window_extent(renderer) for text in texts if text.get_text()]
    width, height = canvas.get_width_height()
    for number, box in enumerate(boxes):
        assert box.x0 >= -1
        assert box.y0 >= -1
        assert box.x1 <= width + 1
        assert box.y1 <= height + 1
        for other in boxes[:number]:
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            down = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert min(across, down) < 1, (box, other)


def test_a_sweep_has_its_pictures_titles_and_names(tiny_scene: WeatherScene) -> None:
    key = tiny_scene.keys[2]
    figure = preview.sweep(tiny_scene, key, seed=3)
    assert names(figure) == ["rain", "snow", "fog"]
    assert titles(figure)[:5] == [
        *("clear", "light: 1.5 mm/h", "moderate: 5 mm/h"),
        *("heavy: 20 mm/h", "extreme: 75 mm/h"),
    ]
    assert titles(figure)[7] == "moderate: 1 mm/h of water"
    assert titles(figure)[-1] == "extreme: visibility 50 m"
    pictures = shown(figure)
    assert len(pictures) == 15
    for row, make in enumerate((Weather.rain, Weather.snow, Weather.fog)):
        assert (pictures[5 * row] == tiny_scene.frame(key).image).all()
        for column, severity in enumerate(("light", "moderate", "heavy", "extreme"), start=1):
            weather = make(severity)
            expected = tiny_scene.render(key, weather, seed=3, air=Air.held(weather)).image
            assert (pictures[5 * row + column] == expected).all(), (row, severity)


def test_planes_stand_below_their_picture(tiny_scene: WeatherScene) -> None:
    planes = ("image", "label", "overlay", "transmittance")
    figure = preview.sweep(tiny_scene, tiny_scene.keys[0], planes=planes, **FOG)
    assert names(figure) == ["fog", "label", "overlay", "transmittance"]
    assert titles(figure) == ["clear", "heavy: visibility 150 m", *[""] * 6]
    weather = Weather.fog("heavy")
    shot = tiny_scene.render(tiny_scene.keys[0], weather, air=Air.held(weather))
    assert shot.label is not None
    picture, label, overlay, through = shown(figure)[1::2]
    assert (label == coloured(shot.label)).all()
    mean = (picture.astype(int) + label) / 2
    assert np.abs(overlay - mean).max() <= 0.5
    assert (through == transmittance_picture(shot.transmittance)).all()


def test_the_middle_frame_is_shown_unless_told(tiny_scene: WeatherScene) -> None:
    (clear, _) = shown(preview.sweep(tiny_scene, **FOG))
    assert (clear == tiny_scene.frame(FrameKey(2, "front")).image).all()


def test_a_folder_serves_as_its_scene(tiny_scene: WeatherScene) -> None:
    expected = shown(preview.sweep(tiny_scene, **FOG))
    for folder in (tiny_scene.path, str(tiny_scene.path)):
        for one, other in zip(expected, shown(preview.sweep(folder, **FOG)), strict=True):
            assert (one == other).all()
    with pytest.raises(SceneError, match="not a scene"):
        preview.sweep("nowhere")


@pytest.mark.parametrize("tile_width", [80, 280, 500])
def test_texts_and_pictures_keep_apart(tiny_scene: WeatherScene, tile_width: int) -> None:
    both = WeatherPolicy({"rain+snow+fog": 1}, falling=1.0)
    planes = ("image", "transmittance")
    check_places(preview.sweep(tiny_scene, planes=planes, tile_width=tile_width))
    check_places(preview.draws(tiny_scene, both, count=5, columns=3, tile_width=tile_width))


@pytest.mark.parametrize("wide", [True, False], ids=["titles", "names"])
def test_texts_over_each_other_would_be_seen(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch, wide: bool
) -> None:
    monkeypatch.setattr(figures, "_font_pt", lambda texts, _: 14.0 if "clear" in texts else 5.0)
    if not wide:
        monkeypatch.setattr(figures, "_font_pt", lambda t, _: 5.0 if "clear" in t else 14.0)
    planes = ("image", "transmittance")
    with pytest.raises(AssertionError):
        check_places(preview.sweep(tiny_scene, planes=planes, tile_width=80))


def test_large_pictures_are_shrunk_and_labels_keep_their_colours(tiny_scene: WeatherScene) -> None:
    image = np.zeros((90, 700, 3), np.uint8)
    image[:, ::2] = 200
    mask = np.full((90, 700), SKY, np.uint8)
    mask[40:] = np.arange(700, dtype=np.uint8) % 2
    figure = preview.sweep(image, mask=mask, planes=("image", "label"), tile_width=300, **FOG)
    clear, _, label, _ = shown(figure)
    assert clear.shape == label.shape == (39, 300, 3)
    assert 60 < clear.mean() < 140
    assert {tuple(c) for c in label.reshape(-1, 3).tolist()} <= {PALETTE[i] for i in (0, 1, SKY)}


def test_a_single_picture_is_weathered_as_the_transforms_do(tiny_scene: WeatherScene) -> None:
    frame = tiny_scene.frame(tiny_scene.keys[0])
    image, mask = np.array(frame.image), np.array(frame.label)
    before = image.tobytes(), mask.tobytes()
    figure = preview.sweep(image, mask=mask, seed=3, planes=("image", "label"), **FOG)
    drawn = Drawn(Weather.fog("heavy"), 3, 7.5)
    expected = Weathering().render(image, drawn, mask=mask)
    clear, fog, _, label = shown(figure)
    assert (clear == image).all()
    assert (fog == expected.image).all()
    assert expected.mask is not None
    assert (label == coloured(expected.mask)).all()
    assert (image.tobytes(), mask.tobytes()) == before
    as_float = preview.sweep(image / np.float32(255), mask=mask, seed=3, **FOG)
    assert (shown(as_float)[1] == fog).all()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_picture_alone_is_enough(tiny_scene: WeatherScene) -> None:
    image = np.array(tiny_scene.frame(tiny_scene.keys[0]).image)
    clear, fog = shown(preview.sweep(image, **FOG))
    assert (clear == image).all()
    assert (fog != image).any()
    with pytest.raises(ArgumentError, match="no label to show"):
        preview.draws(image)


def test_depth_and_the_masks_ids_are_the_callers(tiny_scene: WeatherScene) -> None:
    frame = tiny_scene.frame(tiny_scene.keys[0])
    image, mask = np.array(frame.image), np.array(frame.label)
    near = np.full(mask.shape, 2.0, np.float32)
    seen = preview.sweep(image, mask=mask, depth=near, planes=("transmittance",), **FOG)
    assert (shown(seen)[1][mask != SKY, 1] > 200).all()
    with pytest.raises(DataError, match="mask"):
        preview.sweep(image, mask=np.full_like(mask, 77), **FOG)
    shifted = np.where(mask == 255, 255, mask + 100)
    names = {100 + i: name for i, name in enumerate(("road", "sidewalk", "building"))}
    names |= {105: "pole", 109: "terrain", 110: "sky"}
    own = preview.sweep(image, mask=shifted, taxonomy=names, planes=("label",), **FOG)
    assert (shown(own)[0] == coloured(mask)).all()


def test_draws_are_the_items_of_the_data_set(tiny_scene: WeatherScene) -> None:
    policy = WeatherPolicy({"rain": 1, "snow": 1, "clear": 1})
    dataset = WeatherDataset([tiny_scene], policy, seed=5)
    figure = preview.draws(tiny_scene, policy, count=11, seed=5, columns=3)
    assert len(figure.axes) == 22
    assert names(figure) == ["label"] * 4
    pictures = shown(figure)
    for number in range(11):
        epoch, index = divmod(number, len(dataset))
        dataset.set_epoch(epoch)
        item = dataset[index]
        row, column = divmod(number, 3)
        picture = pictures[6 * row + column]
        label = pictures[6 * row + min(3, 11 - 3 * row) + column]
        assert (picture == item["image"].permute(1, 2, 0).numpy()).all(), number
        assert (label == coloured(item["label"].numpy().astype(np.uint8))).all(), number
        assert titles(figure)[6 * row + column].split(":")[0] in ("rain", "snow", "clear")


def test_few_draws_are_spread_over_the_drive() -> None:
    assert figures.items(8, 4) == [(0, 0), (0, 2), (0, 4), (0, 6)]
    assert figures.items(3, 2) == [(0, 0), (0, 1)]
    assert figures.items(2, 5) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]
    assert figures.items(1, 3) == [(0, 0), (1, 0), (2, 0)]


def test_draws_take_a_policy_as_a_dict_and_a_single_picture(tiny_scene: WeatherScene) -> None:
    frame = tiny_scene.frame(tiny_scene.keys[0])
    policy = WeatherPolicy.fog(visibility_m=(50, 60))
    given = [policy, policy.to_dict()]
    one, other = (preview.draws(frame.image, p, mask=frame.label, count=3) for p in given)
    assert titles(one) == titles(other)
    assert len({picture.tobytes() for picture in shown(one)[:3]}) == 3
    assert all(title.startswith("fog: visibility 5") for title in titles(one)[:3])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kinds": ["hail"]}, "hail"),
        ({"kinds": []}, "at least one"),
        ({"severities": ["mild"]}, "mild"),
        ({"key": FrameKey(99, "front")}, "no frame"),
        ({"tile_width": 79}, "tile_width"),
        ({"tile_width": 10**6}, "tile_width"),
        ({"tile_width": 99.5}, "tile_width"),
        ({"planes": ()}, "planes"),
        ({"planes": "image"}, "planes"),
        ({"planes": ("image", "depth")}, "planes"),
        ({"seed": 1.5}, "seed"),
        ({"mask": np.zeros((48, 64), np.uint8)}, "mask is for a single picture"),
        ({"taxonomy": "camvid11"}, "taxonomy is for a single picture"),
        ({"colour": "red"}, "colour"),
        ({"options": {"preset": "unheard"}}, "preset"),
    ],
    ids=str,
)
def test_what_no_sweep_can_show_is_refused(
    tiny_scene: WeatherScene, arguments: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        preview.sweep(tiny_scene, **arguments)


def test_sources_that_are_none_are_refused(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene
) -> None:
    image, mask = np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.uint8)
    with pytest.raises(ArgumentError, match="source must be a WeatherScene"):
        preview.sweep(7)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match=r"shape \(H, W, 3\)"):
        preview.sweep(mask)
    with pytest.raises(ArgumentError, match="leave key out"):
        preview.sweep(image, FrameKey(0, "front"), mask=mask)
    with pytest.raises(ArgumentError, match="no argument colour"):
        preview.sweep(image, mask=mask, colour="red")
    with pytest.raises(ArgumentError, match="no label to show"):
        preview.sweep(unlabelled_scene, planes=("image", "label"), **FOG)
    for count in (0, 257):
        with pytest.raises(ArgumentError, match="count"):
            preview.draws(tiny_scene, count=count)
    with pytest.raises(ArgumentError, match="columns"):
        preview.draws(tiny_scene, columns=0)
    with pytest.raises(ArgumentError, match="WeatherPolicy"):
        preview.draws(tiny_scene, 3)  # type: ignore[arg-type]


def test_options_reach_the_renderer(tiny_scene: WeatherScene) -> None:
    options = RenderOptions(without=("sky", "relight", "noise", "compression", "exposure"))
    frame = tiny_scene.frame(tiny_scene.keys[0])
    for source, how in ((tiny_scene, {}), (np.array(frame.image), {"mask": frame.label})):
        plain = shown(preview.sweep(source, **FOG, **how))[1]
        bare = shown(preview.sweep(source, options=options, **FOG, **how))[1]
        assert (plain != bare).any()


def test_a_notebook_gets_a_picture_of_the_figures_size(tiny_scene: WeatherScene) -> None:
    figure = preview.sweep(tiny_scene, tile_width=100)
    with Image.open(io.BytesIO(figure._repr_png_())) as picture:
        assert picture.format == "PNG"
        width, height = picture.size
    assert (width, height) == tuple(np.round(figure.get_size_inches() * 100).astype(int))
    assert width == 24 + 5 * 106
    assert height == 3 * (22 + 75) + 6


def test_looking_changes_nothing(tiny_scene: WeatherScene) -> None:
    before = digests_of(tiny_scene.path)
    preview.sweep(tiny_scene, planes=("image", "label"))
    assert digests_of(tiny_scene.path) == before


def test_pyplot_is_left_alone_and_imports_are_late(tiny_scene: WeatherScene) -> None:
    code = (
        "import sys\n"
        "from weather_aug import preview\n"
        "heavy = {'matplotlib', 'ipywidgets', 'torch'} & set(sys.modules)\n"
        "preview.sweep(sys.argv[1], kinds=['fog'], severities=[0.5])._repr_png_()\n"
        "print(heavy, 'matplotlib.pyplot' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tiny_scene.path)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert done.stdout.strip() == "set() False"


def test_without_matplotlib_the_cure_is_named(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "weather_aug.view.figure")
    monkeypatch.delattr("weather_aug.view.figure")
    for make in (preview.sweep, preview.draws):
        with pytest.raises(MissingExtraError, match=r"pip install 'weather-aug\[notebook\]'"):
            make(tiny_scene)


@pytest.mark.parametrize(
    ("weather", "says"),
    [
        (Weather.clear(), "clear"),
        (Weather.rain(mm_per_h=123.4), "123 mm/h"),
        (Weather.rain(mm_per_h=0.456), "0.46 mm/h"),
        (Weather.snow("heavy"), "2 mm/h of water"),
        (Weather.fog(visibility_m=1234.5), "visibility 1234 m"),
        (Weather.mix(Weather.rain("light"), Weather.fog("heavy")), "1.5 mm/h, visibility 150 m"),
        (Weather.snow("heavy", falling=False), "snow on the ground"),
        (Weather.rain("heavy", falling=False), "wet ground"),
        (Weather(puddles=0.1), "wet ground"),
        (Weather(overcast=1.0), "clear air"),
        (Weather(mist_per_km=20.0), "mist"),
    ],
    ids=str,
)
def test_weathers_are_told_in_units(weather: Weather, says: str) -> None:
    assert in_units(weather) == says


def test_a_plane_without_label_says_so(unlabelled_scene: WeatherScene) -> None:
    shot = unlabelled_scene.render(unlabelled_scene.keys[0], Weather.clear())
    for plane in ("label", "overlay"):
        with pytest.raises(ArgumentError, match="nobody labelled"):
            painted(shot, plane, 64)
