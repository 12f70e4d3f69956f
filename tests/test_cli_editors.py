"""The command line with editors of backgrounds: build, inspect, render."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest
from tinting_editor import Tinting
from tiny_clip import TinyClip

from weather_aug.cli import main
from weather_aug.edit.diffusion.options import (
    RELEASE_WEIGHTS,
    SELF_ONLY,
    DiffusionOptions,
    paper_weights,
)
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather

STREET = "street:?frames=1&width=64&height=36"


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return int(str(caught.value.code)), error.strip()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    folder = tmp_path_factory.mktemp("cli") / "scene"
    return WeatherScene.build(TinyClip(frames=1), folder, editor=Tinting())


class Asked(list[tuple[str, Any]]):
    """What `editor_of` is asked for; it gives a small editor of that name."""

    def __call__(self, name: str, options: Any) -> Tinting:
        self.append((name, options))
        return Tinting(name=name)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    found = Asked()
    monkeypatch.setattr("weather_aug.scene.backgrounds.editor_of", found)
    return found


def test_a_build_hands_on_the_editors_options(
    asked: Asked, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "s"
    flags = "--editor diffusion --base models/tiny --adapter a/b --attention paper --without view"
    more = "--edit-height 64 --device cpu --weathers snow rain"
    main(["build", STREET, "--out", str(out), *flags.split(), "temporal", *more.split()])
    options = DiffusionOptions(
        base="models/tiny",
        adapter=Path("a/b"),
        attention=paper_weights(),
        without=("view", "temporal"),
        height=64,
    )
    assert asked == [("diffusion", options)]
    assert "backgrounds by diffusion: snow, rain" in capsys.readouterr().out
    assert WeatherScene.load(out).manifest.styles == ("snow", "rain")


@pytest.mark.parametrize(
    ("flags", "options"),
    [
        ("diffusion", None),
        ("diffusion --attention release", DiffusionOptions(attention=RELEASE_WEIGHTS)),
        ("diffusion --attention self", DiffusionOptions(attention=SELF_ONLY)),
        ("turboedit --base m --device cpu", PeerOptions(base="m", device="cpu")),
        ("controlnet --control c --edit-height 32", PeerOptions(control="c", height=32)),
        (
            "stylisation --weights w --pictures p",
            PeerOptions(weights=Path("w"), pictures=Path("p")),
        ),
        ("snow-cover", None),
    ],
)
def test_each_editor_has_its_options(
    asked: Asked, tmp_path: Path, flags: str, options: Any
) -> None:
    main(["build", STREET, "--out", str(tmp_path / "s"), "--editor", *flags.split()])
    assert asked == [(flags.split()[0], options)]


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--base m", "--base is for --editor diffusion or instruct-pix2pix or controlnet"),
        ("--editor physical --device cpu", "--device is for"),
        ("--editor none --edit-height 64", "--edit-height is for"),
        (
            "--editor turboedit --adapter a",
            "--adapter is for --editor diffusion, not for turbo",
        ),
        ("--editor snow-cover --without view", "--without is for --editor diffusion"),
        ("--editor diffusion --control c", "--control is for --editor controlnet"),
        ("--editor diffusion --attention most", "'most' is not one of release, paper, self"),
        ("--editor diffusion --without noise", "'noise' is not one of labels, view, temporal"),
        ("--editor diffusion", "adapter"),
        ("--editor photoshop", "'photoshop' is not one of physical, diffusion"),
        ("--editor snow-cover --weathers rain", "snow-cover cannot edit to rain"),
    ],
)
def test_choices_that_mean_nothing_are_refused(
    tmp_path: Path, flags: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, line = refused(["build", STREET, "--out", str(tmp_path / "s"), *flags.split()], capsys)
    assert code == 2 and says in line and len(line.splitlines()) == 1
    assert not (tmp_path / "s").exists()


def test_snow_cover_is_built_from_the_command_line(tmp_path: Path) -> None:
    """A real editor, from the flag to the pictures."""
    main(["build", STREET, "--out", str(tmp_path / "s"), "--editor", "snow-cover"])
    scene = WeatherScene.load(tmp_path / "s", verify=True)
    assert scene.manifest.editor == "snow-cover" and scene.manifest.styles == ("snow",)
    key = scene.keys[0]
    assert scene.background(key, "snow").mean() > scene.frame(key).image.mean()


def test_inspect_names_the_editor_and_its_card(
    scene: WeatherScene, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["inspect", str(scene.path)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("editor tinting")
    assert "backgrounds: rain, snow, fog (strength 0.6)" in lines
    assert lines[-1] == "every file is whole"


def test_render_takes_a_stored_style(scene: WeatherScene, tmp_path: Path) -> None:
    key = scene.keys[0]
    for flags, choices in (
        ("", {}),
        ("--style snow --amount 0.5", {"style": "snow", "amount": 0.5}),
        ("--style physical", {"style": "physical"}),
    ):
        main(
            ["render", str(scene.path), "--weather", "snow", "--out", str(tmp_path), *flags.split()]
        )
        shot = scene.render(key, Weather.snow("heavy"), **choices)
        assert (cv2.imread(str(tmp_path / f"{key}.png"))[..., ::-1] == shot.image).all(), flags
