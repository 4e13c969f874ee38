"""How long jobs take, from those that have finished: the more alike, the better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from sqlalchemy import func, select

from services.store.records import State
from services.store.session import Store
from services.store.tables import JobRow, ResultRow

NEWEST = 2000  # finished jobs that are looked at
STEP_SECONDS, EVALUATE_SECONDS = 0.05, 30.0  # assumed where nothing like it has finished
ASSUMED = f"assumed: {STEP_SECONDS:g} s a step and {EVALUATE_SECONDS:g} s to evaluate; no such job has finished yet"
LIKENESS: tuple[tuple[str, tuple[str, ...]], ...] = (  # from the most alike to the least
    ("method, subject and preset", ("method", "subject", "preset")),
    ("method and subject", ("method", "subject")),
    ("method and preset", ("method", "preset")),
    ("method", ("method",)),
)

Traits = tuple[str, tuple[Any, ...]]


@dataclass(frozen=True)
class Pace:
    """Mean cost of finished jobs that are alike."""

    step_seconds: float
    evaluate_seconds: float
    jobs: int


@dataclass(frozen=True)
class Estimate:
    """Seconds that a job will take from its first step, and what says so."""

    seconds: float
    basis: str
    jobs: int


@dataclass(frozen=True)
class Paces:
    """What is known about how long jobs take."""

    known: Mapping[Traits, Pace]

    def of(self, spec: Mapping[str, Any]) -> Estimate:
        """The estimate for a job, from the most alike that have finished."""
        steps = int(spec.get("iterations", 0))
        for words, names in LIKENESS:
            pace = self.known.get((words, tuple(spec.get(name) for name in names)))
            if pace is not None:
                seconds = steps * pace.step_seconds + pace.evaluate_seconds
                return Estimate(seconds, f"measured: {pace.jobs} finished jobs of the same {words}", pace.jobs)
        return Estimate(steps * STEP_SECONDS + EVALUATE_SECONDS, ASSUMED, 0)


def measure(store: Store) -> Paces:
    """Read the paces of the newest finished jobs."""
    spec = (JobRow.spec["preset"].as_string(), JobRow.spec["iterations"].as_integer())
    columns = (JobRow.method, JobRow.subject, *spec, ResultRow.train_seconds, ResultRow.evaluate_seconds)
    query = select(*columns).join(ResultRow, ResultRow.job_id == JobRow.id)
    newest = query.where(JobRow.state == State.SUCCEEDED).order_by(JobRow.id.desc()).limit(NEWEST)
    samples: dict[Traits, list[tuple[float, float]]] = {}
    with store.read() as session:
        for method, subject, preset, steps, train, evaluate in session.execute(newest):
            traits = {"method": method, "subject": subject, "preset": preset}
            for words, names in LIKENESS:
                key = (words, tuple(traits[name] for name in names))
                samples.setdefault(key, []).append((train / max(1, steps or 1), evaluate))
    return Paces({key: _mean(found) for key, found in samples.items()})


def running(store: Store) -> int:
    """Jobs that run now."""
    with store.read() as session:
        return int(session.scalar(select(func.count()).where(JobRow.state == State.RUNNING)) or 0)


def _mean(samples: list[tuple[float, float]]) -> Pace:
    return Pace(fmean(s for s, _ in samples), fmean(e for _, e in samples), len(samples))
