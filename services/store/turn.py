"""Whose turn it is to write into an SQLite file: the threads of a process queue up, one of each process looks often.

SQLite's own waiting sleeps longer and longer, so that under load a writer often sleeps through its turn. Its lock is
still taken (BEGIN IMMEDIATE): it decides, also against programs that do not queue here, and after ``PATIENCE_SECONDS``
of waiting for a process that was stopped in the middle of a write.
"""

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE_SECONDS = 30.0
LOOK_SECONDS = 0.001


class Turn:
    """A queue of writers; ``path`` none is for databases that need no queue."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._thread = threading.Lock()
        self._file: int | None = None

    @contextmanager
    def take(self) -> Iterator[None]:
        """Wait for the turn, and give it back at the end. A process that dies gives it back, too."""
        if self._path is None:
            yield
            return
        deadline = time.monotonic() + PATIENCE_SECONDS
        is_mine = self._thread.acquire(timeout=PATIENCE_SECONDS)
        try:
            is_locked = is_mine and self._lock(self._path, deadline)
            try:
                yield
            finally:
                if is_locked and self._file is not None:
                    fcntl.flock(self._file, fcntl.LOCK_UN)
        finally:
            if is_mine:
                self._thread.release()

    def _lock(self, path: Path, deadline: float) -> bool:
        if self._file is None:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        while True:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if time.monotonic() > deadline:
                    return False
                time.sleep(LOOK_SECONDS)

    def close(self) -> None:
        """Leave the queue."""
        with self._thread:
            if self._file is not None:
                os.close(self._file)
                self._file = None
