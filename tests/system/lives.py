"""What the events of a job tell of its attempts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from services.store.records import TERMINAL, Event, State


@dataclass
class Life:
    """Endings, seconds from every loss of an attempt to the next beginning, and seconds that the losses cost.

    A loss costs the time from the last sight of the job at the furthest place that it had reached until it is there
    again: the wait, the start of a process, and the steps that are repeated.
    """

    attempts: int = 0
    endings: list[str] = field(default_factory=list)
    waits: list[float] = field(default_factory=list)
    seconds_lost: float = 0.0


def life_of(told: Iterable[Event]) -> Life:
    """The life of the job that the events are of, by the database's clock."""
    life = Life()
    furthest, seen_at = -math.inf, 0.0
    requeued: float | None = None  # when the attempt was lost that nobody has followed yet
    behind = False  # whether an attempt was lost and its place not reached since
    for event in told:
        state = event.payload["state"] if event.kind == "state" else None
        if state == State.QUEUED and "reason" in event.payload:
            requeued, behind = event.created_at, True
        elif state == State.RUNNING:
            life.attempts += 1
            life.waits += [] if requeued is None else [event.created_at - requeued]
            requeued = None
        elif state in TERMINAL:
            life.endings.append(str(state))
        if (place := _place(event)) >= furthest:
            life.seconds_lost += event.created_at - seen_at if behind else 0.0
            furthest, seen_at, behind = place, event.created_at, False
    return life


def _place(event: Event) -> float:
    """How far the job is: begun, a share of its work, done; of other events, nowhere."""
    if event.kind == "progress":
        return float(event.payload["fraction"])
    places: dict[object, float] = {State.RUNNING: -1.0, State.SUCCEEDED: 1.0}
    return places.get(event.payload.get("state"), -math.inf)
