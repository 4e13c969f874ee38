"""``python -m services.backup create|verify|restore FOLDER``: everything that is kept, while everything runs.

FOLDER/pool/ab/cdef...        bytes under their SHA-256, shared by all backups in FOLDER: the second one copies the news
FOLDER/2026-01-31T12-00-00Z/  database.sqlite or database.dump, manifest.json

The database is copied first. Artifacts never change and outlive their last row by ``gc_grace_seconds``, so what the
copy names is still there to be copied after it. Tokens come along as hashes; the file of the first token does not.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from services.errors import BackupError, ServiceError
from services.settings import Settings, make_home, read_settings
from services.store import audit, backup, schema
from services.store.blobs import copy_verified, new_incoming, path_of
from services.store.session import Store

KEPT = ("subjects/*/**/*", "jobs/*/log.txt")  # files of the home that no row can make again
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """What a backup holds. ``files`` are those of the home, by their path in it."""

    made_at: str
    home: str
    kind: str
    schema: str | None
    database_sha256: str
    audit_head: str
    artifacts: list[str]
    files: dict[str, str]

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """The manifest of a backup.

        Raises:
            BackupError: if there is none, or it is damaged.
        """
        try:
            return cls(**json.loads((folder / MANIFEST).read_text("utf-8")))
        except (OSError, ValueError, TypeError) as error:
            raise BackupError(str(folder / MANIFEST), "the manifest of a backup", error) from None

    @property
    def pooled(self) -> list[str]:
        """Every hash that the pool must have."""
        return sorted({*self.artifacts, *self.files.values()})


def create(settings: Settings, into: Path) -> Path:
    """Make a backup in ``into`` and return its folder. It has a manifest when it is whole, and not before.

    Raises:
        BackupError: if something that the database names is missing or damaged.
    """
    folder = into / time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
    folder.mkdir(mode=0o700, parents=True)
    pool = into / "pool"
    store = Store(settings)
    try:
        head = audit.verify(store)
        if head.broken_at is not None:
            raise BackupError("audit log", "a whole chain", f"one that breaks at record {head.broken_at}")
        database = folder / backup.FILES[backup.kind_of(store)]
        backup.dump(store, database)
        artifacts = backup.named(store)
        for sha256 in artifacts:
            add(pool, sha256, store.blobs.path(sha256))
        files = {str(path.relative_to(settings.home)): digest(path) for path in kept(settings.home)}
        for name, sha256 in files.items():
            add(pool, sha256, settings.home / name)
        made = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        about = (made, str(settings.home), backup.kind_of(store), schema.current(store), digest(database), head.head)
        manifest = Manifest(*about, artifacts, files)
    finally:
        store.close()
    draft = folder / f".{MANIFEST}"
    draft.write_text(json.dumps(asdict(manifest), indent=1, sort_keys=True), "utf-8")
    draft.replace(folder / MANIFEST)
    return folder


def add(pool: Path, sha256: str, source: Path | None) -> None:
    """Copy a file into the pool, unless it is there.

    Raises:
        BackupError: if it is missing, or its bytes are others by now.
    """
    target = path_of(pool, sha256)
    if target.is_file():
        return
    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if source is None or not copy_verified(source, target, sha256):
        raise BackupError(f"bytes {sha256}", "a file with this hash", "none" if source is None else "other bytes")


def verify(folder: Path) -> Manifest:
    """Read every byte of a backup again.

    Raises:
        BackupError: naming what is missing or damaged.
    """
    manifest = Manifest.read(folder)
    database = folder / backup.FILES[manifest.kind]
    if not database.is_file() or digest(database) != manifest.database_sha256:
        raise BackupError(str(database), f"bytes of hash {manifest.database_sha256}", "others or none")
    backup.check(manifest.kind, database)
    for sha256 in manifest.pooled:
        path = path_of(folder.parent / "pool", sha256)
        if not path.is_file() or digest(path) != sha256:
            raise BackupError(str(path), f"bytes of hash {sha256}", "others or none")
    return manifest


def restore(settings: Settings, folder: Path) -> Manifest:
    """Fill an empty home and database from a backup that has been verified first.

    Raises:
        BackupError: if the backup is damaged, or the database not empty or of another kind.
    """
    manifest = verify(folder)
    make_home(settings)
    store, pool = Store(settings), folder.parent / "pool"
    try:
        if backup.kind_of(store) != manifest.kind:
            raise BackupError("database", f"{manifest.kind}, as in the backup", backup.kind_of(store))
        backup.load(store, folder / backup.FILES[manifest.kind])
        for sha256 in manifest.artifacts:
            incoming = new_incoming(store.blobs.root)
            copy_verified(path_of(pool, sha256), incoming, sha256)
            store.blobs.keep(sha256, incoming)
        for name, sha256 in manifest.files.items():
            target = settings.home / name
            target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            copy_verified(path_of(pool, sha256), target, sha256)
        backup.move_subjects(store, Path(manifest.home), settings.home)
        verdict = audit.verify(store)
        if verdict.broken_at is not None:
            raise BackupError("audit log", "a whole chain", f"one that breaks at record {verdict.broken_at}")
    finally:
        store.close()
    return manifest


def kept(home: Path) -> Iterator[Path]:
    """Files of the home that are part of a backup."""
    for pattern in KEPT:
        yield from (path for path in sorted(home.glob(pattern)) if path.is_file() and not path.is_symlink())


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def main() -> int:
    """Run one verb; 0 when it is done."""
    words = argparse.ArgumentParser("services.backup", description=__doc__)
    words.add_argument("verb", choices=["create", "verify", "restore"])
    words.add_argument("folder", type=Path, help="create: where backups lie; verify, restore: one of them")
    said = words.parse_args()
    try:
        if said.verb == "create":
            folder = create(read_settings(), said.folder)
            manifest = verify(folder)
        else:
            folder = said.folder
            manifest = verify(folder) if said.verb == "verify" else restore(read_settings(), folder)
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    counts = f"{len(manifest.artifacts)} artifacts, {len(manifest.files)} files, audit head {manifest.audit_head[:12]}"
    print(f"{folder}\n{said.verb} done: {manifest.kind} at version {manifest.schema}, {counts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
