"""The tables. Instants are seconds since 1970 as double precision, always taken from the database's clock."""

from __future__ import annotations

from typing import Any

from sqlalchemy import BigInteger, ForeignKey, Index, String, Text, UniqueConstraint, false
from sqlalchemy.orm import Mapped, mapped_column

from services.store.base import LOCAL, Base, RowId
from services.store.tables_access import AuditRow, BenchmarkRow, OwnerRow, TokenRow

# fmt: off
__all__ = [  # all tables are found here
    "LOCAL", "ArtifactRow", "AuditRow", "Base", "BenchmarkRow", "BlobRow", "CheckpointRow", "EventRow", "GridRow",
    "JobRow", "OwnerRow", "PointRow", "ResultRow", "SchedulerRow", "ScoreRow", "SubjectRow", "TagRow",
    "TokenRow",
]
# fmt: on


class JobRow(Base):
    """A job. ``attempt`` is the fencing token: it rises with every claim, and every write of a worker names it."""

    __tablename__ = "jobs"
    __table_args__ = (
        Index("ix_jobs_queue", "state", "owner", "priority", "id"),
        Index("ix_jobs_state_id", "state", "id"),
        Index("ix_jobs_method_id", "method", "id"),
        Index("ix_jobs_subject_id", "subject", "id"),
        Index("ix_jobs_grid_id_id", "grid_id", "id"),
        Index("ix_jobs_owner_id", "owner", "id"),
        Index("ix_jobs_spec_sha256", "spec_sha256"),
        Index("ix_jobs_content_sha256", "content_sha256"),
        Index("ix_jobs_lease_until", "lease_until"),
        UniqueConstraint("owner", "idempotency_key"),
    )

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    spec: Mapped[dict[str, Any]]
    spec_sha256: Mapped[str] = mapped_column(String(64))
    method: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(128))
    priority: Mapped[int]
    grid_id: Mapped[str | None] = mapped_column(String(36))
    owner: Mapped[str] = mapped_column(String(64), default=LOCAL, server_default=LOCAL)
    notes: Mapped[str] = mapped_column(Text, default="", server_default="")
    idempotency_key: Mapped[str | None] = mapped_column(String(255))
    request_sha256: Mapped[str] = mapped_column(String(64))
    content_sha256: Mapped[str | None] = mapped_column(String(64))  # of spec, data and code
    forced: Mapped[bool] = mapped_column(default=False, server_default=false())  # run although its result is known
    reused_from: Mapped[str | None] = mapped_column(String(36))

    state: Mapped[str] = mapped_column(String(16))
    attempt: Mapped[int] = mapped_column(default=0)
    failures: Mapped[int] = mapped_column(default=0)
    max_attempts: Mapped[int]
    lease_owner: Mapped[str | None] = mapped_column(String(255))
    lease_until: Mapped[float | None]
    not_before: Mapped[float] = mapped_column(default=0.0)
    cancel_requested_at: Mapped[float | None]
    pause_requested_at: Mapped[float | None]
    error_kind: Mapped[str | None] = mapped_column(String(32))
    error: Mapped[str | None] = mapped_column(Text)
    first_traceback: Mapped[str | None] = mapped_column(Text)

    stage: Mapped[str | None] = mapped_column(String(32))
    step: Mapped[int] = mapped_column(default=0)
    steps: Mapped[int] = mapped_column(default=0)
    loss: Mapped[float | None]
    psnr: Mapped[float | None]
    gaussians: Mapped[int | None]
    eta_seconds: Mapped[float | None]
    rss_bytes: Mapped[int | None] = mapped_column(BigInteger)

    created_at: Mapped[float]
    started_at: Mapped[float | None]
    finished_at: Mapped[float | None]


class ResultRow(Base):
    """What a succeeded job found; one row per job, written in the transaction that ends it."""

    __tablename__ = "results"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    means: Mapped[dict[str, Any]]
    per_camera: Mapped[dict[str, Any]]
    protocol: Mapped[dict[str, Any]]
    provenance: Mapped[dict[str, Any]]
    psnr: Mapped[float | None]
    ssim: Mapped[float | None]
    flip: Mapped[float | None]
    lpips: Mapped[float | None]
    joint_mm: Mapped[float | None]
    sub_frame_joint_mm: Mapped[float | None]
    train_seconds: Mapped[float]
    evaluate_seconds: Mapped[float]
    gaussians: Mapped[int]
    attempt: Mapped[int]
    created_at: Mapped[float]


