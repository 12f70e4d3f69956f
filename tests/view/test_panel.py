"""The panel: what it shows is what is rendered, errors are words, and nothing is left behind."""

from __future__ import annotations

import base64
import gc
import html
import os
import re
import shutil
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scene.test_store import DEPTH_FILES, FIRST, HOSTILE, TEXTS, plant, rewrite
from tiny_clip import digests_of

from weather_aug import preview
from weather_aug._keys import key_of, uniforms
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.scene import store
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.scene.scene import WeatherScene
from weather_aug.view.panel import Panel
from weather_aug.view.planes import PLANES, painted
from weather_aug.view.source import SceneSource
from weather_aug.weather import Weather

pytest.importorskip("ipywidgets", reason="ipywidgets is not installed: extra notebook")

from ipywidgets.widgets.widget import _instances

UInt8 = NDArray[np.uint8]
MOST_GROWTH_PER_UPDATE = 32 * 2**20 // 10_000
"""Bytes: 32 MiB over 10,000 updates."""


@pytest.fixture
def panel(tiny_scene: WeatherScene) -> Iterator[Panel]:
    made = preview.panel(tiny_scene, kind="snow", severity="moderate", seed=5)
    yield made
    made.close()


@pytest.fixture
def renders(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What was rendered since the test began."""
    calls: list[Any] = []
    shot = SceneSource.shot

    def counted(self: SceneSource, *args: Any) -> Any:
        calls.append(args)
        return shot(self, *args)

    monkeypatch.setattr(SceneSource, "shot", counted)
    return calls


def seen(panel: Panel) -> UInt8:
    """The picture that a browser would decode."""
    data = np.frombuffer(bytes(panel.picture.value), np.uint8)
    picture: UInt8 = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    return picture


def said(panel: Panel) -> str:
    """The caption as people read it."""
    return html.unescape(re.sub("<[^>]*>", "", panel.caption.value))


def is_refusal(panel: Panel) -> bool:
    """Words in place of a picture, with no trace of Python's stack."""
    words = said(panel)
    hidden = panel.picture.value == b"" and panel.picture.layout.display == "none"
    return hidden and bool(re.match(r"\w+Error: ", words)) and "Traceback" not in words


def test_a_panel_shows_what_is_rendered(tiny_scene: WeatherScene, panel: Panel) -> None:
    key = tiny_scene.keys[len(tiny_scene.keys) // 2]
    expected = tiny_scene.render(key, Weather.snow("moderate"), seed=5)
    assert (seen(panel) == expected.image).all()
    assert (panel.key, panel.weather) == (key, Weather.snow("moderate"))
    assert panel.shot is not None
    assert (panel.shot.image == expected.image).all()
    hidden = np.mean(expected.label != expected.label_full)
    assert said(panel) == (
        f"snow: 1 mm/h of water · frame {key} · the weather hides {hidden:.1%} of the label"
    )


@pytest.mark.parametrize(
    ("control", "value"),
    [("type", "fog"), ("severity", 0.9), ("seed", 7), ("time", 0), ("camera", "right")],
)
def test_each_control_renders_anew_once(
    tiny_scene: WeatherScene, panel: Panel, renders: list[Any], control: str, value: Any
) -> None:
    before = seen(panel)
    panel.controls[control].value = value
    assert len(renders) == 1
    asked = {name: widget.value for name, widget in panel.controls.items()}
    assert asked[control] == value
    weather = weather_of(asked["type"], asked["severity"])
    key = FrameKey(asked["time"], asked["camera"])
    assert (seen(panel) == tiny_scene.render(key, weather, seed=asked["seed"]).image).all()
    assert (seen(panel) != before).any()
    panel.controls[control].value = value
    assert len(renders) == 1


def test_other_planes_are_shown(panel: Panel) -> None:
    assert panel.controls["show"].options == PLANES
    assert panel.shot is not None
    for plane in PLANES[1:]:
        panel.controls["show"].value = plane
        assert (seen(panel) == painted(panel.shot, plane, 960)).all()


def test_nothing_is_rendered_while_a_control_is_dragged(panel: Panel) -> None:
    for name in ("severity", "seed", "time"):
        assert panel.controls[name].continuous_update is False
    assert {"type", "camera", "show"} == {
        name for name, widget in panel.controls.items() if not hasattr(widget, "continuous_update")
    }


def test_controls_stay_in_their_ranges(panel: Panel) -> None:
    panel.controls["severity"].value = 7.0
    assert panel.controls["severity"].value == 1.0
    panel.controls["seed"].value = -3
    assert panel.controls["seed"].value == 0
    assert seen(panel).shape == (48, 64, 3)
    assert panel.controls["type"].options == TYPES


def test_a_wide_picture_is_shrunk_for_the_browser(tiny_scene: WeatherScene) -> None:
    frame = tiny_scene.frame(tiny_scene.keys[0])
    image = np.repeat(np.repeat(frame.image, 4, axis=0), 4, axis=1)
    mask = np.repeat(np.repeat(np.asarray(frame.label), 4, axis=0), 4, axis=1)
    panel = preview.panel(image, mask=mask, kind="fog", max_width=100)
    assert seen(panel).shape == (75, 100, 3)
    assert panel.shot is not None
    assert panel.shot.image.shape == (192, 256, 3)
    shown = [control for row in panel.widget.children[:-2] for control in row.children]
    assert [control.description for control in shown] == ["type", "severity", "seed", "show"]
    panel.close()


def test_a_page_without_widgets_gets_the_picture(panel: Panel) -> None:
    bundle = panel._repr_mimebundle_(include=None, exclude=None)
    view = bundle["application/vnd.jupyter.widget-view+json"]
    assert view["model_id"] == panel.widget.model_id
    assert base64.b64decode(bundle["image/png"]) == bytes(panel.picture.value)
    panel.close()
    assert list(panel._repr_mimebundle_()) == ["text/plain"]


# What cannot be shown


def test_an_error_is_said_and_passes(unlabelled_scene: WeatherScene) -> None:
    panel = preview.panel(unlabelled_scene, kind="rain")
    assert "label" not in said(panel)
    panel.controls["show"].value = "label"
    assert is_refusal(panel)
    assert "nobody labelled" in said(panel)
    assert panel.shot is None
    assert "image/png" not in panel._repr_mimebundle_()
    panel.controls["show"].value = "image"
    assert not is_refusal(panel)
    assert seen(panel).shape == (48, 64, 3)
    assert panel.picture.layout.display is None
    panel.close()


def test_a_moment_that_a_camera_missed_is_said(tiny_scene: WeatherScene, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))
    rewrite(folder, lambda m: m["frames"].remove(m["frames"][1]))
    panel = preview.panel(folder)
    panel.controls["time"].value = 0
    panel.controls["camera"].value = "right"
    assert is_refusal(panel)
    assert "no frame 000000_right" in said(panel)
    panel.close()


def test_texts_of_strangers_are_no_markup() -> None:
    panel = preview.panel("<img src=x onerror=alert(1)>")
    assert is_refusal(panel)
    assert "<img" in said(panel)
    assert "<img" not in panel.caption.value
    panel.close()


def refusals(folder: Path, manifest: bytes, write: Callable[[], object]) -> list[str]:
    """Harm a copy of a scene, open it, turn to the first frame; what was no refusal in words."""
    write()
    before = digests_of(folder)
    wrong = []
    panel = preview.panel(folder)
    if panel.controls:
        panel.controls["time"].value = 0
        panel.controls["camera"].value = "front"
    if not is_refusal(panel):
        wrong.append(f"shown: {said(panel)}")
    panel.close()
    if digests_of(folder) != before:
        wrong.append("a file has changed")
    (folder / store.MANIFEST).write_bytes(manifest)
    return wrong


def test_hostile_scenes_are_refused_in_words_and_nothing_is_written(
    tiny_scene: WeatherScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    manifest = (folder / store.MANIFEST).read_bytes()
    text = manifest.decode()
    path, depth = folder / store.MANIFEST, f"{FIRST}.depth.npy"
    harms: dict[str, Callable[[], object]] = {
        **{name: partial(rewrite, folder, change) for name, change in HOSTILE.items()},
        **{f"text: {name}": partial(path.write_bytes, make(text)) for name, make in TEXTS.items()},
        **{f"depth: {n}": partial(plant, folder, depth, data) for n, data in DEPTH_FILES.items()},
    }
    found = {name: refusals(folder, manifest, harm) for name, harm in harms.items()}
    assert len(found) > 100
    assert {name: wrong for name, wrong in found.items() if wrong} == {}
    assert list(elsewhere.iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "scene"]


def test_a_scene_that_is_shown_would_be_no_refusal(
    tiny_scene: WeatherScene, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))
    manifest = (folder / store.MANIFEST).read_bytes()
    assert "shown" in refusals(folder, manifest, lambda: None)[0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kind": "hail"}, "hail"),
        ({"severity": "mild"}, "mild"),
        ({"severity": 1.5}, "severity"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"max_width": 10**6}, "max_width"),
        ({"mask": np.zeros((48, 64), np.uint8)}, "mask is for a single picture"),
    ],
    ids=str,
)
def test_arguments_that_are_none_are_refused(
    tiny_scene: WeatherScene, arguments: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        preview.panel(tiny_scene, **arguments)


def test_without_ipywidgets_the_cure_is_named(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'weather-aug\[notebook\]'"):
        preview.panel(tiny_scene)
    assert len(preview.sweep(tiny_scene, kinds=["fog"]).axes) == 5


# What is left behind


def test_closing_takes_everything_away(tiny_scene: WeatherScene) -> None:
    before = set(_instances), threading.active_count()
    panel = preview.panel(tiny_scene)
    assert len(_instances) > len(before[0])
    panel.close()
    panel.close()
    assert (set(_instances), threading.active_count()) == before
    assert panel.shot is None


def turned(panel: Panel, numbers: Iterable[int]) -> None:
    """Set controls to values, both drawn for each number."""
    for number in numbers:
        which, value = uniforms(key_of("panel-soak", number), 2)
        control = list(panel.controls.values())[int(which * len(panel.controls))]
        if hasattr(control, "options"):
            control.value = control.options[int(value * len(control.options))]
        else:
            control.value = type(control.value)(control.max * value)


def grown_bytes(panel: Panel, updates: int) -> int:
    """Of what Python and numpy hold, over rounds of the same 20 updates, whose caches are full."""
    once = range(20)
    turned(panel, once)
    tracemalloc.start()
    try:
        turned(panel, once)
        gc.collect()
        start = tracemalloc.get_traced_memory()[0]
        for _ in range(updates // 20):
            turned(panel, once)
        gc.collect()
        return tracemalloc.get_traced_memory()[0] - start
    finally:
        tracemalloc.stop()


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def test_updates_leave_no_memory_behind(panel: Panel, renders: list[Any]) -> None:
    assert grown_bytes(panel, 200) <= 200 * MOST_GROWTH_PER_UPDATE
    assert len(renders) > 150


def test_a_panel_that_keeps_its_pictures_would_be_seen(
    panel: Panel, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = []
    update = Panel.update

    def keeping(self: Panel) -> None:
        update(self)
        kept.append(self.shot)

    monkeypatch.setattr(Panel, "update", keeping)
    assert grown_bytes(panel, 40) > 40 * MOST_GROWTH_PER_UPDATE


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc to read sizes from")
def test_ten_thousand_updates_leave_nothing_behind(tiny_scene: WeatherScene) -> None:
    threads = threading.active_count()
    panel = preview.panel(tiny_scene)
    turned(panel, range(-500, 0))
    gc.collect()
    tasks, start = len(os.listdir("/proc/self/task")), resident_bytes()  # noqa: PTH208
    turned(panel, range(10_000))
    gc.collect()
    assert resident_bytes() - start <= 10_000 * MOST_GROWTH_PER_UPDATE
    panel.close()
    assert threading.active_count() == threads
    assert len(os.listdir("/proc/self/task")) <= tasks  # noqa: PTH208
