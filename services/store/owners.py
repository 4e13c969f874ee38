"""Owners of jobs: how many of theirs may wait and run, and whose turn it is.

The turn goes to the owner with the fewest running jobs per share, among equals to the one who was served longest ago;
within an owner to the highest priority, then to the oldest job. So a priority orders one's own jobs only, somebody who
submits a thousand jobs delays others by one job at most, and an owner of share 2 gets twice the workers of one of share
1 while both have work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, func, select, text, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, aliased

from services.errors import QuotaError, RequestError
from services.store.records import State
from services.store.session import Store, db_now
from services.store.tables import JobRow, OwnerRow

CLAIM_LOCK = 7_261_003  # any number, the same for all that claim
UNSEEN = {"synchronize_session": False}


@dataclass(frozen=True)
class Owner:
    """What an owner may have; a limit of none is the service's, 0 is no limit."""

    name: str
    max_running: int | None = None
    max_queued: int | None = None
    share: float = 1.0


def put(store: Store, owner: Owner) -> None:
    """Set an owner's limits and share.

    Raises:
        RequestError: if a limit is negative or the share is not above zero.
    """
    for name in ("max_running", "max_queued"):
        if (getattr(owner, name) or 0) < 0:
            raise RequestError(name, "0 or more, or none for the service's", getattr(owner, name))
    if not owner.share > 0:
        raise RequestError("share", "a number above 0", owner.share)
    values = {"max_running": owner.max_running, "max_queued": owner.max_queued, "share": owner.share}
    with store.write() as session:
        ensure(session, owner.name)
        session.execute(update(OwnerRow).where(OwnerRow.name == owner.name).values(**values))


def all_of(store: Store) -> list[Owner]:
    """Every owner by name."""
    with store.read() as session:
        rows = session.scalars(select(OwnerRow).order_by(OwnerRow.name)).all()
        return [Owner(row.name, row.max_running, row.max_queued, row.share) for row in rows]


def ensure(session: Session, name: str) -> None:
    """Know ``name`` from now on."""
    dialect: Any = postgresql if session.get_bind().dialect.name == "postgresql" else sqlite
    values = {"name": name, "share": 1.0, "served_at": 0.0, "created_at": db_now()}
    session.execute(dialect.insert(OwnerRow).values(**values).on_conflict_do_nothing())


@dataclass
class Room:
    """How many jobs of an owner wait, and how many may; 0 is no limit."""

    name: str
    most: int
    waiting: int

    def take(self, jobs: int = 1) -> QuotaError | None:
        """Let ``jobs`` more wait, or refuse."""
        if self.most and self.waiting + jobs > self.most:
            return QuotaError("waiting jobs", f"at most {self.most} of {self.name}", f"{self.waiting} and {jobs} more")
        self.waiting += jobs
        return None


def room(session: Session, store: Store, name: str) -> Room:
    """The room that ``name`` has. Holds the owner's row, so that two submissions count right."""
    ensure(session, name)
    row = session.scalars(select(OwnerRow).where(OwnerRow.name == name).with_for_update()).one()
    most = store.quota.queued if row.max_queued is None else row.max_queued
    if not most:
        return Room(name, 0, 0)
    mine = select(JobRow.id).where(JobRow.owner == name, JobRow.state == State.QUEUED).limit(most).subquery()
    return Room(name, most, session.scalar(select(func.count()).select_from(mine)) or 0)


def by_turn(session: Session) -> Sequence[str]:
    """Owners with waiting jobs, whose turn it is first. One index look-up for each, however many jobs wait.

    Claims come one after the other, as they do on SQLite: each sees what the one before has changed.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("select pg_advisory_xact_lock(:key)"), {"key": CLAIM_LOCK})
    least = select(func.min(JobRow.owner).label("name")).where(JobRow.state == State.QUEUED)
    first = least.cte("waiting", recursive=True)
    after = aliased(first)
    later = select(func.min(JobRow.owner)).where(JobRow.state == State.QUEUED, JobRow.owner > after.c.name)
    waiting = first.union_all(select(later.scalar_subquery()).select_from(after).where(after.c.name.is_not(None)))
    running = _running(waiting.c.name)
    turn = (running / func.coalesce(OwnerRow.share, 1.0), func.coalesce(OwnerRow.served_at, 0.0), waiting.c.name)
    known = waiting.outerjoin(OwnerRow, OwnerRow.name == waiting.c.name)
    query = select(waiting.c.name).select_from(known).where(waiting.c.name.is_not(None))
    return session.scalars(query.order_by(*turn)).all()


def note_served(session: Session, name: str) -> None:
    """A job of ``name`` has been claimed: among equals, the others come first now."""
    served = update(OwnerRow).where(OwnerRow.name == name).values(served_at=db_now())
    session.execute(served, execution_options=UNSEEN)


def may_run(session: Session, store: Store, name: str) -> bool:
    """Whether one more job of ``name`` may run."""
    ensure(session, name)
    own = session.scalar(select(OwnerRow.max_running).where(OwnerRow.name == name))
    most = store.quota.running if own is None else own
    if not most:
        return True
    mine = select(func.count()).where(JobRow.state == State.RUNNING, JobRow.owner == name)
    return (session.scalar(mine) or 0) < most


def _running(owner: ColumnElement[str]) -> ColumnElement[int]:
    return (
        select(func.count())
        .select_from(JobRow)
        .where(JobRow.state == State.RUNNING, JobRow.owner == owner)
        .scalar_subquery()
    )
