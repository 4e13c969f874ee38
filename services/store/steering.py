"""Verbs on all jobs of a grid at once: each is moved as its own verb would move it, in one transaction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, func, insert, select, update
from sqlalchemy.orm import Session

from services.errors import NotFoundError
from services.store.jobs import NO_ORDERS
from services.store.records import RETRYABLE, State
from services.store.session import Store, db_now
from services.store.tables import EventRow, GridRow, JobRow

UNSEEN = {"synchronize_session": False}
FRESH: dict[str, Any] = {"failures": 0, "not_before": 0.0, "error": None, "error_kind": None, "finished_at": None}


def cancel(store: Store, grid_id: str) -> list[str]:
    """Cancel what waits or pauses, ask what runs; returns the ids of the jobs that it reached.

    Raises:
        NotFoundError: if there is no such grid.
    """
    with store.write() as session:
        mine = _of(session, grid_id)
        waiting = mine & JobRow.state.in_((State.QUEUED, State.PAUSED))
        ended = _move(session, waiting, State.CANCELLED, {"finished_at": db_now()})
        running = mine & (JobRow.state == State.RUNNING) & JobRow.cancel_requested_at.is_(None)
        return ended + _change(session, running, {"cancel_requested_at": db_now()})


def retry(store: Store, grid_id: str) -> list[str]:
    """Put what failed, died or was cancelled back into the queue; returns the ids of the jobs that wait again.

    Raises:
        NotFoundError: if there is no such grid.
    """
    with store.write() as session:
        ended = _of(session, grid_id) & JobRow.state.in_(RETRYABLE)
        return _move(session, ended, State.QUEUED, FRESH | NO_ORDERS)


def pause(store: Store, grid_id: str) -> list[str]:
    """Pause what waits, ask what runs; returns the ids of the jobs that it reached.

    Raises:
        NotFoundError: if there is no such grid.
    """
    with store.write() as session:
        mine = _of(session, grid_id)
        paused = _move(session, mine & (JobRow.state == State.QUEUED), State.PAUSED, {})
        running = mine & (JobRow.state == State.RUNNING) & JobRow.pause_requested_at.is_(None)
        return paused + _change(session, running, {"pause_requested_at": db_now()})


def resume(store: Store, grid_id: str) -> list[str]:
    """Put what pauses back into the queue; returns the ids of the jobs that wait again.

    Raises:
        NotFoundError: if there is no such grid.
    """
    with store.write() as session:
        paused = _of(session, grid_id) & (JobRow.state == State.PAUSED)
        return _move(session, paused, State.QUEUED, {"not_before": 0.0, **NO_ORDERS})


def _of(session: Session, grid_id: str) -> ColumnElement[bool]:
    if not session.scalar(select(func.count()).where(GridRow.id == grid_id)):
        raise NotFoundError("grid", "the id of a grid", grid_id)
    return JobRow.grid_id == grid_id


def _move(session: Session, which: ColumnElement[bool], state: State, values: Mapping[str, Any]) -> list[str]:
    moved = _change(session, which, {"state": state, **values})
    if moved:
        told = {"kind": "state", "payload": {"state": str(state)}, "created_at": session.scalar(select(db_now()))}
        session.execute(insert(EventRow), [{"job_id": job_id, **told} for job_id in moved])
    return moved


def _change(session: Session, which: ColumnElement[bool], values: Mapping[str, Any]) -> list[str]:
    change = update(JobRow).where(which).values(**values).returning(JobRow.id)
    return sorted(session.scalars(change, execution_options=UNSEEN))
