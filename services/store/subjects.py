"""Subjects that jobs may name. ``studio`` always exists: the core makes it itself."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from services.errors import ConflictError, NotFoundError
from services.store.records import Subject
from services.store.session import Store, db_now
from services.store.tables import SubjectRow

STUDIO = Subject("studio", None, "built-in", {"description": "synthetic subject with true motion, made on first use"})


def all_of(store: Store) -> list[Subject]:
    """All subjects by name, the built-in one first."""
    with store.read() as session:
        return [STUDIO, *(_subject(row) for row in session.scalars(select(SubjectRow).order_by(SubjectRow.name)))]


def get(store: Store, name: str) -> Subject:
    """One subject.

    Raises:
        NotFoundError: if it is not registered; the message lists those that are.
    """
    if name == STUDIO.name:
        return STUDIO
    with store.read() as session:
        row = session.get(SubjectRow, name)
        if row is not None:
            return _subject(row)
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
                about = {"path": subject.path, "kind": subject.kind, "info": dict(subject.info)}
                session.add(SubjectRow(name=subject.name, created_at=created, **about))
                session.flush()
                return Subject(subject.name, subject.path, subject.kind, subject.info, created), True
    except IntegrityError:  # another request registered the name since our look
        pass
    known = get(store, subject.name)
    if known.path != subject.path:
        raise ConflictError("subject", f"{subject.name} at {known.path}", subject.path)
    return known, False


def _subject(row: SubjectRow) -> Subject:
    return Subject(row.name, row.path, row.kind, row.info, row.created_at)
