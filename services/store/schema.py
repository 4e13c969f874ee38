"""The database's version: migrated on purpose, checked at every start."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text
from sqlalchemy.exc import DBAPIError

from services.errors import SchemaError
from services.store.session import Store

MIGRATION_LOCK = 7_261_001  # any number, the same for all that migrate


def config() -> Config:
    """Alembic's configuration; there is no ini file."""
    configuration = Config()
    configuration.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    return configuration


def head() -> str:
    """The version that this code is written for."""
    return str(ScriptDirectory.from_config(config()).get_current_head())


def current(store: Store) -> str | None:
    """The version that the database has; None for an empty one.

    Raises:
        SchemaError: if the database cannot be opened.
    """
    try:
        with store.engine.connect() as connection:
            return MigrationContext.configure(connection).get_current_revision()
    except DBAPIError as error:
        raise SchemaError("database", "a database that can be opened", error.orig) from None


def migrate(store: Store) -> None:
    """Bring the database to ``head``. Processes that do it at once wait for each other.

    Raises:
        SchemaError: if the database is ahead of this code.
    """
    _refuse_unknown(store)
    with _locked(store) as connection:
        configuration = config()
        configuration.attributes["connection"] = connection
        command.upgrade(configuration, "head")


def downgrade(store: Store, version: str) -> None:
    """Bring the database back to an older ``version``; what only newer ones can say is lost.

    Raises:
        SchemaError: if the database is ahead of this code.
    """
    _refuse_unknown(store)
    with _locked(store) as connection:
        configuration = config()
        configuration.attributes["connection"] = connection
        command.downgrade(configuration, version)


@contextmanager
def _locked(store: Store) -> Iterator[Connection]:
    """One transaction that no other migration shares. On SQLite without foreign keys while it lasts: to change a
    table it builds a new one and drops the old, which would take the rows that refer to it along.
    """
    engine = store.engine.execution_options(immediate=True)
    with engine.connect() as connection:
        is_sqlite = connection.dialect.name == "sqlite"
        if is_sqlite:
            _foreign_keys(connection, "OFF")
        try:
            with connection.begin():
                if not is_sqlite:
                    connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": MIGRATION_LOCK})
                yield connection
                if is_sqlite and (broken := connection.execute(text("pragma foreign_key_check")).all()):
                    raise SchemaError("database", "rows whose references hold", f"{len(broken)} that do not")
        finally:
            if is_sqlite:
                _foreign_keys(connection, "ON")


def _foreign_keys(connection: Connection, value: str) -> None:
    driver: Any = (
        connection.connection.driver_connection
    )  # SQLAlchemy would open a transaction, in which it has no effect
    driver.execute(f"PRAGMA foreign_keys={value}")


def _refuse_unknown(store: Store) -> None:
    known = {script.revision for script in ScriptDirectory.from_config(config()).walk_revisions()}
    found = current(store)
    if found is not None and found not in known:
        raise SchemaError("database version", f"{head()} or older; update this program", found)


def require_head(store: Store) -> None:
    """Refuse a database of another version.

    Raises:
        SchemaError: if it is behind (run ``python -m services.migrate``) or ahead (update this program).
    """
    _refuse_unknown(store)
    found = current(store)
    if found != head():
        wanted = f"{head()}; run `python -m services.migrate`"
        raise SchemaError("database version", wanted, found or "an empty database")