class ScoreRow(Base):
    """One metric of one held-out image."""

    __tablename__ = "scores"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    camera: Mapped[str] = mapped_column(String(64), primary_key=True)
    frame: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    metric: Mapped[str] = mapped_column(String(32), primary_key=True)
    value: Mapped[float | None]


class PointRow(Base):
    """One point of a training curve; a repeated step replaces the value, so that a resumed job leaves no doubles."""

    __tablename__ = "points"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    step: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    value: Mapped[float]


class ArtifactRow(Base):
    """A file of a job, by name; its bytes lie under their hash."""

    __tablename__ = "artifacts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64), index=True)
    mime: Mapped[str] = mapped_column(String(64))
    size: Mapped[int] = mapped_column(BigInteger)
    created_at: Mapped[float]


class EventRow(Base):
    """What happened, in order; ``id`` is what a stream resumes from."""

    __tablename__ = "events"
    __table_args__ = (Index("ix_events_job_id_id", "job_id", "id"), {"sqlite_autoincrement": True})

    id: Mapped[int] = mapped_column(RowId, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(32))
    payload: Mapped[dict[str, Any]]
    created_at: Mapped[float]


class SubjectRow(Base):
    """A registered subject; ``path`` is none for a subject that the core makes itself."""

    __tablename__ = "subjects"

    name: Mapped[str] = mapped_column(String(128), primary_key=True)
    path: Mapped[str | None] = mapped_column(Text)
    kind: Mapped[str] = mapped_column(String(32))
    info: Mapped[dict[str, Any]]
    owner: Mapped[str] = mapped_column(String(64), default=LOCAL, server_default=LOCAL)
    state: Mapped[str] = mapped_column(String(16), default="ready", server_default="ready")  # checking, ready, refused
    size: Mapped[int | None] = mapped_column(BigInteger)
    stat_sha256: Mapped[str | None] = mapped_column(String(64))  # of names, sizes and times: is the next one fresh?
    content_sha256: Mapped[str | None] = mapped_column(String(64))  # of names and bytes
    created_at: Mapped[float]


class SchedulerRow(Base):
    """A lease on a duty that one process at a time has: the sweep."""

    __tablename__ = "scheduler_leases"

    name: Mapped[str] = mapped_column(String(32), primary_key=True)
    owner: Mapped[str] = mapped_column(String(255))
    until: Mapped[float]


class CheckpointRow(Base):
    """A verified checkpoint of a job; its bytes lie under their hash, so that any worker can go on from it."""

    __tablename__ = "checkpoints"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    step: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    attempt: Mapped[int]
    sha256: Mapped[str] = mapped_column(String(64), index=True)
    size: Mapped[int] = mapped_column(BigInteger)
    created_at: Mapped[float]


class BlobRow(Base):
    """Stored bytes. The row is written before the bytes and removed with them, so collection cannot race a writer."""

    __tablename__ = "blobs"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    size: Mapped[int] = mapped_column(BigInteger)
    created_at: Mapped[float]
    used_at: Mapped[float] = mapped_column(index=True)


class GridRow(Base):
    """Many jobs of one request: ``base`` varied along ``axes``, with ``includes`` and without ``excludes``."""

    __tablename__ = "grids"
    __table_args__ = (Index("ix_grids_owner_id", "owner", "id"),)

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    name: Mapped[str] = mapped_column(String(128))
    base: Mapped[dict[str, Any]]
    axes: Mapped[dict[str, Any]]
    includes: Mapped[list[Any]]
    excludes: Mapped[list[Any]]
    owner: Mapped[str] = mapped_column(String(64), default=LOCAL)
    notes: Mapped[str] = mapped_column(Text, default="")
    created_at: Mapped[float]


class TagRow(Base):
    """A word on a job."""

    __tablename__ = "job_tags"
    __table_args__ = (Index("ix_job_tags_tag_job_id", "tag", "job_id"),)

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    tag: Mapped[str] = mapped_column(String(64), primary_key=True)
