"""Every recipe runs as it stands, on a CPU."""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import weather_aug
from weather_aug.clip.labelled import LabelledClip
from weather_aug.clip.open import open_clip
from weather_aug.errors import ArgumentError, MissingExtraError
from weather_aug.render.options import DEFAULT_OPTIONS
from weather_aug.scene.policy import weather_of
from weather_aug.scores.agreement import agreement
from weather_aug.taxonomy import ROAD, SKY, TRAIN_ID, taxonomy

SHARED = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
WEIGHTS = Path(os.environ.get("WEATHER_AUG_WEIGHTS", SHARED / "weights"))
NETWORK = WEIGHTS / "deeplab_mobilenet_edgetpu_slim_cityscapes_quant.tflite"
NO_NETWORK = (
    f"no {NETWORK.name} in WEATHER_AUG_WEIGHTS or the shared weights"
    if not NETWORK.is_file()
    else ""
    if importlib.util.find_spec("ai_edge_litert")
    else "ai_edge_litert is not installed"
)
needs_network = pytest.mark.skipif(bool(NO_NETWORK), reason=NO_NETWORK)

OPTIONS = {
    "02_physics_figures": ["--quick"],
    "04_what_a_network_still_sees": ["--weights", str(NETWORK), "--frames", "1"],
    "07_small_diffusion_editor": ["--quick"],
}
"""Of recipes that take too long, write outside, or need a file, as they stand."""
RECIPES = sorted((Path(__file__).parents[1] / "recipes").glob("[0-9]*.py"))


def test_there_are_recipes():
    assert RECIPES


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_recipe_runs(recipe, tmp_path):
    if recipe.stem.startswith("04") and NO_NETWORK:
        pytest.skip(NO_NETWORK)
    done = subprocess.run(
        [sys.executable, str(recipe), *OPTIONS.get(recipe.stem, [])],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert len(recipe.read_text(encoding="utf-8").splitlines()) <= 120


def test_every_figure_of_the_physics_has_its_recipe():
    """What the document shows is what the recipe draws, no more and no less."""
    root = Path(__file__).parents[1]
    source = (root / "recipes" / "02_physics_figures.py").read_text(encoding="utf-8")
    drawn = set(re.findall(r'"(\d\d_\w+)":', source))
    shown = set(
        re.findall(r"figures/(\w+)\.png", (root / "docs" / "physics.md").read_text("utf-8"))
    )
    assert drawn
    assert drawn == shown == {path.stem for path in (root / "docs" / "figures").glob("*.png")}


def module_of(number: str) -> ModuleType:
    """A recipe's functions; its name begins with a digit, so that `import` cannot."""
    (path,) = (path for path in RECIPES if path.stem.startswith(number))
    spec = importlib.util.spec_from_file_location(f"recipe_{number}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def by_brightness(image):
    """A stand-in for a network: what is bright is sky, what is dark a building, else road."""
    level = image.mean(axis=-1)
    ids = np.select([level > 160, level < 80], [SKY, TRAIN_ID["building"]], ROAD)
    return ids.astype(np.uint8)


def afraid_of_blue(image):
    """Another, that takes a blue sky for a building."""
    blue = image[..., 2].astype(int) - image[..., 0] > 40
    return np.where(blue, TRAIN_ID["building"], by_brightness(image)).astype(np.uint8)


def agreement_in(scene, see, weather, sure):
    """Of a stand-in with itself, in two frames, everywhere or where depth knows the sky as well."""
    total = agreement(*[np.full((1, 1), 255, np.uint8)] * 2)
    for key in scene.keys[::4]:
        frame = scene.frame(key)
        clear, seen = see(frame.image), see(scene.render(key, weather, seed=1).image)
        mask = (clear == SKY) == np.isinf(frame.depth_m)
        total += agreement(clear, seen, mask=mask | (not sure))
    return total.pixel_agreement


def test_a_network_is_compared_with_itself(tiny_scene, capsys):
    """Each row of the table is the agreement of the stand-in on these very renders."""
    recipe = module_of("04")
    words = ["--weights", "unused", "--frames", "2", "--weathers", "fog", "snow"]
    given = recipe.arguments([*words, "--severities", "light", "extreme"])
    found = recipe.compare(tiny_scene, by_brightness, given)
    for row, kind in zip(found, ("fog", "snow"), strict=True):
        for value, severity in zip(row, ("light", "extreme"), strict=True):
            weather = weather_of(kind, severity)
            assert value == agreement_in(tiny_scene, by_brightness, weather, sure=True)
    assert found[0][1] < 1.0
    printed = capsys.readouterr().out
    assert f"fog light       {found[0][0]:9.3f}{1 - found[0][0]:9.3f}" in printed
    assert "2 frames, " in printed
    assert "of pixels, without nothing" in printed
    corrected = recipe.compare(tiny_scene, afraid_of_blue, given)[1][0]
    light = weather_of("snow", "light")
    assert corrected == agreement_in(tiny_scene, afraid_of_blue, light, sure=True)
    assert corrected > agreement_in(tiny_scene, afraid_of_blue, light, sure=False) + 0.05
    blind = recipe.compare(tiny_scene, lambda image: np.zeros(image.shape[:2], np.uint8), given)
    assert blind == [[1.0, 1.0], [1.0, 1.0]]
    assert "fog: does not fall\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("agreements", "says"),
    [
        ((0.9, 0.8, 0.7, 0.6), "falls smoothly: by 0.400 in all"),
        ((0.99, 0.98, 0.97, 0.2), "falls with a jump: by 0.800 in all, 0.770 at step 4"),
        ((0.9, 0.95, 0.5, 0.3), "does not fall steadily: rises by 0.050 at step 2"),
        ((1.0, 1.0, 1.0, 0.995), "does not fall"),
    ],
)
def test_the_verdict_tells_a_smooth_fall_from_others(agreements, says):
    assert module_of("04").verdict(agreements).startswith(says)


def test_a_missing_network_names_its_cure(monkeypatch, tmp_path):
    recipe = module_of("04")
    monkeypatch.setitem(
        sys.modules, "ai_edge_litert.interpreter", SimpleNamespace(Interpreter=None)
    )
    with pytest.raises(ArgumentError, match="there is no file"):
        recipe.teacher(tmp_path / "absent.tflite")
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingExtraError, match="pip install ai-edge-litert"):
        recipe.teacher(NETWORK)


