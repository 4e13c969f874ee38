"""Collection of bytes that nothing names any more, by reference and with a dry run.

A blob is garbage when no artifact and no checkpoint has its hash and nobody has used it for ``grace`` seconds. Writers
note a blob's row before they write its bytes (``artifacts.note``), and the row is removed in the transaction in which
the bytes are: a writer who comes at that moment waits for it and then writes anew. So nothing named can be lost.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy import ColumnElement, delete, func, insert, select

from services.store.session import Store, db_now
from services.store.tables import ArtifactRow, BlobRow, CheckpointRow, JobRow

BATCH = 500
NAMED = (
    select(ArtifactRow.sha256).where(ArtifactRow.sha256 == BlobRow.sha256).exists()
    | select(CheckpointRow.sha256).where(CheckpointRow.sha256 == BlobRow.sha256).exists()
)


@dataclass
class Garbage:
    """What was found, and removed unless the run was dry."""

    blobs: int = 0
    bytes: int = 0
    strays: int = 0  # files that a dead writer has left
    folders: int = 0  # of jobs that do not exist
    missing: list[str] = field(default_factory=list)  # hashes that are named, but whose bytes are gone


@dataclass(frozen=True)
class Totals:
    """What the store holds."""

    blobs: int
    bytes: int
    garbage_blobs: int
    garbage_bytes: int


def collect(store: Store, jobs_dir: Path, grace: float, *, dry_run: bool) -> Garbage:
    """Find garbage older than ``grace`` seconds and remove it; what fails to go stays for the next time."""
    found = Garbage()
    stored = {blob.sha256: blob for blob in store.blobs.all()}
    _adopt_unknown(store, set(stored), dry_run=dry_run)
    for sha256, size in _unnamed(store, grace):
        if dry_run or _remove(store, sha256, grace):
            found.blobs += 1
            found.bytes += size
    known = _known(store)
    if dry_run:
        old = (b for b in stored.values() if b.sha256 not in known and b.modified < time.time() - grace)
        for blob in old:
            found.blobs, found.bytes = found.blobs + 1, found.bytes + blob.size
    found.missing = sorted(sha256 for sha256 in known - set(stored) if store.blobs.path(sha256) is None)
    for path in [*_old(store.blobs.strays(), grace)]:
        found.strays += 1
        if not dry_run:
            path.unlink(missing_ok=True)
    for path in _orphans(store, jobs_dir, grace):
        found.folders += 1
        if not dry_run:
            shutil.rmtree(path, ignore_errors=True)
    return found


def totals(store: Store) -> Totals:
    """How much is stored, and how much of it nothing names, whatever its age."""
    count = select(func.count(), func.coalesce(func.sum(BlobRow.size), 0))
    with store.read() as session:
        blobs, size = session.execute(count).one()
        unnamed, waste = session.execute(count.where(~NAMED)).one()
        return Totals(int(blobs), int(size), int(unnamed), int(waste))


def _garbage(grace: float) -> ColumnElement[bool]:
    return ~NAMED & (BlobRow.used_at < db_now() - grace)


def _unnamed(store: Store, grace: float) -> Iterator[tuple[str, int]]:
    """A batch at a time, so that a long list holds no transaction open."""
    last = ""
    while True:
        query = select(BlobRow.sha256, BlobRow.size).where(_garbage(grace), BlobRow.sha256 > last)
        with store.read() as session:
            rows = session.execute(query.order_by(BlobRow.sha256).limit(BATCH)).all()
        yield from ((sha256, size) for sha256, size in rows)
        if len(rows) < BATCH:
            return
        last = rows[-1][0]


def _remove(store: Store, sha256: str, grace: float) -> bool:
    """The row and then the bytes, in one transaction; False if somebody has named or used them meanwhile."""
    with store.write() as session:
        gone = delete(BlobRow).where(BlobRow.sha256 == sha256, _garbage(grace)).returning(BlobRow.sha256)
        if session.scalar(gone) is None:
            return False
        store.blobs.remove(sha256)
        return True


def _adopt_unknown(store: Store, stored: set[str], *, dry_run: bool) -> None:
    """Bytes without a row, of a crash between the two, get one: they are judged like all others from then on."""
    strangers = sorted(stored - _known(store))
    if dry_run or not strangers:
        return
    sizes = {blob.sha256: blob for blob in store.blobs.all()}
    rows = [
        {"sha256": s, "size": sizes[s].size, "created_at": sizes[s].modified, "used_at": sizes[s].modified}
        for s in strangers
        if s in sizes
    ]
    with store.write() as session:
        taken = set(session.scalars(select(BlobRow.sha256).where(BlobRow.sha256.in_(strangers))))
        fresh = [row for row in rows if row["sha256"] not in taken]
        if fresh:
            session.execute(insert(BlobRow), fresh)


def _known(store: Store) -> set[str]:
    with store.read() as session:
        return set(session.scalars(select(BlobRow.sha256)))


def _old(paths: Iterator[Path], grace: float) -> Iterator[Path]:
    for path in paths:
        try:
            if path.stat().st_mtime < time.time() - grace:
                yield path
        except FileNotFoundError:  # its writer has finished
            continue


def _orphans(store: Store, jobs_dir: Path, grace: float) -> list[Path]:
    folders = list(_old(iter(sorted(jobs_dir.glob("*-*"))), grace))
    with store.read() as session:
        return [folder for folder in folders if session.get(JobRow, folder.name) is None]
