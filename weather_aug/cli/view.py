"""The command that shows a scene in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from weather_aug.cli.render import severity_of
from weather_aug.cli.terminal import say


@dataclass(frozen=True)
class View:
    """Show a scene's Gaussians, its cameras and falling particles in a browser; needs viser."""

    scene: Positional[Path]
    """Scene folder."""
    weather: str = "snow"
    """Weather type to begin with: clear, rain, snow or fog."""
    severity: str = "heavy"
    """light, moderate, heavy, extreme, or a number in [0, 1]."""
    seed: int = 0
    """Which particles fall."""
    port: int = 8080
    """Where to listen; 0 is any free port, and where it is taken the next free one is used."""
    host: str = "127.0.0.1"
    """Address to listen on; whoever reaches it sees the scene."""

    def run(self) -> None:
        """Serve until Ctrl-C."""
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view.viewer import open_viewer

        scene = WeatherScene.load(self.scene)
        say(f"preparing {scene.name}: {len(scene.keys)} frames")
        viewer = open_viewer(
            scene,
            weather=self.weather,
            severity=severity_of(self.severity),
            seed=self.seed,
            host=self.host,
            port=self.port,
        )
        with viewer:
            say(f"open {viewer.address} in a browser; Ctrl-C ends")
            try:
                viewer.wait()
            except KeyboardInterrupt:
                say("closed")