@needs_network
def test_the_network_speaks_train_ids():
    """On labelled streets; ids that are off by one, or Cityscapes' own, hardly ever agree."""
    folder = SHARED / "camvid-dev"
    if not folder.is_dir():
        pytest.skip("no shared CamVid data")
    clip = open_clip(f"folder:{folder}?images=val&labels=valannot&taxonomy=camvid11")
    recipe = module_of("04")
    see = recipe.teacher(NETWORK)
    total = shifted = others = recipe.NONE
    for key in clip.keys[::5]:
        frame = clip.frame(key)
        seen = see(frame.image.copy())
        total += agreement(frame.label, seen)
        shifted += agreement(frame.label, (seen + np.uint8(1)) % np.uint8(19))
        others += agreement(frame.label, taxonomy("cityscapes").train_ids(seen, where="seen"))
    assert total.pixel_agreement > 0.7
    assert max(shifted.pixel_agreement, others.pixel_agreement) < 0.3


@needs_network
def test_the_network_labels_a_clip(tiny_clip):
    see = module_of("04").teacher(NETWORK)
    key = tiny_clip.keys[0]
    unlabelled = replace(tiny_clip, labelled=False)
    first, again = (LabelledClip(unlabelled, see).frame(key).label for _ in range(2))
    assert (first.shape, first.dtype) == ((48, 64), np.uint8)
    assert (first == again).all()


class Flickering:
    """A scene whose weathers are a little darker at every other moment."""

    def __init__(self, scene):
        self._scene = scene
        self.keys, self.frame, self.cameras = scene.keys, scene.frame, scene.cameras

    def render(self, key, *args, **kwargs):
        shot = self._scene.render(key, *args, **kwargs)
        return replace(shot, image=shot.image - np.uint8(12 * (key[0] % 2)) * (shot.image > 12))


@pytest.mark.parametrize("pairs", ["over_time", "between_cameras"])
def test_steadiness_is_measured_on_the_same_pixels(tiny_scene, capsys, pairs):
    recipe = module_of("05")
    chosen = list(getattr(recipe, pairs)(tiny_scene))
    assert len(chosen) == {"over_time": 6, "between_cameras": 4}[pairs]
    weathers = {"clear too": weather_of("clear", 0), "fog": weather_of("fog", "heavy")}
    options = replace(DEFAULT_OPTIONS, max_particles=0)
    found = recipe.errors(tiny_scene, chosen, weathers, "out", options)
    assert [e.count for e in found["fog"]] == [e.count for e in found["clear"]]
    ratios = recipe.report(found)
    assert ratios["clear"] == ratios["clear too"] == 1.0
    assert 0 < ratios["fog"] <= recipe.PROMISE
    printed = capsys.readouterr().out
    assert printed.count("held") == 2
    assert "NOT HELD" not in printed


def test_a_flicker_breaks_the_promise(tiny_scene, capsys):
    recipe = module_of("05")
    scene = Flickering(tiny_scene)
    chosen = list(recipe.over_time(scene))
    rain = {"rain": weather_of("rain", "heavy", falling=False)}
    ratios = recipe.report(recipe.errors(scene, chosen, rain, "out", DEFAULT_OPTIONS))
    assert ratios["rain"] > recipe.PROMISE
    assert "NOT HELD" in capsys.readouterr().out
