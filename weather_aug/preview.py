"""Looking before training: what weathers, severities and policies make of your own pictures.

Figures need matplotlib and the panel ipywidgets: pip install 'weather-aug[notebook]'. Scenes are
only read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from weather_aug._keys import check_seed
from weather_aug.clip.types import FrameKey
from weather_aug.errors import DataError, IntegrityError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.picture import checked_policy
from weather_aug.view.panel import Panel, open_panel, panel_of_error
from weather_aug.view.sheet import KINDS, SEVERITIES
from weather_aug.view.source import Shown, source_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draws", "panel", "sweep"]


def sweep(
    source: Shown,
    key: FrameKey | None = None,
    *,
    kinds: Sequence[str] = KINDS,
    severities: Sequence[str | float] = SEVERITIES,
    seed: int = 0,
    planes: Sequence[str] = ("image",),
    tile_width: int = 280,
    **how: Any,
) -> Figure:
    """A row per weather, a column per severity, the clear frame first; titles are in mm/h and m.

    Args:
        source: A scene, its folder, or one (H, W, 3) RGB picture, uint8 or float32 in [0, 1].
        key: Which frame of a scene; the middle one if None.
        kinds: Weather types.
        severities: Names or numbers in [0, 1].
        seed: Of the particles, which stay in place from one severity to the next.
        planes: What is shown below each other: "image", "label" (Cityscapes colours, black is
            ignored), "transmittance" (dark is thick air).
        tile_width: Width of each picture, pixels at 100 dots per inch.
        **how: `options` of the renderer; for a single picture also `mask` (H, W) ids, `depth`
            (H, W) metres, `camera`, and what `Weathering.of` takes, such as `taxonomy`.

    Returns:
        A `matplotlib.figure.Figure` that no pyplot knows of: a notebook shows it, `savefig` keeps
        it.

    Raises:
        ArgumentError: If an argument is none, or a label is asked for where there is none.
        DataError: If a scene cannot be read, or a mask holds ids of no class.
        MissingExtraError: If matplotlib is not installed.
    """
    from weather_aug.view import figure

    return figure.sweep(
        source_of(source, **how),
        key,
        kinds=kinds,
        severities=severities,
        seed=check_seed("seed", seed),
        planes=planes,
        tile_width=tile_width,
    )


def draws(
    source: Shown,
    policy: WeatherPolicy | dict[str, Any] | None = None,
    *,
    count: int = 12,
    seed: int = 0,
    columns: int = 4,
    planes: Sequence[str] = ("image", "label"),
    tile_width: int = 280,
    **how: Any,
) -> Figure:
    """What a policy draws: items of `WeatherDataset([scene], policy, seed=seed)`.

    They are spread over the first epoch; where there are more than frames, further epochs follow.

    Args:
        source: As in `sweep`; of a single picture each draw is an epoch.
        policy: Or its `to_dict` form; the default policy if None.
        count: Number of draws, in [1, 256].
        seed: Of all draws.
        columns: Pictures side by side.
        planes: As in `sweep`.
        tile_width: As in `sweep`.
        **how: As in `sweep`.

    Returns:
        As `sweep` does.

    Raises:
        ArgumentError: As `sweep` does.
        DataError: As `sweep` does.
        MissingExtraError: If matplotlib is not installed.
    """
    from weather_aug.view import figure

    return figure.draws(
        source_of(source, **how),
        checked_policy(policy),
        count=count,
        seed=check_seed("seed", seed),
        columns=columns,
        planes=planes,
        tile_width=tile_width,
    )


def panel(
    source: Shown,
    *,
    kind: str = "rain",
    severity: str | float = "heavy",
    seed: int = 0,
    max_width: int = 960,
    **how: Any,
) -> Panel:
    """Widgets for type, severity, seed, time and camera over one picture, in a notebook.

    The picture is rendered anew when a control is let go. What cannot be rendered is said in words
    below it; so is a folder that is no scene. Where a page shows no widgets, as on paper, the
    picture stands alone. `Panel.close` frees the widgets.

    Args:
        source: As in `sweep`.
        kind: Weather type to begin with: clear, rain, snow or fog.
        severity: In [0, 1] or a name (light, moderate, heavy, extreme).
        seed: Of the particles, in [0, 2**31).
        max_width: Of the picture that is sent to the browser, pixels.
        **how: As in `sweep`.

    Raises:
        ArgumentError: If an argument is none.
        MissingExtraError: If ipywidgets is not installed.
    """
    try:
        found = source_of(source, **how)
    except (DataError, IntegrityError) as error:
        return panel_of_error(error)
    return open_panel(found, kind=kind, severity=severity, seed=seed, max_width=max_width)
