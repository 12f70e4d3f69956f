"""Building Gaussians: whole or absent, and continued after the last whole step."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gaussian_clip import GaussianClip, built, known, known_fit, known_styles
from tiny_clip import TinyClip, digests_of

from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError, ClipError, SceneError
from weather_aug.gaussians.fit import Fitted
from weather_aug.gaussians.options import FitOptions
from weather_aug.scene import reconstruct as reconstructing
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene

WORK = ".building"


@dataclass
class Watched:
    """Fits that note what they were asked for, and fail where they are told to."""

    fail_at: str = ""
    asked: list[str] = field(default_factory=list)
    checkpoints: list[Path] = field(default_factory=list)
    shapes: list[tuple[int, ...]] = field(default_factory=list)

    def fit(self, frames: Sequence[Frame], options: Any, *, checkpoints: Path, **_: Any) -> Fitted:
        self.checkpoints.append(checkpoints)
        (checkpoints / "state").write_text("half a fit")
        return self._done("fit", lambda: known_fit(frames, options))

    def styles(self, scene: Any, edited: Any, **_: Any) -> Any:
        self.shapes += [frames[0].image.shape for frames in edited.values()]
        return self._done("styles", lambda: known_styles(scene, edited))

    def _done(self, step: str, make: Callable[[], Any]) -> Any:
        self.asked.append(step)
        if step == self.fail_at:
            raise RuntimeError("power cut")
        return make()

    def build(self, out: Path, **choices: Any) -> WeatherScene:
        with known() as patch:
            patch.setattr("weather_aug.gaussians.fit.fit", self.fit)
            patch.setattr("weather_aug.gaussians.styles.fit_styles", self.styles)
            return WeatherScene.build(GaussianClip(), out, reconstruct=True, **choices)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "scene"


def test_the_folder_holds_what_the_manifest_lists(gaussian_scene: WeatherScene) -> None:
    listed = gaussian_scene.manifest.files
    assert set(digests_of(gaussian_scene.path)) == {store.MANIFEST, *listed}
    assert not gaussian_scene.path.with_name(gaussian_scene.path.name + WORK).exists()
    assert not gaussian_scene.damaged_files()
    record = gaussian_scene.manifest.reconstruction
    assert record is not None
    assert record.styles == ("rain", "snow", "fog")
    assert record.fit == {"psnr_db": 99.0, "ssim": 1.0}


def test_two_builds_give_the_same_bytes(gaussian_scene: WeatherScene, out: Path) -> None:
    """The minutes that a fit took are in no file."""
    assert digests_of(built(out).path) == digests_of(gaussian_scene.path)


def test_labels_and_support_come_from_the_frames(gaussian_scene: WeatherScene) -> None:
    found = gaussian_scene.reconstruction
    assert found is not None
    assert found.background.class_scores.shape == (len(found.background), 19)
    assert found.background.class_scores.sum() > 0
    assert found.support.shape == (len(found.background),)
    assert found.support.max() > 1


def test_a_clip_without_labels_is_reconstructed_without_scores(out: Path) -> None:
    with known():
        scene = WeatherScene.build(GaussianClip(labelled=False), out, reconstruct=True, styles=())
    found = scene.reconstruction
    assert found is not None
    assert found.background.class_scores.shape[1] == 0
    assert found.support.max() > 1
    frame, seen = scene.frame_from(scene.keys[0])
    assert frame.label is None and seen.mean() > 0.98


@pytest.mark.parametrize("step", ["fit", "styles"])
def test_an_interrupted_build_goes_on(gaussian_scene: WeatherScene, out: Path, step: str) -> None:
    cut = Watched(fail_at=step)
    with pytest.raises(RuntimeError, match="power cut"):
        cut.build(out)
    assert not out.exists()
    assert (cut.checkpoints[0] / "state").read_text() == "half a fit"
    again = Watched()
    again.build(out)
    assert again.asked == (["fit", "styles"] if step == "fit" else ["styles"])
    assert [folder == cut.checkpoints[0] for folder in again.checkpoints] == [True] * (
        step == "fit"
    )
    assert digests_of(out) == digests_of(gaussian_scene.path)


def test_other_options_are_another_fit_but_threads_and_styles_are_not(out: Path) -> None:
    with pytest.raises(RuntimeError):
        Watched(fail_at="styles").build(out)
    more = Watched(fail_at="styles")
    with pytest.raises(RuntimeError):
        more.build(out, styles=("snow",), reconstruction=FitOptions(threads=2))
    assert more.asked == ["styles"]
    other = Watched()
    scene = other.build(out, styles=("snow",), reconstruction=FitOptions(scale=0.5))
    assert other.asked == ["fit", "styles"]
    assert other.shapes == [(32, 48, 3)]
    assert scene.manifest.reconstruction is not None
    assert scene.manifest.reconstruction.styles == ("snow",)
    assert set(digests_of(out)) == {store.MANIFEST, *scene.manifest.files}


def test_a_lost_file_is_made_again(gaussian_scene: WeatherScene, out: Path) -> None:
    with pytest.raises(RuntimeError):
        Watched(fail_at="styles").build(out)
    path = out.with_name(out.name + WORK) / "gaussians" / "owners.npy"
    path.write_bytes(path.read_bytes()[:-1])
    again = Watched()
    again.build(out)
    assert again.asked == ["fit", "styles"]
    assert digests_of(out) == digests_of(gaussian_scene.path)


def test_a_fit_that_cannot_be_stored_leaves_nothing(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(frames: Sequence[Frame], options: Any, **choices: Any) -> Fitted:
        fitted = known_fit(frames, options)
        fitted.reconstruction.background.means_m[0] = np.nan
        return fitted

    street = known_fit([], None).reconstruction.background.means_m
    kept = street.copy()
    with known() as patch:
        patch.setattr("weather_aug.gaussians.fit.fit", broken)
        with pytest.raises(SceneError, match="means_m"):
            WeatherScene.build(GaussianClip(), out, reconstruct=True)
    street[:] = kept
    assert not out.exists() and not out.with_name(out.name + WORK).exists()


def test_styles_are_fitted_to_edited_frames_without_anything_in_the_air(
    gaussian_scene: WeatherScene,
) -> None:
    manifest = gaussian_scene.manifest
    record = manifest.frames[2]
    frame = gaussian_scene.frame(record.key)
    shown = {
        name: reconstructing.styled_frame(gaussian_scene.path, manifest, record, frame, name)
        for name in ("rain", "snow", "fog")
    }
    for name, edited in shown.items():
        assert edited.key == frame.key and edited.label is frame.label
        assert not (edited.image == frame.image).all(), name
    ground = frame.label == 0
    light = {name: float(edited.image[ground].mean()) for name, edited in shown.items()}
    assert light["snow"] > light["fog"] > light["rain"]


def test_a_scene_built_without_is_as_it_was(tiny_scene: WeatherScene) -> None:
    text = (tiny_scene.path / store.MANIFEST).read_text()
    assert "reconstruction" not in text


def test_frames_of_a_folder_are_a_sequence(gaussian_scene: WeatherScene) -> None:
    records = gaussian_scene.manifest.frames
    frames = reconstructing.StoredFrames(gaussian_scene.path, records)
    assert [frame.key for frame in frames] == list(gaussian_scene.keys)
    assert frames[-1].key == gaussian_scene.keys[-1]
    assert [frame.key for frame in frames[1:3]] == list(gaussian_scene.keys[1:3])


# What is refused


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"styles": ("dusk",)}, "style 'dusk'"),
        ({"styles": ("clear",)}, "style 'clear'"),
        ({"styles": "rain"}, "sequence"),
        ({"styles": ("rain", "rain")}, "twice"),
        ({"reconstruction": {"steps": 3}}, "FitOptions"),
        ({"reconstruct": False, "reconstruction": FitOptions()}, "reconstruct=True"),
    ],
)
def test_choices_that_are_none_are_refused_before_any_work(
    out: Path, choices: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        WeatherScene.build(GaussianClip(), out, **{"reconstruct": True, **choices})
    assert not out.exists() and not out.with_name(out.name + WORK).exists()


@dataclass(frozen=True)
class Unrelated(TinyClip):
    """Pictures of different places."""

    is_drive: bool = False


def test_unrelated_pictures_are_no_drive(out: Path) -> None:
    with pytest.raises(ClipError, match="unrelated"):
        WeatherScene.build(Unrelated(frames=1), out, reconstruct=True)
    assert not out.with_name(out.name + WORK).exists()


@pytest.mark.slow
def test_the_street_is_reconstructed(tmp_path: Path) -> None:
    """The real fit, at toy size: the recorded views come back, with their labels."""
    from weather_aug.clip.open import open_clip

    clip = open_clip("street:?frames=4&width=160&height=90")
    options = FitOptions(steps=600, count=20_000, sky_size=64)
    scene = WeatherScene.build(
        clip, tmp_path / "scene", reconstruct=True, reconstruction=options, styles=("snow",)
    )
    for key in scene.keys:
        frame, seen = scene.frame_from(key)
        recorded = scene.frame(key)
        error = (frame.image.astype(float) - recorded.image) ** 2
        assert 10 * np.log10(255**2 / error.mean()) > 22
        known_there = seen & (recorded.label != 255)
        assert (frame.label == recorded.label)[known_there].mean() > 0.9
    bare, snowed = (scene.frame_from(scene.keys[0], style=style).frame for style in (None, "snow"))
    road = bare.label == 0
    assert snowed.image[road].mean() > bare.image[road].mean() + 20
    shutil.rmtree(scene.path)
