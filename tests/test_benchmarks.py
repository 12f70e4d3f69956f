"""The benchmarks' own arithmetic: verdicts, fits, pixel counts, nested clocks."""

import time

import numpy as np
import pytest

from benchmarks.drawn import fragments
from benchmarks.growth import fitted_power
from benchmarks.overlays import COPY, FAR_COPY, ratios
from benchmarks.report import Row
from benchmarks.stages import STAGES, StageClock


@pytest.mark.parametrize(
    ("row", "verdict"),
    [
        (Row("a", 8.0, at_most=8), "met"),
        (Row("a", 8.1, at_most=8), "missed"),
        (Row("a", 150.0, at_least=150), "met"),
        (Row("a", 149.0, at_least=150), "missed"),
        (Row("a", float("nan"), at_most=8), "missed"),
        (Row("a", 1.0), ""),
    ],
)
def test_verdicts(row, verdict):
    assert verdict == row.verdict
    assert row.line().endswith(verdict)


def test_ratios_are_the_right_way_up():
    """Ours at 1 ms, all peers at 1000 ms, a copy at 0.5 ms: every target is met, none reversed."""
    ours = ("fog", *(f"fog + {kind} {n}" for kind in ("rain", "snow") for n in ("6.5k", "20k")))
    theirs = (
        "RandomFog (0.5-0.8)",
        "RandomRain (heavy)",
        "RandomSnow (texture)",
        "RandomFog + RandomRain",
    )
    copies = {COPY: 0.5, FAR_COPY: 0.5}
    fast = ratios(dict.fromkeys(ours, 1.0) | dict.fromkeys(theirs, 1000.0) | copies)
    slow = ratios(dict.fromkeys(ours, 1000.0) | dict.fromkeys(theirs, 1.0) | copies)
    assert {row.verdict for row in fast} == {"met"}
    assert {row.verdict for row in slow} == {"missed"}


def test_a_power_law_is_recovered():
    x = np.array([1e3, 1e4, 1e5, 1e6])
    fit = fitted_power(x, 0.3 * x**0.85)
    assert fit.exponent == pytest.approx(0.85)
    assert fit.factor == pytest.approx(0.3)
    np.testing.assert_allclose(0.3 * x**0.85, fit.at(x))


def test_fragments_are_the_pixels_inside_the_ellipses():
    """Leaning ellipses in and half out of the picture, against a plain mask of each."""
    rng = np.random.default_rng(0)
    height, width = 40, 50
    splats = np.zeros((30, 16), np.float32)
    expected = 0
    y, x = np.mgrid[:height, :width]
    for splat in splats:
        root = rng.normal(size=(2, 2)) * 4
        covariance = root @ root.T + 0.3 * np.eye(2)
        a, b, c = np.linalg.inv(covariance)[[0, 0, 1], [0, 1, 1]]
        u, v, reach2 = rng.uniform(-3, width + 3), rng.uniform(-3, height + 3), rng.uniform(0.5, 8)
        half_v = np.sqrt(reach2 * covariance[1, 1])
        half_u = np.sqrt(reach2 * np.linalg.det(covariance) / covariance[1, 1])
        splat[:6] = u, v, a, b, c, reach2
        splat[12:15] = half_v + 0.01, half_u + 0.01, covariance[0, 1] / covariance[1, 1]
        dx, dy = x - splat[0].astype(float), y - splat[1].astype(float)
        expected += int((a * dx**2 + 2 * b * dx * dy + c * dy**2 <= reach2).sum())
    assert expected > 500
    assert abs(expected - fragments(splats, height, width)) <= 2  # float32 at the ellipses' rims


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_is_a_function_of_the_renderer(name):
    owner, attribute = STAGES[name]
    assert callable(getattr(owner, attribute))


def test_time_inside_an_inner_stage_is_not_counted_twice():
    def busy(seconds):
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            pass

    clock = StageClock()
    inner = clock.timed("inner", lambda: busy(0.03))
    clock.timed("outer", lambda: (busy(0.01), inner()))()
    assert clock.seconds["inner"] == pytest.approx(0.03, abs=0.005)
    assert clock.seconds["outer"] == pytest.approx(0.01, abs=0.005)
