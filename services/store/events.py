"""Events: appended inside somebody's transaction, read in order of their ids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from sqlalchemy import Table, func, insert, select
from sqlalchemy.orm import Session

from services.store.records import Event
from services.store.session import Store, db_now
from services.store.tables import EventRow

PAGE = 500
APPEND = insert(cast(Table, EventRow.__table__)).values(created_at=db_now())  # built once: every heartbeat says it


def append(session: Session, job_id: str, events: Sequence[Event]) -> None:
    """Add ``events`` to a job inside the caller's transaction."""
    if events:
        session.execute(APPEND, [{"job_id": job_id, "kind": e.kind, "payload": dict(e.payload)} for e in events])


def state_event(state: str, **details: object) -> Event:
    """The event that says a job's new state and why."""
    return Event("state", {"state": str(state), **details})


def after(store: Store, last_id: int, job_id: str | None = None, limit: int = PAGE) -> list[Event]:
    """Events with ids above ``last_id``, of one job or of all, oldest first."""
    query = select(EventRow).where(EventRow.id > last_id).order_by(EventRow.id).limit(limit)
    if job_id is not None:
        query = query.where(EventRow.job_id == job_id)
    with store.read() as session:
        return [Event(r.kind, r.payload, r.job_id, r.id, r.created_at) for r in session.scalars(query)]


def newest_id(store: Store) -> int:
    """Id of the newest event; 0 when there is none."""
    with store.read() as session:
        return int(session.scalar(select(func.max(EventRow.id))) or 0)
