"""The database as a file and back, and what it names: for ``services.backup``."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from sqlalchemy import inspect, select, union

from services.errors import BackupError
from services.store.session import Store
from services.store.tables import ArtifactRow, CheckpointRow, SubjectRow

FILES = {"sqlite": "database.sqlite", "postgresql": "database.dump"}


def kind_of(store: Store) -> str:
    """``sqlite`` or ``postgresql``."""
    return store.engine.dialect.name


def dump(store: Store, target: Path) -> None:
    """One consistent copy while everything runs.

    Raises:
        BackupError: if the database's own program is missing or fails.
    """
    if kind_of(store) == "postgresql":
        _run(store, ["pg_dump", "--format=custom", "--no-owner", f"--file={target}"])
        return
    with store.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        driver = connection.connection.driver_connection
        assert isinstance(driver, sqlite3.Connection)
        driver.execute("VACUUM INTO ?", (str(target),))


def check(kind: str, file: Path) -> None:
    """Whether a copy can be read.

    Raises:
        BackupError: saying what is wrong with it.
    """
    if kind == "postgresql":
        _call(["pg_restore", "--list", str(file)], {})
        return
    try:
        with closing(sqlite3.connect(f"file:{file}?mode=ro&immutable=1", uri=True)) as copy:
            said = copy.execute("PRAGMA integrity_check").fetchone()[0]
    except sqlite3.DatabaseError as error:
        said = str(error)
    if said != "ok":
        raise BackupError(str(file), "a whole database", said)


def load(store: Store, file: Path) -> None:
    """Fill an empty database from a copy.

    Raises:
        BackupError: if it is not empty, or cannot be filled.
    """
    if inspect(store.engine).get_table_names():
        raise BackupError("database", "an empty one", store.engine.url.render_as_string(hide_password=True))
    if kind_of(store) == "postgresql":
        name = str(store.engine.url.database)
        words = ["--no-owner", "--exit-on-error", "--single-transaction", f"--dbname={name}", str(file)]
        _run(store, ["pg_restore", *words], names_database=True)
        return
    place = Path(str(store.engine.url.database))
    store.close()  # connections to the file that is replaced; the next use opens new ones
    for suffix in ("-wal", "-shm"):
        place.with_name(place.name + suffix).unlink(missing_ok=True)
    shutil.copyfile(file, place)
    place.chmod(0o600)


def named(store: Store) -> list[str]:
    """Hashes of all bytes that a row names."""
    with store.read() as session:
        return sorted(session.scalars(union(select(ArtifactRow.sha256), select(CheckpointRow.sha256))))


def move_subjects(store: Store, old: Path, new: Path) -> None:
    """Tell subjects that lay below ``old`` where they lie now."""
    with store.write() as session:
        for row in session.scalars(select(SubjectRow).where(SubjectRow.path.startswith(f"{old}/", autoescape=True))):
            row.path = str(new / Path(str(row.path)).relative_to(old))


def _run(store: Store, words: Sequence[str], *, names_database: bool = False) -> None:
    url = store.engine.url
    place = {"PGHOST": url.host, "PGPORT": url.port, "PGUSER": url.username, "PGPASSWORD": url.password}
    place |= {f"PG{key.upper()}": str(value) for key, value in url.query.items() if key in {"host", "port", "sslmode"}}
    database = {} if names_database else {"PGDATABASE": url.database}
    _call(words, {key: str(value) for key, value in {**place, **database}.items() if value is not None})


def _call(words: Sequence[str], env: dict[str, str]) -> None:
    try:
        done = subprocess.run(words, env=os.environ | env, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise BackupError(words[0], "a program on PATH (package postgresql-client)", "none") from None
    if done.returncode:
        raise BackupError(words[0], "success", (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1])
