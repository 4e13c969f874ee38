"""Jobs as users see them: submitted, listed, cancelled, paused, resumed, retried."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, func, select, update
from sqlalchemy.orm import Session

from services.errors import ConflictError, NotFoundError
from services.store import events
from services.store.filters import where
from services.store.intake import submit, to_job
from services.store.records import RETRYABLE, Filters, Job, State
from services.store.session import Store, db_now
from services.store.tables import JobRow

__all__ = ["cancel", "count_by_state", "get", "oldest_wait", "page", "pause", "resume", "retry", "submit", "to_job"]
NO_ORDERS = {"cancel_requested_at": None, "pause_requested_at": None}


def get(store: Store, job_id: str) -> Job:
    """One job.

    Raises:
        NotFoundError: if there is none with this id.
    """
    with store.read() as session:
        return to_job(_row(session, job_id))


def _row(session: Session, job_id: str) -> JobRow:
    row = session.get(JobRow, job_id)
    if row is None:
        raise NotFoundError("job", "the id of a job", job_id)
    return row


def page(store: Store, filters: Filters, before: str | None, limit: int) -> list[Job]:
    """Up to ``limit`` jobs older than the id ``before``, newest first.

    Raises:
        RequestError: if the query of ``filters`` cannot be understood, saying where.
    """
    query = select(JobRow).where(*where(filters)).order_by(JobRow.id.desc()).limit(limit)
    if before is not None:
        query = query.where(JobRow.id < before)
    with store.read() as session:
        return [to_job(row) for row in session.scalars(query)]


def count_by_state(store: Store) -> dict[str, int]:
    """Number of jobs in every state, zeros included."""
    with store.read() as session:
        rows = session.execute(select(JobRow.state, func.count()).group_by(JobRow.state))
        found = {row[0]: row[1] for row in rows}
    return {str(state): found.get(state, 0) for state in State}


def oldest_wait(store: Store) -> float:
    """Seconds that the oldest job which could run has waited; 0 when none waits."""
    due = (JobRow.state == State.QUEUED) & (JobRow.not_before <= db_now())
    with store.read() as session:
        return float(session.scalar(select(db_now() - func.min(JobRow.created_at)).where(due)) or 0.0)


def cancel(store: Store, job_id: str) -> Job:
    """Cancel: at once if the job waits or pauses, else ask the worker, which leaves a checkpoint.

    Raises:
        NotFoundError: if there is no such job.
        ConflictError: if the job has ended otherwise.
    """
    with store.write() as session:
        row = _row(session, job_id)
        if row.state in {State.QUEUED, State.PAUSED}:
            _move(session, row, State.CANCELLED, {"finished_at": db_now()})
        elif row.state == State.RUNNING and row.cancel_requested_at is None:
            _change(session, row, {"cancel_requested_at": db_now()})
        elif row.state not in {State.RUNNING, State.CANCELLED}:
            raise ConflictError("state", "a job that waits, runs or pauses", row.state)
        return to_job(row)


def pause(store: Store, job_id: str) -> Job:
    """Pause: at once if the job waits, else ask the worker, which leaves a checkpoint.

    Raises:
        NotFoundError: if there is no such job.
        ConflictError: if the job has ended.
    """
    with store.write() as session:
        row = _row(session, job_id)
        if row.state == State.QUEUED:
            _move(session, row, State.PAUSED, {})
        elif row.state == State.RUNNING and row.pause_requested_at is None:
            _change(session, row, {"pause_requested_at": db_now()})
        elif row.state not in {State.RUNNING, State.PAUSED}:
            raise ConflictError("state", "a job that waits or runs", row.state)
        return to_job(row)


def resume(store: Store, job_id: str) -> Job:
    """Put a paused job back into the queue; it goes on from its checkpoint.

    Raises:
        NotFoundError: if there is no such job.
        ConflictError: if the job is not paused.
    """
    with store.write() as session:
        row = _row(session, job_id)
        if row.state != State.PAUSED:
            raise ConflictError("state", "a paused job", row.state)
        _move(session, row, State.QUEUED, {"not_before": 0.0, **NO_ORDERS})
        return to_job(row)


def retry(store: Store, job_id: str) -> Job:
    """Put a job that failed, died or was cancelled back into the queue with a fresh count of failures.

    Raises:
        NotFoundError: if there is no such job.
        ConflictError: if the job has not ended, or has succeeded.
    """
    fresh = {"failures": 0, "not_before": 0.0, "finished_at": None}
    fresh |= dict.fromkeys(("error", "error_kind", "first_traceback"))
    with store.write() as session:
        row = _row(session, job_id)
        if row.state not in RETRYABLE:
            raise ConflictError("state", f"one of {', '.join(sorted(RETRYABLE))}", row.state)
        _move(session, row, State.QUEUED, fresh | NO_ORDERS)
        return to_job(row)


def _move(session: Session, row: JobRow, state: State, values: Mapping[str, Any]) -> None:
    _change(session, row, {"state": state, **values})
    events.append(session, row.id, [events.state_event(state)])


def _change(session: Session, row: JobRow, values: Mapping[str, Any]) -> None:
    """Compare and set: on a database with row versions, another transaction may have moved the job since."""
    unchanged: ColumnElement[bool] = (JobRow.id == row.id) & (JobRow.state == row.state)
    change = update(JobRow).where(unchanged).values(**values).returning(JobRow.id)
    if session.scalar(change, execution_options={"synchronize_session": False}) is None:
        raise ConflictError("state", f"{row.state}, as read a moment ago", "another one")
    session.refresh(row)
