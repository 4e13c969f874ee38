"""The database's version: migrated on purpose, checked at every start."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import text
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
    configuration = config()
    with store.engine.execution_options(immediate=True).begin() as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": MIGRATION_LOCK})
        configuration.attributes["connection"] = connection
        command.upgrade(configuration, "head")


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
