"""Work that many jobs share (a built subject, restored frames): one process builds it, the others wait for it.

The protocol is that of jobs: a claim by compare-and-set raises ``attempt``, the fence; the lease is on the database's
clock; a builder that falls silent loses the stage to the next who asks. On one disk the core needs none of it: its
caches (``rsavatar.restore.cache``, ``rsavatar.data.build``) are content-addressed folders with a lock.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from sqlalchemy import delete, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from services.errors import FencedError
from services.store.session import Store, db_now
from services.store.tables import StageRow

UNSEEN = {"synchronize_session": False}


class StageState(StrEnum):
    """States of a stage."""

    BUILDING = "building"
    READY = "ready"
    FAILED = "failed"


@dataclass(frozen=True)
class Stage:
    """A row of the stages. ``is_mine``: the caller has just been given the right to build it."""

    key: str
    kind: str
    state: str
    attempt: int
    path: str | None
    size: int | None
    error: str | None
    is_mine: bool = False


def claim(store: Store, key: str, kind: str, owner: str, lease_seconds: float) -> Stage:
    """The stage of ``key``: ready, or being built by another, or (``is_mine``) the caller's to build.

    One that failed may be tried again by whoever asks next.
    """
    with store.write() as session:
        _ensure(session, key, kind)
        free = StageRow.state != StageState.READY
        free &= (StageRow.state != StageState.BUILDING) | (StageRow.lease_until < db_now())
        values = {
            "state": StageState.BUILDING,
            "attempt": StageRow.attempt + 1,
            "owner": owner,
            "lease_until": db_now() + lease_seconds,
            "error": None,
            "used_at": db_now(),
        }
        taken = update(StageRow).where(StageRow.key == key, free).values(**values).returning(StageRow.attempt)
        is_mine = session.scalar(taken, execution_options=UNSEEN) is not None
        if not is_mine:
            used = update(StageRow).where(StageRow.key == key).values(used_at=db_now())
            session.execute(used, execution_options=UNSEEN)
        return _stage(session.get_one(StageRow, key, populate_existing=True), is_mine=is_mine)


def _ensure(session: Session, key: str, kind: str) -> None:
    """A stage that nobody has asked for yet: failed before it began, so free to claim."""
    dialect: Any = postgresql if session.get_bind().dialect.name == "postgresql" else sqlite
    values = {"key": key, "kind": kind, "state": StageState.FAILED, "attempt": 0}
    values |= {"created_at": db_now(), "used_at": db_now()}
    session.execute(dialect.insert(StageRow).values(**values).on_conflict_do_nothing())


def renew(store: Store, stage: Stage, lease_seconds: float) -> None:
    """Keep the right to build.

    Raises:
        FencedError: if another has it.
    """
    _fenced(store, stage, {"lease_until": db_now() + lease_seconds})


def finish(store: Store, stage: Stage, path: Path, size: int) -> None:
    """The stage is built and lies at ``path``.

    Raises:
        FencedError: if another builds it by now.
    """
    ready = {"state": StageState.READY, "path": str(path), "size": size, "lease_until": None, "owner": None}
    _fenced(store, stage, ready)


def fail(store: Store, stage: Stage, error: str) -> None:
    """The stage could not be built; the next who asks may try.

    Raises:
        FencedError: if another builds it by now.
    """
    _fenced(store, stage, {"state": StageState.FAILED, "error": error, "lease_until": None, "owner": None})


def _fenced(store: Store, stage: Stage, values: dict[str, Any]) -> None:
    mine = (StageRow.key == stage.key) & (StageRow.attempt == stage.attempt) & (StageRow.state == StageState.BUILDING)
    change = update(StageRow).where(mine).values(**values).returning(StageRow.key)
    with store.write() as session:
        if session.scalar(change, execution_options=UNSEEN) is None:
            raise FencedError("attempt", f"the building attempt of stage {stage.key}", stage.attempt)


def get(store: Store, key: str) -> Stage | None:
    """The stage of ``key``, if anybody has asked for it."""
    with store.read() as session:
        row = session.get(StageRow, key)
        return None if row is None else _stage(row)


def collect(store: Store, age: float, *, dry_run: bool) -> list[str]:
    """Forget stages that nobody has used for ``age`` seconds; returns where they lay. The files are the cache's."""
    old = (StageRow.used_at < db_now() - age) & (StageRow.state != StageState.BUILDING)
    with store.write() as session:
        paths = session.scalars(select(StageRow.path).where(old)).all()
        if not dry_run:
            session.execute(delete(StageRow).where(old), execution_options=UNSEEN)
    return [str(path) for path in paths]


def _stage(row: StageRow, *, is_mine: bool = False) -> Stage:
    return Stage(row.key, row.kind, row.state, row.attempt, row.path, row.size, row.error, is_mine)
