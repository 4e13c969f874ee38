"""How jobs come in: many submissions in one transaction, each with its own answer.

A handful of statements does it, however many jobs there are, so that twenty clients that submit at once wait for one
commit and a grid of a thousand jobs is one request.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, cast

from sqlalchemy import Table, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from services.errors import RequestError, ServiceError
from services.store import events, owners, reuse
from services.store.ids import new_id
from services.store.records import Job, State, Submission
from services.store.session import Store, db_now
from services.store.tables import JobRow

FIELDS = tuple(f.name for f in fields(Job))
FRESH: Mapping[str, Any] = {
    "state": State.QUEUED,
    "attempt": 0,
    "failures": 0,
    "not_before": 0.0,
    "step": 0,
    "steps": 0,
}
INSERT = insert(cast(Table, JobRow.__table__))  # built once
ABSENT: Mapping[str, Any] = dict.fromkeys(FIELDS)

Accepted = tuple[Job, bool]


def to_job(row: JobRow) -> Job:
    """The record of a row."""
    return Job(**{name: getattr(row, name) for name in FIELDS})


def submit(store: Store, submission: Submission) -> Accepted:
    """Accept a job; the second value says whether it is new. After the return the job cannot be lost.

    Where a finished job has the same content, the new one has succeeded already, with its result.

    Raises:
        RequestError: if the idempotency key was used for another request.
        QuotaError: if as many jobs of the owner wait as may.
    """
    outcome = submit_many(store, [submission])[0]
    if isinstance(outcome, ServiceError):
        raise outcome
    return outcome


def submit_many(store: Store, submissions: Sequence[Submission]) -> list[Accepted | ServiceError]:
    """``submit`` for many, in their order; the refusal of one is its outcome and does not concern the others."""
    try:
        return _submit_many(store, submissions)
    except IntegrityError:  # another process took a key between our look and our insert; now we see its job
        return _submit_many(store, submissions)


def _submit_many(store: Store, submissions: Sequence[Submission]) -> list[Accepted | ServiceError]:
    with store.write() as session:
        known = _known(session, submissions)
        rooms = {name: owners.room(session, store, name) for name in sorted({s.owner for s in submissions})}
        now = session.scalar(select(db_now())) or 0.0
        outcomes: list[Accepted | ServiceError] = []
        rows: list[dict[str, Any]] = []
        for submission in submissions:
            key = (submission.owner, submission.idempotency_key)
            earlier = known.get(key) if submission.idempotency_key is not None else None
            if earlier is not None:
                outcomes.append(_again(earlier, submission))
            elif (refusal := rooms[submission.owner].take()) is not None:
                outcomes.append(refusal)
            else:
                rows.append(row_of(submission, now))
                known[key] = Job(**{**ABSENT, **rows[-1]})
                outcomes.append((known[key], True))
        ended = add(session, rows)
        changed = {job_id: to_job(session.get_one(JobRow, job_id, populate_existing=True)) for job_id in ended}
        return [o if isinstance(o, ServiceError) else (changed.get(o[0].id, o[0]), o[1]) for o in outcomes]


def _known(session: Session, submissions: Iterable[Submission]) -> dict[tuple[str, str | None], Job]:
    """Jobs that the keys have made already."""
    keys = {s.idempotency_key for s in submissions} - {None}
    if not keys:
        return {}
    rows = session.scalars(select(JobRow).where(JobRow.idempotency_key.in_(keys)))
    return {(row.owner, row.idempotency_key): to_job(row) for row in rows}


def _again(earlier: Job, submission: Submission) -> Accepted | ServiceError:
    if earlier.request_sha256 == submission.request_sha256:
        return earlier, False
    return RequestError("Idempotency-Key", "the request it was first used for", "another request")


def row_of(submission: Submission, now: float) -> dict[str, Any]:
    """Columns of a new job."""
    spec = dict(submission.spec)
    named = {name: spec[name] for name in ("method", "subject", "priority")}
    return {"id": new_id(), "created_at": now, **FRESH, **vars(submission), "spec": spec, **named}


def add(session: Session, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Insert jobs with their first events; returns the ids of those whose result is known: they have ended with it."""
    if not rows:
        return []
    session.execute(INSERT, list(rows))
    told = events.state_event(State.QUEUED)
    about = {"kind": told.kind, "payload": dict(told.payload)}
    session.execute(events.APPEND, [{"job_id": row["id"], **about} for row in rows])
    return reuse.adopt_all(session, _with_known_result(session, rows))


def _with_known_result(session: Session, rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Jobs among ``rows`` whose result some finished job has."""
    contents = {row["content_sha256"]: row["id"] for row in rows if not row["forced"]}
    contents.pop(None, None)
    if not contents:
        return []
    same = JobRow.content_sha256.in_(contents) & (JobRow.state == State.SUCCEEDED) & JobRow.reused_from.is_(None)
    found = set(session.scalars(select(JobRow.content_sha256).where(same)))
    return [row["id"] for row in rows if row["content_sha256"] in found and not row["forced"]]
