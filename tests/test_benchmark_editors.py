"""The comparison of editors: its rows, its moments, and a table of a real scene from end to end."""

from __future__ import annotations

import argparse
import json
import math
import re
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from tiny_clip import TinyClip
from tiny_clip_model import build_tiny_clip
from tiny_diffusion import build_tiny_sd

from benchmarks import editor_rows, editors
from benchmarks.editor_rows import ATTENTION, Physical, Row, peer_options, rows_of
from benchmarks.editors import (
    FirstTimes,
    arguments,
    bench_of,
    compare,
    encoder_of,
    first_keys,
    heading,
    line,
    main,
    measured,
    moments_of,
    pictures_of,
    scene_of,
    sheet,
)
from weather_aug.clip.types import FrameKey
from weather_aug.edit.background import STYLES, BackgroundEditor
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.adapter_files import save_adapter
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.editor import effective_weights
from weather_aug.edit.diffusion.options import DiffusionOptions
from weather_aug.edit.diffusion.spec import CLEAR, PROMPTS, AdapterSpec
from weather_aug.edit.editors import Unedited
from weather_aug.errors import ArgumentError, DataError
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.styles import style_weather

CLIP = TinyClip(frames=3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return WeatherScene.build(CLIP, tmp_path_factory.mktemp("bench") / "scene")


@pytest.fixture(scope="module")
def bench(scene):
    return bench_of(scene, 3)


class Darker:
    """Every second moment darker: unsteady in time, steady between views."""

    name, styles, card = "darker", ("snow",), {}

    def edit(self, moment, style):
        share = 0.5 if moment.now[0].key.time_index % 2 else 1.0
        return tuple((frame.image * share).astype(np.uint8) for frame in moment.now)


class TwoNumbers:
    """Embeds a picture by its mean, for the arithmetic of the table."""

    def pictures(self, images):
        return np.array([[image.mean() / 255, 1 - image.mean() / 255] for image in images])

    def texts(self, prompts):
        assert prompts == [PROMPTS["snow"], PROMPTS[CLEAR]]
        return np.array([[0.0, 1.0], [1.0, 0.0]])


def perturbed(model, seed):
    """With every trained tensor away from zero, where an untrained adapter would do nothing."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.trained().values():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.05)
    return model


def given(*words):
    return arguments(["SOURCE", *words])


@pytest.mark.parametrize(
    ("attention", "weights"),
    [
        ("self", (1.0, 0.0, 0.0, 0.0)),
        ("view", (0.72, 0.28, 0.0, 0.0)),
        ("temporal", (0.88, 0.0, 0.06, 0.06)),
        ("release", (0.60, 0.28, 0.06, 0.06)),
        ("paper", (0.6, 0.4, 0.2, 0.2)),
    ],
)
def test_each_attention_has_its_weights(attention, weights):
    chosen, without = ATTENTION[attention]
    found = effective_weights(DiffusionOptions(attention=chosen, without=without))
    assert astuple(found) == pytest.approx(weights)


def options_of(row):
    load = row.load
    return load.args[0]()


def test_diffusion_has_a_row_for_each_attention_and_ablation(tmp_path):
    rows = rows_of(
        given(
            *("--editor", "none", "diffusion", "--adapter", str(tmp_path), "--base", "b"),
            *("--attention", "view", "release", "--without", "labels", "--height", "96"),
        )
    )
    names = ["none", "diffusion, view", "diffusion, release", "diffusion, view w/o labels"]
    assert [row.name for row in rows] == names
    view, release, without = map(options_of, rows[1:])
    assert (view.without, release.without) == (("temporal",), ())
    assert set(without.without) == {"temporal", "labels"}
    assert {one.adapter for one in (view, release, without)} == {tmp_path}
    assert {(one.base, one.height) for one in (view, release, without)} == {("b", 96)}


def test_several_adapters_are_told_apart():
    rows = rows_of(given("--editor", "diffusion", "--adapter", "all-in-one", "x/single"))
    names = [row.name for row in rows]
    assert names == ["diffusion all-in-one, release", "diffusion single, release"]


def test_options_of_peers_reach_the_peer_of_the_name():
    words = given(
        *("--editor", "controlnet", "stylisation", "--weights", "w", "--height", "64", "--peer"),
        *("controlnet.steps=20", "controlnet.strength=0.5", "stylisation.seed=3"),
    )
    control, style = (peer_options(name, words) for name in ("controlnet", "stylisation"))
    assert (control.steps, control.strength, control.seed, control.height) == (20, 0.5, 0, 64)
    assert (style.steps, style.seed, str(style.weights), style.height) == (None, 3, "w", 64)
    assert control.weights is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("controlnet.steps=many", "value must be of int"),
        ("controlnet.speed=3", "NAME.OPTION=VALUE"),
        ("controlnet.steps", "NAME.OPTION=VALUE"),
        ("controlnt.steps=3", "'controlnt' is not among --editor"),
    ],
)
def test_options_that_are_none_are_refused(text, says):
    with pytest.raises(ArgumentError, match=says):
        peer_options("controlnet", given("--editor", "controlnet", "--peer", text))


def test_the_first_moments_are_those_of_all_cameras():
    keys = [FrameKey(t, c) for t in (4, 7, 9) for c in "ab"]
    assert first_keys(keys, 2) == tuple(keys[:4])
    few = FirstTimes(CLIP, 2)
    assert few.keys == CLIP.keys[:4]
    assert (few.name, few.cameras, few.is_drive) == (CLIP.name, CLIP.cameras, True)
    assert (few.up_world == CLIP.up_world).all()
    assert (few.frame(CLIP.keys[1]).image == CLIP.frame(CLIP.keys[1]).image).all()


def check_moments(scene):
    frames = {key: scene.frame(key) for key in scene.keys}
    moments = moments_of(scene, frames)
    at = [
        [{f.key.time_index for f in each} for each in (m.before, m.now, m.after)] for m in moments
    ]
    assert at == [[set(), {0}, {1}], [{0}, {1}, {2}], [{1}, {2}, set()]]
    assert all(len(moment.now) == len(CLIP.cameras) for moment in moments)
    layers, _ = moments[0].look(moments[0].now[1])
    assert (layers.maps == scene.layers(moments[0].now[1].key).maps).all()


def test_a_moment_has_its_neighbours_and_layers(scene):
    check_moments(scene)


def test_neighbours_the_wrong_way_round_are_found_out(scene, monkeypatch):
    right = editors.Moment
    monkeypatch.setattr(
        editors, "Moment", lambda now, before, after, look: right(now, after, before, look)
    )
    with pytest.raises(AssertionError):
        check_moments(scene)


@pytest.mark.parametrize("style", STYLES)
def test_the_physical_row_is_the_background_that_scenes_render(scene, bench, style):
    """Without what is in the air, on the glass or in the sensor, rendering adds nothing to it."""
    images, _ = pictures_of(Physical(), bench, style)
    outside = tuple(EFFECTS[EFFECTS.index("lamps") :])
    options = RenderOptions(max_particles=0, without=outside)
    weather = replace(style_weather(style), rain_mm_per_h=0.0)
    key = scene.keys[2]
    assert (scene.render(key, weather, options=options).image == images[key]).all()
    assert (images[key] != bench.frames[key].image).any()


def test_editors_of_the_table_are_editors():
    assert isinstance(Unedited(), BackgroundEditor)
    assert isinstance(Physical(), BackgroundEditor)


def result_of(bench, editor, encoder=None):
    images, seconds = pictures_of(editor, bench, "snow")
    targets, _ = pictures_of(Physical(), bench, "snow")
    return measured(bench, images, seconds, targets, "snow", encoder)


def test_an_unsteady_editor_is_unsteady_in_the_table(bench):
    none, darker = (result_of(bench, editor).scores for editor in (Unedited(), Darker()))
    assert none.warp_time.ratio == none.warp_view.ratio == 1
    assert darker.warp_time.ratio > 2
    assert darker.warp_view.ratio < 1.1
    assert darker.colour.time > none.colour.time
    assert none.target.l1 == none.target.l1_clear > 0
    assert result_of(bench, Physical()).scores.target.l1 == 0


def test_clip_scores_are_means_over_the_pictures(bench):
    encoder = TwoNumbers()
    none, darker = (result_of(bench, editor, encoder) for editor in (Unedited(), Darker()))
    assert none.clip_ds == 0
    means = np.array([frame.image.mean() / 255 for frame in bench.frames.values()])
    expected = np.mean((1 - means) / np.hypot(means, 1 - means))
    assert none.clip_s == pytest.approx(expected)
    # Darker pictures are nearer the second number; a third of the pictures are.
    assert darker.clip_s > none.clip_s
    assert darker.clip_ds == pytest.approx(1 / 3, abs=0.05)


def test_the_table_has_a_number_under_each_heading(bench):
    names = ("none", "darker")
    head = heading(names)
    lines = [
        line(name, result_of(bench, editor), names)
        for name, editor in zip(names, (Unedited(), Darker()), strict=True)
    ]
    assert {len(each) for each in lines} == {len(head)}
    headings = re.split(r" {2,}", head.strip())
    assert [len(each.split()) for each in lines] == [len(headings)] * 2
    assert lines[0].split()[:3] == ["none", "-", "-"]
    ratio = result_of(bench, Darker()).scores.warp_view.ratio
    assert float(lines[1].split()[headings.index("warp v") + 1]) == pytest.approx(ratio, abs=1e-4)


class Failing:
    def __call__(self, scene):
        raise DataError("its weights are not on this machine")


def test_what_cannot_be_measured_is_said_and_the_rest_goes_on(bench, tmp_path, capsys):
    rows = [Row("lost", Failing()), Row("darker", lambda scene: Darker()), *rows_of(given())]
    results = compare(bench, rows, "snow", None, tmp_path)
    assert list(results) == ["darker", "none", "physical"]
    said = capsys.readouterr().out
    assert "lost: not measured: its weights are not on this machine" in said
    written = json.loads((tmp_path / "tiny-snow.json").read_text(encoding="utf-8"))
    ratio = written["results"]["darker"]["scores"]["warp_time"]["ratio"]
    assert ratio == results["darker"].scores.warp_time.ratio
    assert (tmp_path / "tiny-snow.png").stat().st_size > 1000
    assert list(compare(bench, rows, "fog", None, tmp_path)) == ["none", "physical"]
    assert "darker: does not edit to fog, only to snow" in capsys.readouterr().out


def test_a_sheet_shows_each_editor_and_camera(bench):
    images = dict(pictures_of(Unedited(), bench, "snow")[0])
    one, two = sheet(bench, {"a": images}), sheet(bench, {"a": images, "b": images})
    assert two.shape[1] == one.shape[1] > 3 * editors.LEAST_TILE
    assert two.shape[0] > 1.8 * one.shape[0]


def test_without_clip_one_line_says_what_is_missing(capsys):
    assert encoder_of(given()) is None
    (line,) = capsys.readouterr().out.splitlines()
    for word in ("not measured", "--clip", "openai/clip-vit-large-patch14", "MIT", "hf download"):
        assert word in line


def test_a_scene_is_taken_as_it_is_and_a_clip_is_built(scene, tmp_path):
    with scene_of(str(scene.path), 1) as taken:
        assert taken.path == scene.path
    with scene_of("street:?frames=3&width=48&height=32", 1) as built:
        assert {key.time_index for key in built.keys} == {0}
        path = built.path
    assert not path.exists()


def test_peers_are_loaded_with_their_options(scene, bench):
    words = given("--editor", "snow-cover", "--peer", "snow-cover.severity=0.5")
    (row,) = rows_of(words)
    editor = row.load(scene)
    assert editor.styles == ("snow",)
    half = editor.edit(bench.moments[0], "snow")[0]
    whole = editor_rows.loaded("snow-cover", given("--editor", "snow-cover"), scene)
    assert (half != whole.edit(bench.moments[0], "snow")[0]).any()
    with pytest.raises(ArgumentError, match="is not one of"):
        editor_rows.loaded("magic", argparse.Namespace(**vars(words)), scene)


def test_no_time_is_a_number(bench):
    assert 0 <= result_of(bench, Unedited()).seconds_per_frame < 1
    assert math.isnan(result_of(bench, Unedited()).clip_s)


def test_diffusion_and_clip_have_their_numbers(scene, tmp_path, capsys):
    """The command itself, on a random small model and a random small CLIP."""
    base, adapter = build_tiny_sd(tmp_path / "base", seed=0), tmp_path / "adapter"
    model = AdaptedModel(load_base(str(base)), AdapterSpec(unet_rank=2), seed=0)
    save_adapter(perturbed(model, seed=1), adapter)
    main(
        [
            *(str(scene.path), "--frames", "2", "--out", str(tmp_path / "out")),
            *("--clip", str(build_tiny_clip(tmp_path / "clip")), "--editor", "none", "diffusion"),
            *("--base", str(base), "--adapter", str(adapter), "--height", "24"),
            *("--attention", "release", "--without", "labels"),
        ]
    )
    said = capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "tiny-snow.json").read_text(encoding="utf-8"))
    results = written["results"]
    names = ["none", "diffusion, release", "diffusion, release w/o labels"]
    assert list(results) == names
    assert all(name in said for name in names)
    assert "CLIP-S     cosine of picture and prompt" in said
    assert results["none"]["clip_ds"] == 0
    for name in names[1:]:
        assert 0 < abs(results[name]["clip_ds"]) <= 1
        assert results[name]["scores"]["target"]["l1"] > 0
    errors = [results[name]["scores"]["warp_time"]["absolute"] for name in names]
    assert len(set(errors)) == len(names)
