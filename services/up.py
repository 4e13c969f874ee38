"""``python -m services.up``: the whole service on one machine. A private Redis, the API and a worker as children.

The parts are the same programs that a deployment starts one by one; here one parent starts them in order, starts a
part again that died, and stops them in the reverse order. Redis is left out where RSAVATAR_BROKER_URL is set.
"""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from services import redis_server
from services.errors import ServiceError, SettingsError
from services.process import stop, terminate_with_parent
from services.settings import ROOT, Settings, make_home, read_settings
from services.store import schema, tokens
from services.store.session import Store

READY_SECONDS = 60.0
REDIS_SECONDS = 20.0
STOP_MARGIN = 15.0  # beyond the grace that a job has
LONGEST_PAUSE = 10.0  # between two starts of a part that keeps dying
TAIL_LINES = 15
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy reaches our loopback


@dataclass
class Part:
    """One child process and its history."""

    name: str
    command: list[str]
    log: Path
    process: subprocess.Popen[bytes] | None = None
    deaths: int = 0
    start_again_at: float = 0.0

    def start(self, env: dict[str, str]) -> None:
        """Start it; its output is appended to its log. It is told to end should this process be killed."""
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command,
                cwd=ROOT,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=terminate_with_parent,  # noqa: PLW1509  (this program has one thread)
            )

    def tail(self) -> str:
        """The last lines of its log."""
        return "\n".join(self.log.read_text("utf-8", "replace").splitlines()[-TAIL_LINES:])


class Stack:
    """Redis, API and worker. ``tend`` must be called now and then: it starts dead parts again."""

    def __init__(self, settings: Settings, say: Callable[[str], None] = print) -> None:
        self.settings = settings
        self._say = say
        self._env = os.environ | {"RSAVATAR_HOME": str(settings.home), "RSAVATAR_PORT": str(settings.port)}
        self._lock: IO[str] | None = None
        self.parts: dict[str, Part] = {}

    def start(self) -> None:
        """Lock the home, migrate, start all parts, wait until the API is ready.

        Raises:
            ServiceError: if something cannot start; what was started is stopped again by ``stop``.
        """
        make_home(self.settings)
        self._lock = lock_home(self.settings)
        require_free_port(self.settings)
        if self.settings.embedded_broker:
            self._start("redis", redis_server.command(self.settings))
            redis_server.wait_until_ready(self.settings, REDIS_SECONDS)
        store = Store(self.settings)
        if self.settings.embedded_database:
            schema.migrate(store)
        schema.require_head(store)
        if self.settings.needs_token and (path := tokens.issue_first(store, self.settings.home)):
            self._say(f"first admin token, in {path}: {path.read_text('utf-8').strip()}")
        store.close()
        self._start("api", [sys.executable, "-m", "services.api"])
        self._start("worker", [sys.executable, "-m", "services.worker"])
        self._wait_until_ready()

    def _start(self, name: str, command: list[str]) -> None:
        part = Part(name, command, self.settings.home / "logs" / f"{name}.log")
        self.parts[name] = part
        part.start(self._env)

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + READY_SECONDS
        while not is_ready(self.settings):
            dead = next(
                (p for p in self.parts.values() if p.process is not None and p.process.poll() is not None), None
            )
            if dead is not None:
                raise SettingsError(dead.name, "a running process", f"one that ended; {dead.log} says:\n{dead.tail()}")
            if time.monotonic() > deadline:
                raise SettingsError("api", f"ready within {READY_SECONDS:g} s", f"silence; see {self.parts['api'].log}")
            time.sleep(0.05)

    def tend(self) -> None:
        """Start parts again that died, with growing pauses."""
        for part in self.parts.values():
            if part.process is not None and part.process.poll() is not None:
                pause = min(LONGEST_PAUSE, 0.5 * 2.0**part.deaths)
                self._say(f"{part.name} ended with status {part.process.returncode}; starting it again in {pause:g} s")
                part.deaths, part.process = part.deaths + 1, None
                part.start_again_at = time.monotonic() + pause
            elif part.process is None and time.monotonic() >= part.start_again_at:
                part.start(self._env)

    def stop(self) -> None:
        """Stop the parts in reverse order; jobs leave a checkpoint, and go on at the next start."""
        for part in reversed(self.parts.values()):
            if part.process is not None:
                stop(part.process, self.settings.grace_seconds + STOP_MARGIN)
        self.parts.clear()
        if self._lock is not None:
            self._lock.close()


def lock_home(settings: Settings) -> IO[str]:
    """Make sure that one stack runs in a home.

    Raises:
        SettingsError: if another one does.
    """
    lock = (settings.home / "run" / "up.lock").open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise SettingsError("RSAVATAR_HOME", "a home in which nothing runs yet", settings.home) from None
    return lock


def require_free_port(settings: Settings) -> None:
    """Make sure that the answers on our port will be ours.

    Raises:
        SettingsError: if somebody listens there already.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            raise SettingsError("RSAVATAR_PORT", "a free port", f"{settings.port} ({error.strerror})") from None


def is_ready(settings: Settings) -> bool:
    """Whether the API and what it needs are ready."""
    try:
        with DIRECT.open(f"{settings.url}/readyz", timeout=5.0) as reply:
            return bool(reply.status == 200)
    except (urllib.error.URLError, OSError):
        return False


@contextmanager
def running(settings: Settings, say: Callable[[str], None] = print) -> Iterator[Stack]:
    """A started stack that is stopped at the end, whatever happens."""
    stack = Stack(settings, say)
    try:
        stack.start()
        yield stack
    finally:
        stack.stop()


def raise_interrupt(*_: object) -> None:
    """Signal handler: SIGTERM ends this program like Ctrl-C."""
    raise KeyboardInterrupt


def main() -> int:
    """Serve until Ctrl-C or SIGTERM."""
    signal.signal(signal.SIGTERM, raise_interrupt)
    try:
        settings = read_settings()
        print(f"home {settings.home}", flush=True)
        with running(settings) as stack:
            print(f"ready at {settings.url}, stop with Ctrl-C", flush=True)
            while True:
                stack.tend()
                time.sleep(0.2)
    except KeyboardInterrupt:
        print("stopped", flush=True)
        return 0
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
