"""How much is measured: the whole, or as little as shows that it works."""

from __future__ import annotations

from dataclasses import dataclass

from services.settings import Settings


@dataclass(frozen=True)
class Sizes:
    """Counts and paces of one run."""

    warm_up: int = 200
    requests: int = 2000
    submissions_per_second: float = 300.0
    pages_per_second: float = 100.0
    jobs: int = 100_000
    grid_jobs: int = 1000
    curve_points: int = 10_000
    beats: int = 100  # of each of the 20 loggers
    dispatches: int = 40
    busy_steps: int = 1200
    step_ms: float = 25.0  # as a training step on two cores takes
    idle_seconds: float = 20.0  # in which a worker without a job is watched
    lease_seconds: float = float(Settings.model_fields["lease_seconds"].default)


WHOLE = Sizes()
LITTLE = Sizes(
    warm_up=20,
    requests=60,
    jobs=300,
    grid_jobs=20,
    curve_points=600,
    beats=5,
    dispatches=4,
    busy_steps=80,
    idle_seconds=1.0,
    lease_seconds=3.0,
)
