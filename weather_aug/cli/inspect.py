"""The command that says what a scene or an export holds, and whether it is whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from weather_aug.cli.terminal import say, to_people
from weather_aug.cli.values import check_local
from weather_aug.errors import DataError, IntegrityError, printable

if TYPE_CHECKING:
    from weather_aug.writers.source import Source


@dataclass(frozen=True)
class Inspect:
    """Say what a scene or an export holds, and whether every byte is the one written."""

    path: Positional[str]
    """Scene or export folder, or the url of an export; with --against, a merge as well."""
    against: Path | None = None
    """Pictures that a network shall be scored on, such as data/acdc/rgb_anon/val. Instead of
    comparing bytes, say which of them trained the editor of the backgrounds."""

    def run(self) -> None:
        """Say what is asked; damage, leakage and editors of unknown origin end with exit code 4."""
        if self.against is None:
            self._verify()
        else:
            check_local(self.against)
            _look_up(self.against, self.path)

    def _verify(self) -> None:
        """Print the contents, then compare every byte."""
        from weather_aug.writers.source import source_of

        problems, cure = _inspected(self.path)
        for problem in problems:
            say(problem)
        if problems:
            count = f"{len(problems)} problem{'s' if len(problems) > 1 else ''}"
            raise IntegrityError(f"{source_of(self.path)} is not whole ({count}); {cure}")
        say("every file is whole")


def _look_up(against: Path, path: str) -> None:
    """Say which pictures trained an editor of a scene, an export or a merge."""
    from weather_aug.writers.leakage import trained_pictures
    from weather_aug.writers.source import source_of

    found = trained_pictures(path, against, progress=to_people())
    for sentence in (*found.trained, *found.unrecorded):
        say(sentence)
    if found.trained:
        raise IntegrityError(
            f"{len(found.trained)} of {found.pictures} pictures of {printable(against, 200)} "
            f"trained an editor of {source_of(path)}; do not score on them what learns from it"
        )
    if found.unrecorded:
        raise IntegrityError(
            f"not all that trained the editors of {source_of(path)} is known, and unknown is "
            "not clean; build its scenes again with adapters that have their trained_on.txt"
        )
    editors = "the editor" if found.editors == 1 else f"one of the {found.editors} editors"
    if not found.editors:
        editors = "an editor: none of the backgrounds is learnt"
    say(f"none of {found.pictures} pictures trained {editors}")


def _inspected(path: str) -> tuple[list[str], str]:
    """What is wrong with a scene or an export, one sentence each, and the cure."""
    from weather_aug.scene import store
    from weather_aug.writers import layout
    from weather_aug.writers.merged import is_merge
    from weather_aug.writers.source import exists, is_url, source_of

    if not is_url(path) and (Path(path) / store.MANIFEST).is_file():
        return _inspect_scene(Path(path)), "build the scene again"
    source = source_of(path)
    if any(exists(source, name) for name in (layout.CONTENTS, layout.JOURNAL, layout.MARK)):
        return _inspect_export(source)
    if not is_url(path) and is_merge(Path(path)):
        raise DataError(
            f"{source} is a merge; inspect its exports one by one, or look pictures up in it with "
            "--against"
        )
    if not is_url(path) and not Path(path).exists():
        raise DataError(f"{source} does not exist; check the path")
    raise DataError(
        f"{source} is neither a scene (no {store.MANIFEST}) nor an export (no {layout.CONTENTS}); "
        "check the path"
    )


def _inspect_export(source: Source) -> tuple[list[str], str]:
    from weather_aug.writers import layout
    from weather_aug.writers.source import contents_of, exists
    from weather_aug.writers.verify import verify_export

    if not exists(source, layout.CONTENTS):
        return verify_export(source), "run the same export again"
    try:
        contents = contents_of(source)
    except (DataError, IntegrityError):
        # Nobody knows any more which job it was.
        return verify_export(source), "remove the folder and export again"
    problems = verify_export(source)
    if not problems:
        try:
            say(_held(contents))
        except (KeyError, TypeError, AttributeError) as error:
            problems = [f"{source} is malformed: {type(error).__name__} {error}"]
    return problems, "run the same export again with --verify to repair it"


def _held(contents: Mapping[str, Any]) -> str:
    """What a whole export holds."""
    job, kinds = contents["job"], contents["samples_by_kind"]
    parts = ", ".join(printable(part) for part in job["parts"])
    weathers = ", ".join(f"{count} {printable(kind)}" for kind, count in kinds.items())
    return (
        f"{contents['samples']} samples, {contents['labelled']} labelled ({weathers}); layout "
        f"{printable(job['layout'])}, {printable(job['split'])}: {parts}"
    )


def _inspect_scene(path: Path) -> list[str]:
    from weather_aug.scene.scene import WeatherScene

    try:
        scene = WeatherScene.load(path)
    except (DataError, IntegrityError) as error:
        if str(error).endswith("again"):
            raise
        raise type(error)(f"{error}; build the scene again") from None
    manifest = scene.manifest
    labelled = sum("label" in record.files for record in manifest.frames)
    size_mib = sum(stored.size for stored in manifest.files.values()) / 2**20
    say(f"scene {scene.name}, digest {scene.digest[:12]}, editor {manifest.editor}")
    say(f"{len(scene.keys)} frames ({labelled} labelled) of {', '.join(scene.cameras)}")
    if manifest.backgrounds is not None:
        say(f"backgrounds: {', '.join(manifest.styles)}{_named(manifest.backgrounds.card)}")
    if manifest.reconstruction is not None:
        shapes, styles = manifest.reconstruction.shapes, manifest.reconstruction.styles
        count = shapes["background_means_m"][0] + shapes["owners"][0]
        say(f"{count} Gaussians, styles: {', '.join(styles) or 'none'}")
    say(f"{len(manifest.files)} files, {size_mib:.1f} MiB")
    return scene.damaged_files()


def _named(card: Mapping[str, Any]) -> str:
    """What an editor's card says in so many words, for people: texts and numbers, not lists."""
    told = [
        f"{printable(name)} {printable(_shortened(name, value))}"
        for name, value in card.items()
        if isinstance(value, str | int | float) and value != "" and name != "editor"
    ]
    return f" ({', '.join(told)})" if told else ""


def _shortened(name: str, value: object) -> object:
    is_digest = isinstance(value, str) and name.endswith(("digest", "sha256", "revision"))
    return str(value)[:12] if is_digest else value
