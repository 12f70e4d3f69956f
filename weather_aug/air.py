"""How the air of a weather moves: its wind now, and how far it has carried since time 0."""

from __future__ import annotations

from dataclasses import dataclass

from weather_aug.weather import Wind


@dataclass(frozen=True)
class Air:
    """Motion of the air at one moment; vectors are (along the street, to its left, up)."""

    wind_m_per_s: Wind
    """Wind at this moment, gusts included."""
    drift_m: Wind
    """How far the wind has carried the air since time 0."""
    wet_s: float = 0.0
    """Integral of the snow's wetness since time 0, seconds: wet flakes fall faster."""
