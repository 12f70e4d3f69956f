"""The command that builds a scene: which clip, which editor of backgrounds, which Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from weather_aug.cli.terminal import say, to_people
from weather_aug.errors import ArgumentError, printable


@dataclass(frozen=True)
class Build:
    """Precompute a clip into a scene folder; run again to continue interrupted work."""

    clip: Positional[str]
    """Clip, "scheme:path?option=value&…" (kitti-odometry, kitti-raw, dgp, folder, street)."""
    out: Path
    """Scene folder to make."""
    editor: str = "physical"
    """How backgrounds get their weather: physical (while rendering), diffusion, instruct-pix2pix,
    controlnet, turboedit, stylisation, colour-transfer, snow-cover, or none."""
    weathers: tuple[str, ...] | None = None
    """Types the scene is meant for, and that another editor than physical edits to; all that it
    knows if not given."""
    base: str | None = None
    """Folder of the editor's model in the diffusers layout, or its id in the local cache."""
    adapter: Path | None = None
    """Folder of the diffusion editor's adapter, as train-editor writes it."""
    attention: str | None = None
    """Weights of the diffusion editor's attention: release, paper, or self."""
    without: tuple[str, ...] = ()
    """What the diffusion editor does without: labels, view, temporal."""
    control: str | None = None
    """Folder or id of a ControlNet."""
    weights: Path | None = None
    """Folder of the networks of stylisation."""
    pictures: Path | None = None
    """Folder with a picture of each weather, for stylisation and colour-transfer."""
    edit_height: int | None = None
    """Rows at which pictures are edited, their aspect kept; their own if not given."""
    device: str | None = None
    """Of torch, for the editor; cpu if not given."""
    overwrite: bool = False
    """Replace the scene that stands in `out`."""
    reconstruct: bool = False
    """Turn the frames into Gaussians, too, so that they can be rendered from elsewhere; takes
    minutes."""
    steps: int | None = None
    """Of the fit; see `FitOptions` for this and the next two."""
    count: int | None = None
    """Gaussians at the most."""
    scale: float | None = None
    """Of the pictures' sides for the fit, in (0, 1]."""
    styles: tuple[str, ...] | None = None
    """Weathers whose colours the Gaussians learn; rain snow fog if not given."""

    def run(self) -> None:
        """Build and say what was made."""
        from weather_aug.clip.open import open_clip
        from weather_aug.scene.scene import WeatherScene

        choices = self._editing() | self._reconstruction()
        scene = WeatherScene.build(
            open_clip(self.clip),
            self.out,
            weathers=self.weathers,
            progress=to_people(),
            overwrite=self.overwrite,
            **choices,
        )
        say(f"{len(scene.keys)} frames of {', '.join(scene.cameras)} in {self.out}")
        manifest = scene.manifest
        if manifest.styles:
            say(f"backgrounds by {manifest.editor}: {', '.join(manifest.styles)}")
        record = manifest.reconstruction
        if record is not None:
            count = record.shapes["background_means_m"][0] + record.shapes["owners"][0]
            told = ", ".join(f"{name} {value:.4g}" for name, value in record.fit.items())
            say(f"{count} Gaussians of {len(record.cameras)} frames ({told})")

    def _editing(self) -> dict[str, Any]:
        """The editor and its options, for `WeatherScene.build`."""
        default = Build(self.clip, self.out)
        given = [f.name for f in fields(self) if getattr(self, f.name) != getattr(default, f.name)]
        flags = [name for name in given if name in _OPTION_BY_FLAG]
        chosen = {_OPTION_BY_FLAG[name]: getattr(self, name) for name in flags}
        editors = _EDITORS_BY_FLAG
        for name in flags:
            if self.editor not in editors[name]:
                raise ArgumentError(
                    f"--{name.replace('_', '-')} is for --editor {' or '.join(editors[name])}, "
                    f"not for {printable(self.editor)}"
                )
        if not chosen:
            return {"editor": self.editor}
        if self.editor == "diffusion":
            from weather_aug.edit.diffusion.options import DiffusionOptions

            if self.attention is not None:
                chosen["attention"] = _attention(self.attention)
            return {"editor": self.editor, "editor_options": DiffusionOptions(**chosen)}
        from weather_aug.edit.peers.options import PeerOptions

        return {"editor": self.editor, "editor_options": PeerOptions(**chosen)}

    def _reconstruction(self) -> dict[str, Any]:
        """Arguments of `WeatherScene.build`."""
        numbers: dict[str, Any] = {"steps": self.steps, "count": self.count, "scale": self.scale}
        given = {name: value for name, value in numbers.items() if value is not None}
        if not self.reconstruct:
            names = [*given, *(["styles"] if self.styles is not None else [])]
            if names:
                raise ArgumentError(f"--{names[0]} needs --reconstruct")
            return {}
        from weather_aug.gaussians.options import FitOptions

        chosen: dict[str, Any] = {"reconstruct": True, "reconstruction": FitOptions(**given)}
        return chosen | ({} if self.styles is None else {"styles": self.styles})


_OPTION_BY_FLAG = {
    name: {"edit_height": "height"}.get(name, name)
    for name in (
        *("base", "adapter", "attention", "without", "control", "weights", "pictures"),
        *("edit_height", "device"),
    )
}
_MODELS = ("diffusion", "instruct-pix2pix", "controlnet", "turboedit")
_NETWORKS = (*_MODELS, "stylisation")
_EDITORS_BY_FLAG = {
    "base": _MODELS,
    "adapter": ("diffusion",),
    "attention": ("diffusion",),
    "without": ("diffusion",),
    "control": ("controlnet",),
    "weights": ("stylisation",),
    "pictures": ("stylisation", "colour-transfer"),
    "edit_height": _NETWORKS,
    "device": _NETWORKS,
}
"""Which editors a flag means something to."""


def _attention(name: str) -> Any:
    from weather_aug.edit.diffusion import options

    weights = {
        "release": options.RELEASE_WEIGHTS,
        "paper": options.paper_weights(),
        "self": options.SELF_ONLY,
    }
    if name not in weights:
        raise ArgumentError(f"--attention: {printable(name)!r} is not one of {', '.join(weights)}")
    return weights[name]
