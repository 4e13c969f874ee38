"""Artifacts: bytes under their SHA-256 on disk, names in the database. No path ever comes from outside."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Sequence
from pathlib import Path

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from services.errors import NotFoundError
from services.store.jobs import get
from services.store.records import Artifact
from services.store.session import Store, db_now
from services.store.tables import ArtifactRow

BLOCK = 1 << 20
SHA256 = re.compile(r"[0-9a-f]{64}")
MIMES = {".png": "image/png", ".json": "application/json", ".txt": "text/plain", ".csv": "text/csv"}
OTHER = "application/octet-stream"


def path_of(root: Path, sha256: str) -> Path:
    """Where the bytes with this hash lie: ``root/ab/cdef...``."""
    return root / sha256[:2] / sha256[2:]


def keep(root: Path, name: str, source: Path) -> Artifact:
    """Copy ``source`` under its hash, durably: temporary file, fsync, rename. Known bytes are not written again."""
    digest = hashlib.sha256()
    root.mkdir(parents=True, exist_ok=True)
    temporary = root / f"incoming-{os.getpid()}-{secrets.token_hex(4)}"
    size = 0
    try:
        with source.open("rb") as reader, temporary.open("xb") as writer:
            while block := reader.read(BLOCK):
                digest.update(block)
                writer.write(block)
                size += len(block)
            writer.flush()
            os.fsync(writer.fileno())
        target = path_of(root, digest.hexdigest())
        target.parent.mkdir(exist_ok=True)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return Artifact(name, digest.hexdigest(), MIMES.get(source.suffix.lower(), OTHER), size)


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
    path = path_of(store.artifacts_dir, sha256)
    if row is None or not path.is_file():
        raise NotFoundError("artifact", "the sha256 of a stored file", sha256)
    return Artifact(row.name, row.sha256, row.mime, row.size), path
