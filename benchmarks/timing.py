"""Interleaved timing: every contender once a round, medians over the rounds.

Processor time of this thread, so that a busy machine slows all contenders alike, if at all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median

ROUNDS = 9
TURN_S = 0.01
"""Quick contenders are called again until a turn takes this long, so that all run warm."""
MOST_CALLS = 200


def interleaved(
    contenders: Mapping[str, Callable[[], object]], rounds: int = ROUNDS
) -> dict[str, float]:
    """Median processor milliseconds a call of each contender, timed in turns after a warm-up."""
    turns = interleaved_turns(contenders, rounds)
    return {name: median(values) for name, values in turns.items()}


def interleaved_turns(
    contenders: Mapping[str, Callable[[], object]], rounds: int = ROUNDS
) -> dict[str, list[float]]:
    """Processor milliseconds a call of each contender in each round."""
    calls = {name: _calls_a_turn(run) for name, run in contenders.items()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            times[name].append(1e3 * _seconds(run, calls[name]) / calls[name])
    return times


def _calls_a_turn(run: Callable[[], object]) -> int:
    run()
    once_s = max(_seconds(run, 1), 1e-7)
    return min(max(int(TURN_S / once_s), 1), MOST_CALLS)


def _seconds(run: Callable[[], object], calls: int) -> float:
    start = time.thread_time()
    for _ in range(calls):
        run()
    return time.thread_time() - start
