"""Shapes of replies. Instants are ISO 8601 in UTC."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

from pydantic import BaseModel

from services.store.records import TERMINAL, Artifact, Job, Outcome, State, fraction_of
from services.store.subject_records import Subject

PLAIN: tuple[str, ...] = ("id", "state", "method", "subject", "priority", "grid_id", "owner", "reused_from")
PLAIN += ("attempt", "failures", "max_attempts", "rss_bytes")
DETAILS = ("spec_sha256", "content_sha256", "forced", "notes", "first_traceback")


def instant(seconds: float | None) -> datetime | None:
    """Seconds since 1970 as a date with a zone."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


class ProgressView(BaseModel):
    """The newest look at a job."""

    stage: str | None
    step: int
    steps: int
    fraction: float
    loss: float | None
    psnr: float | None
    gaussians: int | None
    eta_seconds: float | None


class ErrorView(BaseModel):
    """Why a job did not end well, or what its first infrastructure failure was."""

    kind: str
    message: str


class JobView(BaseModel):
    """A job without its spec, as lists show it."""

    id: str
    state: str
    terminal: bool
    method: str
    subject: str
    preset: str | None
    iterations: int | None
    priority: int
    grid_id: str | None
    owner: str
    reused_from: str | None
    attempt: int
    failures: int
    max_attempts: int
    rss_bytes: int | None
    cancel_requested: bool
    pause_requested: bool
    progress: ProgressView
    error: ErrorView | None
    created_at: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    tags: list[str] = []

    @classmethod
    def fields_of(cls, job: Job) -> dict[str, Any]:
        """Values of the fields that lists and single jobs share."""
        return {name: getattr(job, name) for name in PLAIN} | {
            "terminal": job.state in TERMINAL,
            "preset": job.spec.get("preset"),
            "iterations": job.spec.get("iterations"),
            "cancel_requested": job.cancel_requested_at is not None,
            "pause_requested": job.pause_requested_at is not None,
            "progress": progress_of(job),
            "error": None if job.error is None else ErrorView(kind=job.error_kind or "", message=job.error),
            "created_at": instant(job.created_at),
            "started_at": instant(job.started_at),
            "finished_at": instant(job.finished_at),
        }

    @classmethod
    def of(cls, job: Job, tags: Iterable[str] = ()) -> JobView:
        """The view of a job."""
        return cls(tags=list(tags), **cls.fields_of(job))


def progress_of(job: Job) -> ProgressView:
    """Progress columns of a job; a succeeded job is whole."""
    fraction = 1.0 if job.state == State.SUCCEEDED else fraction_of(job.stage, job.step, job.steps)
    names = ("stage", "step", "steps", "loss", "psnr", "gaussians", "eta_seconds")
    return ProgressView(fraction=fraction, **{name: getattr(job, name) for name in names})


class JobDetail(JobView):
    """A job with its complete spec, and all that is known of its failures."""

    spec: dict[str, Any]
    spec_sha256: str
    content_sha256: str | None
    forced: bool
    notes: str
    first_traceback: str | None

    @classmethod
    def of(cls, job: Job, tags: Iterable[str] = ()) -> JobDetail:
        """The view of a job."""
        details = {name: getattr(job, name) for name in DETAILS}
        return cls(spec=dict(job.spec), tags=list(tags), **details, **cls.fields_of(job))


class JobPage(BaseModel):
    """Jobs, newest first; ``next_cursor`` is none on the last page."""

    items: list[JobView]
    next_cursor: str | None


class ArtifactView(BaseModel):
    """A file of a job."""

    name: str
    sha256: str
    mime: str
    size: int
    url: str

    @classmethod
    def of(cls, artifact: Artifact) -> ArtifactView:
        """The view of an artifact."""
        return cls(**vars(artifact), url=f"/api/v1/artifacts/{artifact.sha256}")


class ScoreView(BaseModel):
    """One metric of one held-out image."""

    camera: str
    frame: int
    metric: str
    value: float | None


class ResultView(BaseModel):
    """What a succeeded job found."""

    means: dict[str, float | None]
    per_camera: dict[str, Any]
    scores: list[ScoreView]
    protocol: dict[str, Any]
    provenance: dict[str, Any]
    gaussians: int
    train_seconds: float
    evaluate_seconds: float

    @classmethod
    def of(cls, outcome: Outcome) -> ResultView:
        """The view of an outcome."""
        fields: Mapping[str, Any] = {k: v for k, v in vars(outcome).items() if k not in {"scores", "artifacts"}}
        return cls(scores=[ScoreView(**vars(score)) for score in outcome.scores], **fields)


class MethodView(BaseModel):
    """A method of the catalogue."""

    name: str
    description: str
    ablation_flags: list[str]


class SubjectView(BaseModel):
    """A registered subject."""

    name: str
    kind: str
    path: str | None
    info: dict[str, Any]
    created_at: datetime | None
    owner: str
    state: str
    size: int | None

    @classmethod
    def of(cls, subject: Subject) -> SubjectView:
        """The view of a subject."""
        return cls(**{**vars(subject), "info": dict(subject.info), "created_at": instant(subject.created_at or None)})
