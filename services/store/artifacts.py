"""Artifacts: bytes under their SHA-256 (``blobs``), names in the database. No path ever comes from outside."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import delete, insert, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from services.errors import NotFoundError
from services.store.blobs import BLOCK, new_incoming, write_hashed
from services.store.jobs import get
from services.store.records import Artifact
from services.store.session import Store, db_now
from services.store.tables import ArtifactRow, BlobRow

SHA256 = re.compile(r"[0-9a-f]{64}")
MIMES = {".png": "image/png", ".json": "application/json", ".txt": "text/plain", ".csv": "text/csv"}
OTHER = "application/octet-stream"


def keep(store: Store, name: str, source: Path) -> Artifact:
    """Copy ``source`` under its hash, durably. Its row is there before its bytes are, so that no collection takes them.

    Raises:
        OSError: if it cannot be read or the copy not be written.
    """
    incoming = new_incoming(store.artifacts_dir)
    try:
        sha256, size = write_hashed(incoming, _blocks(source))
        with store.write() as session:
            note(session, sha256, size)
        store.blobs.keep(sha256, incoming)
    finally:
        incoming.unlink(missing_ok=True)
    return Artifact(name, sha256, MIMES.get(source.suffix.lower(), OTHER), size)


def note(session: Session, sha256: str, size: int) -> None:
    """Bytes of this hash are about to be used: they stay for a while even if nothing names them."""
    dialect: Any = postgresql if session.get_bind().dialect.name == "postgresql" else sqlite
    statement = dialect.insert(BlobRow).values(sha256=sha256, size=size, created_at=db_now(), used_at=db_now())
    session.execute(statement.on_conflict_do_update(index_elements=[BlobRow.sha256], set_={"used_at": db_now()}))


def _blocks(source: Path) -> Iterator[bytes]:
    with source.open("rb") as reader:
        while block := reader.read(BLOCK):
            yield block


def put(session: Session, job_id: str, artifacts: Sequence[Artifact]) -> None:
    """Name stored bytes inside the caller's transaction; a name that exists is replaced."""
    for artifact in artifacts:
        same = (ArtifactRow.job_id == job_id) & (ArtifactRow.name == artifact.name)
        session.execute(delete(ArtifactRow).where(same))
        about = {"sha256": artifact.sha256, "mime": artifact.mime, "size": artifact.size}
        values = {"job_id": job_id, "name": artifact.name, "created_at": db_now(), **about}
        session.execute(insert(ArtifactRow).values(values))


def of_job(store: Store, job_id: str) -> list[Artifact]:
    """Artifacts of a job by name.

    Raises:
        NotFoundError: if there is no such job.
    """
    get(store, job_id)
    query = select(ArtifactRow).where(ArtifactRow.job_id == job_id).order_by(ArtifactRow.name)
    with store.read() as session:
        return [Artifact(r.name, r.sha256, r.mime, r.size) for r in session.scalars(query)]


def find(store: Store, sha256: str) -> tuple[Artifact, Path]:
    """A stored file by its hash.

    Raises:
        NotFoundError: if no job has such an artifact, or its bytes are gone.
    """
    row = None
    if SHA256.fullmatch(sha256):
        with store.read() as session:
            row = session.scalar(select(ArtifactRow).where(ArtifactRow.sha256 == sha256).limit(1))
    path = None if row is None else store.blobs.path(sha256)
    if row is None or path is None:
        raise NotFoundError("artifact", "the sha256 of a stored file", sha256)
    return Artifact(row.name, row.sha256, row.mime, row.size), path
