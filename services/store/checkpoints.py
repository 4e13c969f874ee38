"""Checkpoints that any worker can go on from: bytes in the artifact store, and here their hash by job and step."""

from __future__ import annotations

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from services.store.records import Checkpoint, Claim
from services.store.session import Store, db_now
from services.store.tables import CheckpointRow

KEPT = 2  # the newest, and the one before in case its bytes are damaged


def put(session: Session, claim: Claim, checkpoint: Checkpoint) -> None:
    """Add a checkpoint of a running job inside the caller's transaction; older ones than ``KEPT`` are forgotten."""
    mine = CheckpointRow.job_id == claim.job_id
    session.execute(delete(CheckpointRow).where(mine, CheckpointRow.step >= checkpoint.step))
    values = {"job_id": claim.job_id, "attempt": claim.attempt, "created_at": db_now(), **vars(checkpoint)}
    session.execute(insert(CheckpointRow).values(**values))
    newest = select(CheckpointRow.step).where(mine).order_by(CheckpointRow.step.desc()).limit(KEPT)
    session.execute(delete(CheckpointRow).where(mine, CheckpointRow.step.not_in(newest)))


def forget(session: Session, job_id: str) -> None:
    """Remove the checkpoints of a job that needs them no more; their bytes are collected later."""
    session.execute(delete(CheckpointRow).where(CheckpointRow.job_id == job_id))


def newest(store: Store, job_id: str) -> list[Checkpoint]:
    """Checkpoints of a job, the highest step first."""
    query = select(CheckpointRow).where(CheckpointRow.job_id == job_id).order_by(CheckpointRow.step.desc())
    with store.read() as session:
        return [Checkpoint(row.step, row.sha256, row.size) for row in session.scalars(query)]
