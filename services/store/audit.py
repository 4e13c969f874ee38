"""Who did what: rows are appended, never changed, and each names the hash of the one before it.

A row that was changed, removed or put between breaks the chain where it happened. Rows cut off at the end leave a whole
chain, so whoever wants to notice that too keeps the head (``verify`` tells it) somewhere else.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from sqlalchemy import insert, select, text
from sqlalchemy.orm import Session

from services.store.session import Store, db_now
from services.store.tables import AuditRow

GENESIS = "0" * 64  # what the first row names
CHAIN_LOCK = 7_261_003  # any number, the same for all that append
LONGEST = {"actor": 64, "verb": 64, "object": 255, "outcome": 32, "ip": 64, "request_id": 64}
BLOCK = 1000  # rows that ``verify`` holds at a time


@dataclass(frozen=True)
class Entry:
    """One request that wanted to change something, and what became of it."""

    actor: str
    token_id: str | None
    verb: str
    object: str
    outcome: str
    status: int | None
    ip: str | None
    request_id: str | None
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """An entry as it stands in the log."""

    id: int
    at: float
    entry: Entry
    previous_sha256: str
    sha256: str


@dataclass(frozen=True)
class Verdict:
    """Whether the chain is whole: how many rows were read, the hash of the last, and the first that does not fit."""

    rows: int
    head: str
    broken_at: int | None


NAMES = tuple(f.name for f in fields(Entry))


def append(store: Store, entry: Entry) -> Record:
    """Add an entry to the end of the chain; writers wait for each other."""
    return append_many(store, [entry])[0]


def append_many(store: Store, entries: Sequence[Entry]) -> list[Record]:
    """Add entries in their order, in one transaction."""
    with store.write() as session:
        if session.get_bind().dialect.name == "postgresql":
            session.execute(text("select pg_advisory_xact_lock(:key)"), {"key": CHAIN_LOCK})
        previous = session.scalar(select(AuditRow.sha256).order_by(AuditRow.id.desc()).limit(1)) or GENESIS
        at = float(session.scalar(select(db_now())) or 0.0)
        rows = []
        for entry in entries:
            values = {name: _cut(name, getattr(entry, name)) for name in NAMES}
            sha256 = link(previous, at, values)
            rows.append({"at": at, "previous_sha256": previous, "sha256": sha256, **values})
            previous = sha256
        ordered = insert(AuditRow).returning(AuditRow.id, sort_by_parameter_order=True)
        ids = session.scalars(ordered, rows).all()
        return [_written(row_id, row) for row_id, row in zip(ids, rows, strict=True)]


def _written(row_id: int, row: Mapping[str, Any]) -> Record:
    entry = Entry(**{name: row[name] for name in NAMES})
    return Record(row_id, row["at"], entry, row["previous_sha256"], row["sha256"])


def link(previous: str, at: float, values: Mapping[str, Any]) -> str:
    """Hash of a row: of the hash before it and all that it says. ``at`` in microseconds, which every database keeps."""
    said = {**values, "detail": dict(values["detail"]), "at": round(at * 1e6), "previous": previous}
    return hashlib.sha256(json.dumps(said, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def page(store: Store, before: int | None, limit: int, actor: str | None = None) -> list[Record]:
    """Up to ``limit`` records older than the id ``before``, newest first."""
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    if before is not None:
        query = query.where(AuditRow.id < before)
    if actor is not None:
        query = query.where(AuditRow.actor == actor)
    with store.read() as session:
        return [_record(row) for row in session.scalars(query)]


def verify(store: Store) -> Verdict:
    """Walk the chain from its beginning."""
    previous, rows, last_id = GENESIS, 0, 0
    with store.read() as session:
        while block := _block_after(session, last_id):
            for record in block:
                values = {name: getattr(record.entry, name) for name in NAMES}
                if record.previous_sha256 != previous or record.sha256 != link(previous, record.at, values):
                    return Verdict(rows, previous, record.id)
                previous, last_id, rows = record.sha256, record.id, rows + 1
    return Verdict(rows, previous, None)


def _block_after(session: Session, last_id: int) -> list[Record]:
    query = select(AuditRow).where(AuditRow.id > last_id).order_by(AuditRow.id).limit(BLOCK)
    found = [_record(row) for row in session.scalars(query)]
    session.expunge_all()
    return found


def _cut(name: str, value: Any) -> Any:
    return value[: LONGEST[name]] if isinstance(value, str) and name in LONGEST else value


def _record(row: AuditRow) -> Record:
    return Record(row.id, row.at, Entry(**{n: getattr(row, n) for n in NAMES}), row.previous_sha256, row.sha256)
