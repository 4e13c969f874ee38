"""Subjects that jobs may name. ``studio`` and ``studio-N`` always exist: the core makes them itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from rsavatar.catalog import STUDIO_NAME
from services.errors import ConflictError, NotFoundError
from services.store.records import TERMINAL
from services.store.session import Store, db_now
from services.store.subject_records import Subject, SubjectState
from services.store.tables import JobRow, SubjectRow

STUDIO = Subject("studio", None, "built-in", {"description": "synthetic subject with true motion, made on first use"})


def all_of(store: Store) -> list[Subject]:
    """All subjects by name, the built-in one first."""
    with store.read() as session:
        return [STUDIO, *(_subject(row) for row in session.scalars(select(SubjectRow).order_by(SubjectRow.name)))]


def get(store: Store, name: str) -> Subject:
    """One subject that jobs may name.

    Raises:
        NotFoundError: if it is not registered; the message lists those that are.
        ConflictError: if it is not ready.
    """
    subject = look(store, name)
    if subject.state != SubjectState.READY:
        raise ConflictError(f"subject {name}", "one that is ready", subject.state)
    return subject


def look(store: Store, name: str) -> Subject:
    """One subject in whatever state.

    Raises:
        NotFoundError: if it is not registered; the message lists those that are.
    """
    if name == STUDIO.name:
        return STUDIO
    with store.read() as session:
        row = session.get(SubjectRow, name)
        if row is not None:
            return _subject(row)
    if re.fullmatch(STUDIO_NAME, name):
        return Subject(name, STUDIO.path, STUDIO.kind, STUDIO.info)
    raise NotFoundError("subject", f"one of {', '.join(s.name for s in all_of(store))}", repr(name))


def add(store: Store, subject: Subject) -> tuple[Subject, bool]:
    """Register a subject; the second value says whether it is new. The same name and path again change nothing.

    Raises:
        ConflictError: if the name belongs to another directory.
    """
    try:
        with store.write() as session:
            row = session.get(SubjectRow, subject.name)
            if row is None and subject.name != STUDIO.name:
                created = session.scalar(select(db_now())) or 0.0
                about = {key: getattr(subject, key) for key in ("path", "kind", "owner", "state", "size")}
                row = SubjectRow(name=subject.name, created_at=created, info=dict(subject.info), **about)
                session.add(row)
                session.flush()
                return _subject(row), True
    except IntegrityError:  # another request registered the name since our look
        pass
    known = look(store, subject.name)
    if known.path != subject.path:
        raise ConflictError("subject", f"{subject.name} at {known.path}", subject.path)
    return known, False


def remove(store: Store, name: str) -> Subject:
    """Forget a subject. Its files are the caller's to remove.

    Raises:
        NotFoundError: if it is not registered.
        ConflictError: if it is built in, being checked, or a job that has not ended names it.
    """
    if name == STUDIO.name:
        raise ConflictError("subject", "one that was added", "the built-in one")
    with store.write() as session:
        row = _row(session, name)
        if row.state == SubjectState.CHECKING:
            raise ConflictError(f"subject {name}", "one that nobody looks at", row.state)
        open_jobs = select(JobRow.id).where(JobRow.subject == name, JobRow.state.not_in(TERMINAL)).limit(1)
        if (job := session.scalar(open_jobs)) is not None:
            raise ConflictError(f"subject {name}", "one that no open job names", f"one that job {job} names")
        subject = _subject(row)
        session.delete(row)
        return subject


def claim_check(store: Store, owner: str, seconds: float, is_dead: Callable[[str], bool]) -> Subject | None:
    """Take an uploaded subject, or one whose examiner ``is_dead`` or silent, for ``seconds``; None if there is none."""
    waiting = (SubjectState.UPLOADED, SubjectState.CHECKING)
    query = select(SubjectRow).where(SubjectRow.state.in_(waiting)).order_by(SubjectRow.created_at)
    with store.read() as session:
        if session.scalar(query.limit(1)) is None:
            return None  # looked at often, and nearly always so
    with store.write() as session:
        now = session.scalar(select(db_now())) or 0.0
        for row in session.scalars(query.with_for_update(skip_locked=True)):
            examiner = row.info.get("examiner") or {"owner": "", "until": 0.0}
            if row.state == SubjectState.CHECKING and examiner["until"] > now and not is_dead(examiner["owner"]):
                continue
            row.state = SubjectState.CHECKING
            row.info = {**row.info, "examiner": {"owner": owner, "until": now + seconds}}
            session.flush()
            return _subject(row)
    return None


def finish_check(store: Store, name: str, owner: str, state: SubjectState, report: Sequence[Mapping[str, str]]) -> bool:
    """Write what ``owner`` has found; False, and nothing is written, if the subject was given away or is gone."""
    with store.write() as session:
        row = session.get(SubjectRow, name, with_for_update=True)
        if row is None or row.state != SubjectState.CHECKING or row.info.get("examiner", {}).get("owner") != owner:
            return False
        row.state = state
        kept = {key: value for key, value in row.info.items() if key != "examiner"}
        row.info = {**kept, "report": [dict(finding) for finding in report]} if report else kept
        return True


def _row(session: Session, name: str) -> SubjectRow:
    row = session.get(SubjectRow, name)
    if row is None:
        raise NotFoundError("subject", "the name of a subject", repr(name))
    return row


def _subject(row: SubjectRow) -> Subject:
    return Subject(row.name, row.path, row.kind, row.info, row.created_at, row.owner, row.state, row.size)
