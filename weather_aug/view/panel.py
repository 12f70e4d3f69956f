"""A panel of widgets over one picture, for notebooks: set a weather, look at it.

Convention:
    The kernel renders when a control is let go, not while it is dragged, in the thread that serves
    the notebook: there is no thread to leave behind. An error of this package is shown as text in
    place of the picture; another one is a fault of ours and is not hidden.
"""

from __future__ import annotations

import base64
import html
from typing import Any

import numpy as np

from weather_aug._checks import finite
from weather_aug._extras import require
from weather_aug._keys import check_seed
from weather_aug._png import png_bytes
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, WeatherAugError, printable
from weather_aug.render.compose import RenderedFrame
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.severity import parse_severity
from weather_aug.view.planes import PLANES, painted
from weather_aug.view.source import Source
from weather_aug.view.units import titled
from weather_aug.weather import Weather

WIDEST_PX = (64, 4096)
MOST_SEED = 2**31 - 1


def open_panel(
    source: Source, *, kind: str, severity: str | float, seed: int, max_width: int
) -> Panel:
    """A panel that shows the middle frame; see `weather_aug.preview.panel`."""
    if kind not in TYPES:
        raise ArgumentError(f"weather type {printable(kind)!r} is not one of {', '.join(TYPES)}")
    start = parse_severity(severity)
    finite("seed", check_seed("seed", seed), 0, MOST_SEED)
    finite("max_width", check_seed("max_width", max_width), *WIDEST_PX)
    return Panel(source, _controls(source, kind, start, seed), max_width)


def panel_of_error(error: WeatherAugError) -> Panel:
    """A panel that says why there is nothing to show."""
    panel = Panel(None, {}, WIDEST_PX[0])
    panel.say(error)
    return panel


class Panel:
    """What a notebook shows as the last line of a cell; made by `weather_aug.preview.panel`."""

    def __init__(self, source: Source | None, controls: dict[str, Any], max_width: int) -> None:
        """Use `weather_aug.preview.panel`."""
        widgets = _widgets()
        self.controls = controls
        """Widgets by name: type, severity, seed, time, camera, show; none over an error."""
        self.picture = widgets.Image(format="png", layout={"max_width": "100%"})
        self.caption = widgets.HTML()
        self.shot: RenderedFrame | None = None
        """What is shown; None where there is an error."""
        self._source = source
        self._max_width = max_width
        self.widget = widgets.VBox([*_rows(controls), self.picture, self.caption])
        for control in controls.values():
            control.observe(self._changed, names="value")
        self.update()

    @property
    def weather(self) -> Weather:
        """As set now."""
        return weather_of(self.controls["type"].value, self.controls["severity"].value)

    @property
    def key(self) -> FrameKey:
        """Of the frame as set now."""
        return FrameKey(self.controls["time"].value, self.controls["camera"].value)

    def update(self) -> None:
        """Show what is set; controls do so by themselves."""
        if self._source is None:
            return
        try:
            shot = self._source.shot(self.key, self.weather, self.controls["seed"].value)
            png = png_bytes(painted(shot, self.controls["show"].value, self._max_width))
        except WeatherAugError as error:
            self.say(error)
            return
        self.shot = shot
        self.picture.value = png
        self.picture.layout.display = None
        self.caption.value = _as_html(
            _told(shot, titled(self.controls["type"].value, self.weather))
        )

    def say(self, error: WeatherAugError) -> None:
        """Show an error's words, and no picture that could be taken for what was asked."""
        self.shot = None
        self.picture.value = b""
        self.picture.layout.display = "none"
        self.caption.value = _as_html(f"{type(error).__name__}: {error}")

    def close(self) -> None:
        """Take the widgets away and forget the source; twice does no harm."""
        for control in self.controls.values():
            control.unobserve_all()
        for widget in (*self.controls.values(), self.widget):
            for each in _family(widget):
                each.close()
        self._source = self.shot = None

    def _changed(self, _: object) -> None:
        self.update()

    def _repr_mimebundle_(self, **how: Any) -> dict[str, Any]:
        """The widgets, and the picture alone for pages that show none, as nbconvert's."""
        if self.widget.comm is None:
            return {"text/plain": "a panel that was closed"}
        bundle: dict[str, Any] = self.widget._repr_mimebundle_(**how)
        if self.picture.value:
            bundle["image/png"] = base64.b64encode(self.picture.value).decode("ascii")
        return bundle


def _widgets() -> Any:
    return require(
        "ipywidgets",
        extra="notebook",
        to="show a panel (weather_aug.preview.sweep makes still pictures without it)",
    )


def _controls(source: Source, kind: str, severity: float, seed: int) -> dict[str, Any]:
    """Widgets that tell of a change once it is done; the middle frame is chosen."""
    widgets = _widgets()
    late: dict[str, Any] = {"continuous_update": False}
    middle = source.keys[len(source.keys) // 2]
    times = sorted({key.time_index for key in source.keys})
    cameras = list(dict.fromkeys(key.camera for key in source.keys))
    return {
        "type": widgets.Dropdown(options=TYPES, value=kind, description="type"),
        "severity": widgets.FloatSlider(
            value=severity, min=0.0, max=1.0, step=0.01, description="severity", **late
        ),
        "seed": widgets.BoundedIntText(
            value=seed, min=0, max=MOST_SEED, description="seed", **late
        ),
        "time": widgets.SelectionSlider(
            options=times, value=middle.time_index, description="time", **late
        ),
        "camera": widgets.Dropdown(options=cameras, value=middle.camera, description="camera"),
        "show": widgets.Dropdown(options=PLANES, description="show"),
    }


def _rows(controls: dict[str, Any]) -> list[Any]:
    """Boxes of three controls; what leaves no choice is left out."""
    widgets = _widgets()
    chosen = [each for each in controls.values() if len(getattr(each, "options", (0, 1))) > 1]
    return [
        widgets.HBox(chosen[first : first + 3], layout={"flex_flow": "row wrap"})
        for first in range(0, len(chosen), 3)
    ]


def _told(shot: RenderedFrame, weather: str) -> str:
    told = f"{weather} · frame {shot.frame.key}"
    if shot.label is None:
        return told
    hidden = float(np.mean(shot.label != shot.label_full))
    return f"{told} · the weather hides {hidden:.1%} of the label"


def _as_html(text: str) -> str:
    """Text as text, whoever wrote it."""
    return f'<span style="white-space: pre-wrap">{html.escape(text)}</span>'


def _family(widget: Any) -> list[Any]:
    """A widget, what it holds, and the models of their layouts and styles."""
    held = [each for child in getattr(widget, "children", ()) for each in _family(child)]
    own = [getattr(widget, name, None) for name in ("layout", "style")]
    return [*held, *(each for each in own if each is not None), widget]
