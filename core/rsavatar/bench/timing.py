"""Timings that can be compared: everything in one run, in turns, medians."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from statistics import median

SLOW_MS = 150.0  # actions slower than this take part in the first rounds only


def interleave(
    actions: Mapping[str, Callable[[], object]], rounds: int, slow_rounds: int = 3
) -> dict[str, list[float]]:
    """Milliseconds of every action in every round, by name, after one warm-up of each.

    All actions take their turn in each round, so that a disturbance of the machine falls on all of them. In its turn an
    action is done twice, and timed the second time: it finds its own data in the caches, as in a loop that does
    nothing else, not the data of who came before. Slow ones fill the caches themselves, and are done once.
    """
    slow = {name for name, action in actions.items() if milliseconds(action) > SLOW_MS}
    taken: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(rounds):
        for name, action in actions.items():
            if name not in slow:
                action()
            if name not in slow or turn < slow_rounds:
                taken[name].append(milliseconds(action))
    return taken


def narrate(stage: str) -> None:
    """Say on stderr what is measured next: a benchmark takes minutes."""
    print(f"bench: {stage}", file=sys.stderr, flush=True)


def ratio(above: list[float], below: list[float]) -> float:
    """Median over the rounds that both took part in of one's time by the other's."""
    return median(a / b for a, b in zip(above, below, strict=False))


def milliseconds(action: Callable[[], object]) -> float:
    """Wall-clock time of doing it once."""
    begun = time.perf_counter()
    action()
    return 1e3 * (time.perf_counter() - begun)
