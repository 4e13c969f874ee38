"""Numbers of jobs: curves while they train, results and scores when they end, entries of tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from sqlalchemy import Executable, func, insert, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from services.errors import ConflictError
from services.store import curves as thinned
from services.store.filters import where
from services.store.jobs import get, to_job
from services.store.records import Claim, Filters, Outcome, Point, Score, State, TableEntry
from services.store.session import Store, db_now
from services.store.tables import JobRow, PointRow, ResultRow, ScoreRow

DENORMALISED = ("psnr", "ssim", "flip", "lpips", "joint_mm", "sub_frame_joint_mm")


def put_points(session: Session, job_id: str, points: Sequence[Point]) -> None:
    """Insert or replace points inside the caller's transaction."""
    if not points:
        return
    rows = [{"job_id": job_id, "key": p.key, "step": p.step, "value": p.value} for p in points]
    session.execute(_replace_points(session.get_bind().dialect.name), rows)


@cache
def _replace_points(name: str) -> Executable:
    """Built once: every heartbeat says it."""
    dialect: Any = postgresql if name == "postgresql" else sqlite
    statement = dialect.insert(PointRow.__table__)
    key = ["job_id", "key", "step"]
    replace: Executable = statement.on_conflict_do_update(index_elements=key, set_={"value": statement.excluded.value})
    return replace


def put_outcome(session: Session, claim: Claim, outcome: Outcome) -> None:
    """Insert a result and its scores inside the transaction that ends the job."""
    known = {name: outcome.means.get(name) for name in DENORMALISED}
    row = ResultRow(
        job_id=claim.job_id,
        attempt=claim.attempt,
        means=dict(outcome.means),
        per_camera=dict(outcome.per_camera),
        protocol=dict(outcome.protocol),
        provenance=dict(outcome.provenance),
        gaussians=outcome.gaussians,
        train_seconds=outcome.train_seconds,
        evaluate_seconds=outcome.evaluate_seconds,
        created_at=session.scalar(select(db_now())),
        **known,
    )
    session.add(row)
    session.flush()
    scores = [
        {"job_id": claim.job_id, "camera": s.camera, "frame": s.frame, "metric": s.metric, "value": s.value}
        for s in outcome.scores
    ]
    if scores:
        session.execute(insert(ScoreRow), scores)


def curves(store: Store, job_id: str) -> dict[str, list[tuple[int, float]]]:
    """Curves of a job by key, thinned so that every spike stays (``services.store.curves``).

    Raises:
        NotFoundError: if there is no such job.
    """
    return thinned.of_jobs(store, [job_id])[job_id]


def outcome_of(store: Store, job_id: str) -> Outcome:
    """The result of a succeeded job with its scores; artifacts are read by ``artifacts.of_job``.

    Raises:
        NotFoundError: if there is no such job.
        ConflictError: if the job has no result.
    """
    with store.read() as session:
        row = session.get(ResultRow, job_id)
        if row is None:
            raise ConflictError("state", "a succeeded job", get(store, job_id).state)
        order = (ScoreRow.camera, ScoreRow.frame, ScoreRow.metric)
        source = session.scalar(select(func.coalesce(JobRow.reused_from, JobRow.id)).where(JobRow.id == job_id))
        rows = session.scalars(select(ScoreRow).where(ScoreRow.job_id == source).order_by(*order))
        scores = tuple(Score(s.camera, s.frame, s.metric, s.value) for s in rows)
        numbers = (row.gaussians, row.train_seconds, row.evaluate_seconds)
        return Outcome(row.means, row.per_camera, row.protocol, row.provenance, *numbers, scores)


def table_entries(store: Store, preset: str | None = None, filters: Filters | None = None) -> list[TableEntry]:
    """The newest succeeded job of every spec, in the order of method, subject, seed and id; a reused result once.

    ``preset`` is short for filters that name nothing else.

    Raises:
        RequestError: if the query of ``filters`` cannot be understood, saying where.
    """
    chosen = (JobRow.state == State.SUCCEEDED, *where(filters or Filters(preset=preset)))
    newest = select(func.max(JobRow.id)).where(*chosen).group_by(JobRow.spec_sha256)
    query = select(JobRow, ResultRow).join(ResultRow, ResultRow.job_id == JobRow.id).where(JobRow.id.in_(newest))
    with store.read() as session:
        entries = [
            TableEntry(to_job(job), r.means, r.protocol, r.provenance, r.train_seconds, r.gaussians, r.evaluate_seconds)
            for job, r in session.execute(query)
        ]
    return sorted(entries, key=lambda e: (e.job.method, e.job.subject, e.job.spec.get("seed", 0), e.job.id))
