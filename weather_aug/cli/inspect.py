"""The command that says what a scene or an export holds, and whether it is whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from weather_aug.cli.terminal import say
from weather_aug.errors import DataError, IntegrityError, printable

if TYPE_CHECKING:
    from weather_aug.writers.source import Source


@dataclass(frozen=True)
class Inspect:
    """Say what a scene or an export holds, and whether every byte is the one written."""

    path: Positional[str]
    """Scene or export folder, or the url of an export."""

    def run(self) -> None:
        """Print the contents, then verify; damage ends with exit code 4."""
        from weather_aug.writers.source import source_of

        problems, cure = _inspected(self.path)
        for problem in problems:
            say(problem)
        if problems:
            count = f"{len(problems)} problem{'s' if len(problems) > 1 else ''}"
            raise IntegrityError(f"{source_of(self.path)} is not whole ({count}); {cure}")
        say("every file is whole")


def _inspected(path: str) -> tuple[list[str], str]:
    """What is wrong with a scene or an export, one sentence each, and the cure."""
    from weather_aug.scene import store
    from weather_aug.writers import layout
    from weather_aug.writers.source import exists, is_url, source_of
    from weather_aug.writers.verify import verify_export

    if not is_url(path) and (Path(path) / store.MANIFEST).is_file():
        return _inspect_scene(Path(path)), "build the scene again"
    source = source_of(path)
    if any(exists(source, name) for name in (layout.CONTENTS, layout.JOURNAL, layout.MARK)):
        return verify_export(source), _cure_of_export(source)
    raise DataError(
        f"{source} is neither a scene (no {store.MANIFEST}) nor an export (no {layout.CONTENTS})"
    )


def _cure_of_export(source: Source) -> str:
    from weather_aug.writers import layout
    from weather_aug.writers.source import contents_of, exists

    try:
        if exists(source, layout.CONTENTS):
            contents_of(source)
    except (DataError, IntegrityError):
        # Nobody knows any more which job it was.
        return "remove the folder and export again"
    return "run the same export again with --verify to repair it"


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
