"""What the store hands out and takes: frozen records, free of sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class State(StrEnum):
    """States of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FAILED = "failed"
    DEAD = "dead"
    SUCCEEDED = "succeeded"


TERMINAL = frozenset({State.CANCELLED, State.FAILED, State.DEAD, State.SUCCEEDED})
RETRYABLE = frozenset({State.CANCELLED, State.FAILED, State.DEAD})


class Failure(StrEnum):
    """Why an attempt ended. Only ``INFRASTRUCTURE`` is worth another attempt: the others would end the same way."""

    INFRASTRUCTURE = "infrastructure"
    OUT_OF_MEMORY = "out of memory"
    DIVERGED = "diverged"
    BAD_DATA = "bad data"
    BUG = "bug"


SHARES = {"train": (0.0, 0.9), "evaluate": (0.9, 0.1)}  # where a stage begins in the whole job, and its share


def fraction_of(stage: str | None, step: int, steps: int) -> float:
    """How much of a job is done, by its newest look; other stages prepare, and count as nothing."""
    start, share = SHARES.get(stage or "", (0.0, 0.0))
    return min(1.0, start + share * step / steps) if steps else start


@dataclass(frozen=True)
class Job:
    """A row of the queue of record."""

    id: str
    spec: Mapping[str, Any]
    spec_sha256: str
    method: str
    subject: str
    priority: int
    grid_id: str | None
    owner: str
    notes: str
    idempotency_key: str | None
    request_sha256: str
    content_sha256: str | None
    forced: bool
    reused_from: str | None
    state: str
    attempt: int
    failures: int
    max_attempts: int
    lease_owner: str | None
    lease_until: float | None
    not_before: float
    cancel_requested_at: float | None
    pause_requested_at: float | None
    error_kind: str | None
    error: str | None
    first_traceback: str | None
    stage: str | None
    step: int
    steps: int
    loss: float | None
    psnr: float | None
    gaussians: int | None
    eta_seconds: float | None
    rss_bytes: int | None
    created_at: float
    started_at: float | None
    finished_at: float | None


@dataclass(frozen=True)
class Submission:
    """A job to be. Its fields are columns of the job.

    With ``content_sha256`` (of spec, data and code) a finished job of the same content gives its result at once, unless
    ``forced``.
    """

    spec: Mapping[str, Any]
    spec_sha256: str
    request_sha256: str
    max_attempts: int
    idempotency_key: str | None = None
    grid_id: str | None = None
    owner: str = "local"
    notes: str = ""
    content_sha256: str | None = None
    forced: bool = False


@dataclass(frozen=True)
class Filters:
    """What a listing shows; None = everything."""

    state: str | None = None
    method: str | None = None
    subject: str | None = None
    grid: str | None = None
    query: str | None = None  # in the language of services.store.query
    preset: str | None = None
    tag: str | None = None
    seeds: Sequence[int] = ()


@dataclass(frozen=True)
class Claim:
    """The right to run a job: valid while the row still has this ``attempt`` and is running."""

    job_id: str
    attempt: int
    spec: Mapping[str, Any]
    subject: str


@dataclass(frozen=True)
class Artifact:
    """A stored file of a job."""

    name: str
    sha256: str
    mime: str
    size: int


@dataclass(frozen=True)
class Event:
    """Something that happened to a job; ``id`` and ``created_at`` are given by the database."""

    kind: str
    payload: Mapping[str, Any]
    job_id: str = ""
    id: int = 0
    created_at: float = 0.0


@dataclass(frozen=True)
class Point:
    """One value of a training curve."""

    key: str
    step: int
    value: float


@dataclass(frozen=True)
class Look:
    """The newest progress of a job, kept on its row so that listings join nothing."""

    stage: str
    step: int
    steps: int
    loss: float | None
    psnr: float | None
    gaussians: int | None
    eta_seconds: float


@dataclass(frozen=True)
class Checkpoint:
    """A stored checkpoint: the state after ``step``, in bytes of this hash."""

    step: int
    sha256: str
    size: int


@dataclass(frozen=True)
class Batch:
    """What a running job says in one transaction; an empty one is a heartbeat."""

    events: Sequence[Event] = ()
    points: Sequence[Point] = ()
    artifacts: Sequence[Artifact] = ()
    look: Look | None = None
    rss_bytes: int | None = None
    checkpoint: Checkpoint | None = None


@dataclass(frozen=True)
class Orders:
    """What the database answers to a heartbeat."""

    cancel: bool
    pause: bool


@dataclass(frozen=True)
class Score:
    """One metric of one held-out image."""

    camera: str
    frame: int
    metric: str
    value: float | None


@dataclass(frozen=True)
class Outcome:
    """What a succeeded job found."""

    means: Mapping[str, float | None]
    per_camera: Mapping[str, Any]
    protocol: Mapping[str, Any]
    provenance: Mapping[str, Any]
    gaussians: int
    train_seconds: float
    evaluate_seconds: float
    scores: Sequence[Score] = ()
    artifacts: Sequence[Artifact] = ()


@dataclass(frozen=True)
class TableEntry:
    """A succeeded job and its result, as the tables need them."""

    job: Job
    means: Mapping[str, float | None]
    protocol: Mapping[str, Any]
    provenance: Mapping[str, Any]
    train_seconds: float
    gaussians: int
    evaluate_seconds: float | None = None
