"""Results that are known: a job of the same spec, data and code as a finished one ends with its result, unrun.

1. At submission, ``adopt`` looks for a finished job of the same content.
2. While one job of a content runs, its twins wait: ``leases.claim`` passes them over.
3. When it succeeds, ``adopt_followers`` ends its waiting twins in the same transaction; if it fails, the next one runs.
4. ``leases.claim`` looks once more, for twins that were submitted in the instant of the success.

A forced job takes part in none of it, but its result may be taken by others. The result's row is copied, and the names
of its files; curves and scores are read from the job that they came from (``reused_from``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sqlalchemy import insert, literal, select, update
from sqlalchemy.orm import Session, aliased

from services.store import events
from services.store.records import State
from services.store.session import db_now
from services.store.tables import ArtifactRow, JobRow, ResultRow

UNSEEN = {"synchronize_session": False}
KEPT = ("psnr", "gaussians", "stage", "step", "steps")  # columns of the newest look that are the result's as well
TWIN = aliased(JobRow)
NO_TWIN_RUNS = JobRow.forced | ~(
    select(TWIN.id)
    .where(TWIN.content_sha256 == JobRow.content_sha256, TWIN.state == State.RUNNING, TWIN.id != JobRow.id)
    .exists()
)


def adopt(session: Session, job: JobRow) -> bool:
    """End the waiting ``job`` with the result of a finished twin, if there is one. True: it has succeeded."""
    if job.content_sha256 is None or job.forced:
        return False
    source = finished(session, job.content_sha256)
    return source is not None and bool(_end(session, [job.id], source))


def finished(session: Session, content_sha256: str) -> JobRow | None:
    """The newest job that found the result of this content itself."""
    same = (JobRow.content_sha256 == content_sha256) & (JobRow.state == State.SUCCEEDED)
    return session.scalar(select(JobRow).where(same, JobRow.reused_from.is_(None)).order_by(JobRow.id.desc()).limit(1))


def adopt_followers(session: Session, job_id: str) -> list[str]:
    """End the waiting twins of a job that has just succeeded; returns their ids."""
    source = session.get_one(JobRow, job_id, populate_existing=True)
    if source.content_sha256 is None:
        return []
    same = (JobRow.content_sha256 == source.content_sha256) & (JobRow.state == State.QUEUED) & ~JobRow.forced
    twins = session.scalars(select(JobRow.id).where(same, JobRow.id != job_id).with_for_update(skip_locked=True)).all()
    return _end(session, twins, source)


def adopt_all(session: Session, job_ids: Iterable[str]) -> list[str]:
    """``adopt`` for many waiting jobs, as a grid submits them; returns the ids of those that have succeeded."""
    ended: list[str] = []
    for job_id in job_ids:
        if adopt(session, session.get_one(JobRow, job_id)):
            ended.append(job_id)
    return ended


def _end(session: Session, job_ids: Iterable[str], source: JobRow) -> list[str]:
    """Compare and set, so that a job which somebody claims meanwhile is left to them."""
    looks = {name: getattr(source, name) for name in KEPT}
    ended = {"state": State.SUCCEEDED, "reused_from": source.id, "eta_seconds": 0.0, "finished_at": db_now()}
    done: list[str] = []
    for job_id in job_ids:
        waits = (JobRow.id == job_id) & (JobRow.state == State.QUEUED)
        change = update(JobRow).where(waits).values(**ended, **looks).returning(JobRow.id)
        if session.scalar(change, execution_options=UNSEEN) is not None:
            _copy(session, source.id, job_id)
            events.append(session, job_id, [events.state_event(State.SUCCEEDED, reused_from=source.id)])
            done.append(job_id)
    return done


def _copy(session: Session, source: str, target: str) -> None:
    """The row of the result and the names of the files."""
    for table in (ResultRow, ArtifactRow):
        columns: list[Any] = [column for column in table.__table__.columns if column.name != "job_id"]
        rows = select(literal(target), *columns).where(table.__table__.c.job_id == source)
        session.execute(insert(table).from_select(["job_id", *(column.name for column in columns)], rows))
