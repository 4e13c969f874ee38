from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import text

from services.errors import SchemaError, SettingsError
from services.settings import Settings
from services.store import events, jobs, leases, metrics, schema
from services.store.records import Artifact, Batch, Point
from services.store.session import Store
from services.store.tables import Base
from tests.services.conftest import POSTGRESQL, submit


def test_migrations_end_in_the_declared_tables(store: Store) -> None:
    with store.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_an_empty_database_is_refused_with_the_remedy(empty: Store) -> None:
    with pytest.raises(SchemaError, match=r"run `python -m services.migrate`, got an empty database"):
        schema.require_head(empty)


def test_a_database_of_a_newer_program_is_refused_even_for_migration(store: Store) -> None:
    with store.engine.begin() as connection:
        connection.execute(text("update alembic_version set version_num = '9999'"))
    for refuse in (schema.require_head, schema.migrate):
        with pytest.raises(SchemaError, match="update this program, got 9999"):
            refuse(store)


def test_migrating_at_once_from_many_processes_is_safe(settings: Settings, empty: Store) -> None:
    stores = [Store(settings) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(schema.migrate, stores))
    for store in stores:
        schema.require_head(store)
        store.close()


def test_rows_survive_the_way_up_and_down(store: Store) -> None:
    job = submit(store, key="k")
    claim = leases.claim(store, "w", 60.0)
    assert claim is not None
    leases.beat(store, claim, Batch(points=[Point("loss", 1, 0.5)], artifacts=[Artifact("a", "0" * 64, "m", 3)]), 60.0)
    schema.downgrade(store, "0001")
    assert schema.current(store) == "0001"
    schema.migrate(store)
    assert jobs.get(store, job.id).attempt == 1
    assert metrics.curves(store, job.id) == {"loss": [(1, 0.5)]}
    assert len(events.after(store, 0, job.id)) == 2
    with store.read() as session:
        assert session.scalar(text("select size from blobs where sha256 = :sha"), {"sha": "0" * 64}) == 3
        if not POSTGRESQL:
            assert session.scalar(text("pragma foreign_keys")) == 1


@pytest.mark.skipif(bool(POSTGRESQL), reason="of SQLite")
def test_sqlite_profile(store: Store) -> None:
    with store.read() as session:
        values = [session.scalar(text(f"pragma {name}")) for name in ("journal_mode", "foreign_keys", "busy_timeout")]
    assert values == ["wal", 1, 60000]


def test_a_url_without_its_driver_is_a_setting_error() -> None:
    with pytest.raises(SettingsError, match="RSAVATAR_DATABASE_URL"):
        Store(Settings(database_url="nonsense"))
