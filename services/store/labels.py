"""What people write on jobs: notes, tags, another priority. None of it changes a result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.orm import Session

from services.errors import NotFoundError
from services.store.jobs import get
from services.store.records import TERMINAL, Job
from services.store.session import Store
from services.store.tables import JobRow, TagRow

TAGS = TagRow.__table__
UNSEEN = {"synchronize_session": False}


@dataclass(frozen=True)
class Change:
    """What to write; None leaves a label as it is."""

    notes: str | None = None
    tags: Sequence[str] | None = None
    priority: int | None = None


def change(store: Store, job_id: str, wanted: Change) -> Job:
    """Write labels of a job. The priority of one that has ended stays: it says how the job ran.

    Raises:
        NotFoundError: if there is no such job.
    """
    with store.write() as session:
        state = session.scalar(select(JobRow.state).where(JobRow.id == job_id))
        if state is None:
            raise NotFoundError("job", "the id of a job", job_id)
        values = {"notes": wanted.notes, "priority": None if state in TERMINAL else wanted.priority}
        known = {name: value for name, value in values.items() if value is not None}
        if known:
            session.execute(update(JobRow).where(JobRow.id == job_id).values(**known), execution_options=UNSEEN)
        if wanted.tags is not None:
            session.execute(delete(TagRow).where(TagRow.job_id == job_id))
            rows = [{"job_id": job_id, "tag": tag} for tag in sorted(set(wanted.tags))]
            if rows:
                session.execute(insert(TagRow), rows)
    return get(store, job_id)


def tags_of(session: Session, job_ids: Iterable[str]) -> dict[str, list[str]]:
    """Tags of every job that has some, in alphabetical order."""
    query = select(TAGS.c.job_id, TAGS.c.tag).where(TAGS.c.job_id.in_(list(job_ids))).order_by(TAGS.c.tag)
    found: dict[str, list[str]] = {}
    for job_id, tag in session.connection().execute(query):
        found.setdefault(job_id, []).append(tag)
    return found


def tags_of_job(store: Store, job_id: str) -> Sequence[str]:
    """Tags of one job, in alphabetical order."""
    with store.read() as session:
        return tags_of(session, [job_id]).get(job_id, ())


def all_tags(store: Store, limit: int = 500) -> dict[str, int]:
    """Every tag and on how many jobs it is, the commonest first."""
    count = func.count()
    query = select(TagRow.tag, count).group_by(TagRow.tag).order_by(count.desc(), TagRow.tag).limit(limit)
    with store.read() as session:
        return {row[0]: row[1] for row in session.execute(query)}
