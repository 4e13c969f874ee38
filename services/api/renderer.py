"""The API's end of the processes that draw. The API itself never loads the numeric core.

Two lanes, so that a video or a figure holds up no slider: ``views`` and ``files``. Each is one process, started when
it is first needed, given one order at a time, and started again when it has ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import Any, Literal

from rsavatar.errors import SpecError
from services.errors import ConflictError, RenderError
from services.settings import ROOT, Settings, without_secrets

Lane = Literal["views", "files"]
LARGEST_ANSWER = 1 << 30
ENDED = (EOFError, ConnectionError, OSError)


@dataclass(frozen=True)
class Drawing:
    """A finished order."""

    mime: str
    data: bytes


class Renderer:
    """Both lanes."""

    def __init__(self, settings: Settings) -> None:
        self._lanes = {name: RenderProcess(settings, name) for name in ("views", "files")}

    def draw(self, lane: Lane, order: Mapping[str, Any]) -> Drawing:
        """Have an order drawn.

        Raises:
            SpecError: if the order asks for what there is not.
            ConflictError: if the job's avatar cannot be opened.
            RenderError: if the process cannot start, has no turn in time, does not answer in time, or ended.
        """
        return self._lanes[lane].ask(order)

    def close(self) -> None:
        """End both processes."""
        for process in self._lanes.values():
            process.close()


class RenderProcess:
    """One process, and the socket to it. Safe to use from many threads: they take turns."""

    def __init__(self, settings: Settings, name: str) -> None:
        self._settings = settings
        self._log: Path = settings.home / "logs" / f"renderer-{name}.log"
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def ask(self, order: Mapping[str, Any]) -> Drawing:
        """As ``Renderer.draw``."""
        seconds = self._settings.render_seconds
        if not self._turn.acquire(timeout=seconds):
            raise RenderError("render process", f"a turn within {seconds:g} s", "a queue that is longer")
        try:
            return self._ask(json.dumps(order).encode())
        finally:
            self._turn.release()

    def _ask(self, message: bytes) -> Drawing:
        with contextlib.suppress(*ENDED):  # it may have ended for want of orders since the last one
            if self._connection is not None:
                return self._exchange(self._connection, message)
        self._end()
        try:
            return self._exchange(self._start(), message)
        except ENDED:
            code = self._end()
            got = f"its end with status {code}: {self._last_words()}"
            raise RenderError("render process", "an answer", got) from None

    def _start(self) -> Connection:
        if self._settings.render_socket is not None:
            try:
                self._connection = Client(str(self._settings.render_socket), "AF_UNIX")
            except OSError as error:
                wanted = f"one that listens on {self._settings.render_socket} (RSAVATAR_RENDER_SOCKET)"
                raise RenderError("render process", wanted, error) from None
            return self._connection
        ours, theirs = socket.socketpair()
        threads = str(self._settings.threads)
        env = without_secrets(os.environ)
        env |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RSAVATAR_THREADS"), threads)
        env["MPLCONFIGDIR"] = str(self._settings.home / "run" / "matplotlib")  # its list of fonts; a home is writable
        words = (str(theirs.fileno()), str(self._settings.render_idle_seconds))
        command = [sys.executable, "-m", "services.renderer", *words]
        try:
            with theirs, self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    command,
                    cwd=ROOT,
                    env=env,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,
                )
        except OSError as error:
            ours.close()
            raise RenderError("render process", "one that starts", error) from None
        self._connection = Connection(ours.detach())
        return self._connection

    def _exchange(self, connection: Connection, message: bytes) -> Drawing:
        connection.send_bytes(message)
        answer = json.loads(self._receive(connection))
        if "error" not in answer:
            return Drawing(answer["mime"], self._receive(connection))
        text = str(answer["message"])
        if answer["error"] == "spec":
            raise SpecError(text)
        if answer["error"] == "data":
            raise ConflictError("avatar", "a subject and a checkpoint that can be opened", text)
        raise RenderError("render process", "a drawing", f"an error; see {self._log.name}")

    def _receive(self, connection: Connection) -> bytes:
        seconds = self._settings.render_seconds
        if not connection.poll(seconds):
            self._end()
            raise RenderError("render process", f"an answer within {seconds:g} s", "none")
        return connection.recv_bytes(LARGEST_ANSWER)

    def _end(self) -> int | None:
        """Kill it if it still runs; returns its exit status."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        process, self._process = self._process, None
        if process is None:
            return None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(0.5)  # it sees the closed socket, unless it is drawing
        process.kill()
        return process.wait()

    def _last_words(self) -> str:
        with contextlib.suppress(OSError):
            lines = self._log.read_text("utf-8", "replace").splitlines()
            return next((line for line in reversed(lines) if line.strip()), "nothing in its log")
        return "no log"

    def close(self) -> None:
        """End the process; a later order starts another one."""
        with self._turn:
            self._end()
