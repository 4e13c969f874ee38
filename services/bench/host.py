"""A service of one's own to measure: a temporary home, and the programs of a deployment in it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.error
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil

from services import redis_server
from services.demo import free_port
from services.process import stop, terminate_with_parent
from services.settings import ROOT, Settings, make_home
from services.store import schema
from services.store.session import Store
from services.up import DIRECT

PATIENCE = 60.0
COMMANDS = {name: [sys.executable, "-m", f"services.{name}"] for name in ("api", "worker")}
UNLIMITED = {"requests_per_second": 1e9, "request_burst": 1e9, "max_queued_per_owner": 0}


class Host:
    """A home and its processes."""

    def __init__(self, home: Path, **changes: Any) -> None:
        self.settings = Settings(home=home, port=free_port(), **{**UNLIMITED, **changes})
        make_home(self.settings)
        self.store = Store(self.settings)
        schema.migrate(self.store)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, kind: str | None = None) -> psutil.Process:
        """Start ``redis``, ``api`` or ``worker`` (``kind``, if it is to have another name) and wait until it serves."""
        kind = kind or name
        command = redis_server.command(self.settings) if kind == "redis" else COMMANDS[kind]
        with (self.settings.home / "logs" / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self._env(),
                stdout=log,
                stderr=log,
                preexec_fn=terminate_with_parent,  # noqa: PLW1509  (this program forks before it has threads)
            )
        self.processes[name] = process
        if kind == "redis":
            redis_server.wait_until_ready(self.settings, PATIENCE)
        if kind == "api":
            self._wait_for_api()
        return psutil.Process(process.pid)

    def _env(self) -> dict[str, str]:
        env = dict(os.environ)
        for name in self.settings.model_fields_set:
            value = getattr(self.settings, name)
            env[f"RSAVATAR_{name.upper()}"] = (
                str(value) if not isinstance(value, tuple) else "[" + ",".join(f'"{v}"' for v in value) + "]"
            )
        return env

    def _wait_for_api(self) -> None:
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            try:
                with DIRECT.open(f"{self.settings.url}/healthz", timeout=5.0):
                    return
            except (urllib.error.URLError, OSError):
                time.sleep(0.05)
        raise TimeoutError(f"api: expected an answer within {PATIENCE:g} s, got none")

    def close(self) -> None:
        """End everything."""
        for process in reversed(self.processes.values()):
            stop(process, 20.0)
        self.store.close()


@contextmanager
def host(**changes: Any) -> Iterator[Host]:
    """A host that disappears at the end."""
    with TemporaryDirectory(prefix="rsavatar-bench-") as home:
        running = Host(Path(home), **changes)
        try:
            yield running
        finally:
            running.close()
