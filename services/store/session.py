"""Engine, transactions and the database's clock, the same for SQLite and PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Double, Engine, create_engine, event, select
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry
from sqlalchemy.sql.functions import FunctionElement

from services.errors import SettingsError
from services.settings import Settings
from services.store.blobs import open_blobs
from services.store.turn import Turn

OUTAGES = (OperationalError, InterfaceError, PoolTimeoutError)  # of a database that may come back
CONNECT_SECONDS = 5
PRAGMAS = ("journal_mode=WAL", "foreign_keys=ON", "synchronous=NORMAL", "busy_timeout=60000", "cache_size=-2000")


class db_now(FunctionElement[float]):  # noqa: N801  (reads as the SQL function that it is)
    """Seconds since 1970 on the database's clock: leases must not depend on whose clock is right."""

    type = Double()
    inherit_cache = True
    name = "db_now"


@compiles(db_now, "sqlite")
def _now_sqlite(element: Any, compiler: Any, **options: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(db_now, "postgresql")
def _now_postgresql(element: Any, compiler: Any, **options: Any) -> str:
    return "extract(epoch from clock_timestamp())::double precision"


@dataclass(frozen=True)
class Quota:
    """Most jobs of one owner that may wait and run at a time; 0 = no limit."""

    queued: int
    running: int


class Store:
    """A database. ``read`` and ``write`` give a session inside one transaction; ``write`` commits at the end.

    On SQLite a write transaction takes the write lock at once (BEGIN IMMEDIATE): one that reads first and writes
    later could not wait for the lock and would fail with "database is locked".
    """

    def __init__(self, settings: Settings) -> None:
        self.engine = open_engine(settings.database)
        self.blobs = open_blobs(settings)
        self.artifacts_dir: Path = self.blobs.root
        self.quota = Quota(settings.max_queued_per_owner, settings.max_running_per_owner)
        self._writer = self.engine.execution_options(immediate=True)
        self._turn = Turn(_queue_of(self.engine))

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session that sees one snapshot and writes nothing."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A session that commits when the block ends, and rolls back when it raises."""
        with self._turn.take(), Session(self._writer) as session, session.begin():
            yield session

    def now(self) -> float:
        """The database's clock."""
        with self.read() as session:
            return float(session.scalar(select(db_now())) or 0.0)

    def close(self) -> None:
        """Give all connections back."""
        self.engine.dispose()
        self._turn.close()


def _queue_of(engine: Engine) -> Path | None:
    """The file that writers of an SQLite file queue at; none for other databases."""
    file = engine.url.database
    return Path(f"{file}-turn") if engine.dialect.name == "sqlite" and file not in (None, "", ":memory:") else None


def open_engine(url: str) -> Engine:
    """An engine with the service's profile for its kind of database.

    Raises:
        SettingsError: if ``url`` is not a database URL, or its driver is not installed.
    """
    try:
        if url.startswith("sqlite"):
            engine = create_engine(url)
        else:
            engine = create_engine(url, pool_pre_ping=True, connect_args={"connect_timeout": CONNECT_SECONDS})
    except (ArgumentError, ModuleNotFoundError) as error:
        wanted = "sqlite:///PATH or postgresql+psycopg://... with psycopg installed"
        raise SettingsError("RSAVATAR_DATABASE_URL", wanted, error) from None
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: DBAPIConnection, record: ConnectionPoolEntry) -> None:
    connection.isolation_level = None  # the driver must not begin transactions on its own
    cursor = connection.cursor()
    for pragma in PRAGMAS:
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    immediate = connection.get_execution_options().get("immediate", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
