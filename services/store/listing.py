"""What pages list: jobs in any order by key, running jobs, newest results.

A page never counts and never skips: it starts after the row that the last one ended with, so the thousandth page costs
what the first one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Select, func, select, tuple_
from sqlalchemy.orm import Session

from services.store import labels
from services.store.filters import where
from services.store.jobs import to_job
from services.store.records import Filters, Job, State, TableEntry
from services.store.session import Store, db_now
from services.store.tables import ArtifactRow, BlobRow, JobRow, ResultRow

LOWEST = -1e300  # where a row without a value stands
SORTS: dict[str, ColumnElement[Any]] = {
    "submitted": JobRow.id.expression,
    "method": JobRow.method.expression,
    "subject": JobRow.subject.expression,
    "state": JobRow.state.expression,
    "psnr": func.coalesce(JobRow.psnr, LOWEST),
    "gaussians": func.coalesce(JobRow.gaussians, -1),
    "seconds": func.coalesce(JobRow.finished_at - JobRow.started_at, LOWEST),
}
LINE: tuple[str, ...] = (
    "id",
    "state",
    "method",
    "subject",
    "priority",
    "grid_id",
    "owner",
    "reused_from",
    "attempt",
    "failures",
)
LINE += (
    "max_attempts",
    "rss_bytes",
    "cancel_requested_at",
    "pause_requested_at",
    "error_kind",
    "error",
    "stage",
    "step",
)
LINE += ("steps", "loss", "psnr", "gaussians", "eta_seconds", "created_at", "started_at", "finished_at")
WORDS = (JobRow.spec["preset"].as_string().label("preset"), JobRow.spec["iterations"].as_integer().label("iterations"))


@dataclass(frozen=True)
class Order:
    """How a list is sorted: a key of ``SORTS``, and its direction."""

    key: str = "submitted"
    descending: bool = True


def page(store: Store, filters: Filters, order: Order, after: str | None, limit: int) -> list[Job]:
    """Up to ``limit`` jobs that stand after the job ``after``; ids break ties, so that no row is lost or doubled."""
    with store.read() as session:
        query = _ordered(session, select(JobRow).where(*where(filters)), order, after)
        return [to_job(row) for row in session.scalars(query.limit(limit))]


def lines(store: Store, filters: Filters, order: Order, after: str | None, limit: int) -> list[dict[str, Any]]:
    """``page`` as lists show it: tags, a few columns, and two words of the spec, which else stays in the database."""
    columns = (JobRow.__table__.c[name] for name in LINE)
    with store.read() as session:
        query = _ordered(session, select(*columns, *WORDS).where(*where(filters)), order, after)
        found = session.connection().execute(query.limit(limit))  # plain rows: no objects are made of them
        names = tuple(found.keys())
        rows = [dict(zip(names, row, strict=True)) for row in found]
        tags = labels.tags_of(session, [row["id"] for row in rows])
    return [row | {"tags": tags.get(row["id"], ())} for row in rows]


def _ordered(session: Session, query: Select[Any], order: Order, after: str | None) -> Select[Any]:
    key = SORTS[order.key]
    if after is not None:
        query = query.where(_beyond(session, order, after))
    ends = [key] if key is SORTS["submitted"] else [key, JobRow.id]
    return query.order_by(*(end.desc() if order.descending else end.asc() for end in ends))


def _beyond(session: Session, order: Order, after: str) -> ColumnElement[bool]:
    key = SORTS[order.key]
    if key is SORTS["submitted"]:
        return JobRow.id < after if order.descending else JobRow.id > after
    value = session.scalar(select(key).where(JobRow.id == after))
    here, there = tuple_(key, JobRow.id), tuple_(value, after)
    return here < there if order.descending else here > there


def running(store: Store, limit: int = 12) -> list[Job]:
    """Jobs that run, longest first."""
    query = select(JobRow).where(JobRow.state == State.RUNNING).order_by(JobRow.id).limit(limit)
    with store.read() as session:
        return [to_job(row) for row in session.scalars(query)]


def busy_workers(store: Store) -> int:
    """Workers that hold a lease now."""
    held = (JobRow.state == State.RUNNING) & (JobRow.lease_until > db_now())
    with store.read() as session:
        return int(session.scalar(select(func.count(JobRow.lease_owner.distinct())).where(held)) or 0)


def newest_results(store: Store, limit: int, filters: Filters | None = None) -> list[TableEntry]:
    """The newest succeeded jobs with their results."""
    query = select(JobRow, ResultRow).join(ResultRow, ResultRow.job_id == JobRow.id)
    query = query.where(*where(filters or Filters())).order_by(JobRow.id.desc()).limit(limit)
    with store.read() as session:
        return [_entry(job, result) for job, result in session.execute(query)]


def newest_of_specs(store: Store, limit: int) -> list[TableEntry]:
    """Of the ``limit`` newest results, the newest of every spec: what an overview can afford however many there are."""
    found: dict[str, TableEntry] = {}
    for entry in newest_results(store, limit):
        found.setdefault(entry.job.spec_sha256, entry)
    return list(found.values())


def results_of(store: Store, job_ids: Sequence[str]) -> dict[str, TableEntry]:
    """Results of the jobs among ``job_ids`` that have one."""
    query = select(JobRow, ResultRow).join(ResultRow, ResultRow.job_id == JobRow.id).where(JobRow.id.in_(job_ids))
    with store.read() as session:
        return {job.id: _entry(job, result) for job, result in session.execute(query)}


def _entry(job: JobRow, result: ResultRow) -> TableEntry:
    numbers = (result.train_seconds, result.gaussians)
    return TableEntry(to_job(job), result.means, result.protocol, result.provenance, *numbers)


def names(store: Store) -> dict[str, list[str]]:
    """Methods and subjects that jobs have, for filters; distinct values are read off an index."""
    with store.read() as session:
        return {
            "method": _distinct(session, JobRow.method.expression),
            "subject": _distinct(session, JobRow.subject.expression),
        }


def _distinct(session: Session, column: ColumnElement[str]) -> list[str]:
    """Values of an indexed column one by one: a step of the index each, however many rows there are."""
    found: list[str] = []
    while len(found) < 500:
        query = select(func.min(column))
        value = session.scalar(query.where(column > found[-1]) if found else query)
        if value is None:
            break
        found.append(str(value))
    return found


def stored_bytes(store: Store) -> int:
    """Bytes of all artifacts, each counted once however many jobs have it."""
    with store.read() as session:
        return int(session.scalar(select(func.sum(BlobRow.size))) or 0)


def with_pictures(store: Store, subjects: Sequence[str]) -> dict[str, str]:
    """The newest job of each subject whose pictures are kept."""
    newest = func.max(JobRow.id)
    query = select(JobRow.subject, newest).join(ArtifactRow, ArtifactRow.job_id == JobRow.id)
    query = query.where(ArtifactRow.name == "references", JobRow.subject.in_(subjects)).group_by(JobRow.subject)
    with store.read() as session:
        return {row[0]: row[1] for row in session.execute(query)}
