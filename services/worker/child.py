"""The process that trains one job. Reads one JSON line on stdin, writes JSON lines on stdout, logs on stderr.

In:   {"spec": {...}, "out": DIR, "subject_dir": DIR or null, "memory_limit_mb": N}
Out:  {"kind": "progress" | "note" | "checkpointed" | "preview", ...}         any number, see rsavatar.events
      {"kind": "result", "result": {...}, "artifacts": {name: path}}          then exit 0
      {"kind": "failed", "failure": ..., "message": ..., "traceback": ...}    then exit 1
      {"kind": "interrupted"}                                                 after SIGTERM, then exit 0
Stdin stays open as long as the worker lives: its end means that nobody listens, and the process dies at once, so that
two processes never write one checkpoint. A lock on the folder makes sure of it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from rsavatar import errors, events
from rsavatar.spec import JobSpec
from services.process import die_with_parent, identity

LOCK_SECONDS = 10.0  # an orphan of an earlier attempt has this long to disappear
BAD_DATA = (errors.DataError, errors.BodyError, errors.SpecError)
CLASSES: tuple[tuple[type[BaseException] | tuple[type[BaseException], ...], str], ...] = (
    (errors.DivergedError, "diverged"),
    (BAD_DATA, "bad data"),
    (MemoryError, "out of memory"),
    (BlockingIOError, "infrastructure"),
    (OSError, "infrastructure"),
)


NO_MEMORY = ("can't allocate memory", "Insufficient memory", "bad_alloc", "Cannot allocate memory")  # torch, cv2, ours


class Result(Protocol):
    """What this process needs of ``rsavatar.experiment.Result``."""

    @property
    def artifacts(self) -> Mapping[str, Path]:
        """Name to file."""

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""


class Run(Protocol):
    """The shape of ``rsavatar.experiment.run``."""

    def __call__(
        self,
        spec: JobSpec,
        out: Path,
        subject_dir: Path | None,
        report: events.Report,
        should_stop: Callable[[], bool],
    ) -> Result:
        """Train, evaluate, write into ``out``."""


@dataclass(frozen=True)
class Order:
    """The line on stdin."""

    spec: JobSpec
    out: Path
    subject_dir: Path | None
    memory_limit_mb: int

    @classmethod
    def parse(cls, line: str) -> Order:
        """Read the line of the worker; it is trusted, the API has validated the spec."""
        order = json.loads(line)
        subject = Path(order["subject_dir"]) if order["subject_dir"] else None
        return cls(JobSpec.model_validate(order["spec"]), Path(order["out"]), subject, int(order["memory_limit_mb"]))


class Channel:
    """The worker's end of stdout: one JSON value a line, whole lines only, from any thread."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._lock = threading.Lock()

    def send(self, message: Mapping[str, Any]) -> None:
        """Write one line."""
        with self._lock:
            self._stream.write(json.dumps(message) + "\n")
            self._stream.flush()


def serve(run: Run) -> int:
    """Run the job on stdin and return the exit status."""
    die_with_parent()
    faulthandler.enable()  # a crash of native code says where, in the log
    faulthandler.register(signal.SIGUSR1, all_threads=True)  # so does a job that hangs, when asked
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal; the worker decides
    channel = Channel(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    os.dup2(2, 1)  # a stray print belongs into the log
    order = Order.parse(sys.stdin.readline())
    threading.Thread(target=_die_at_end_of_input, daemon=True).start()
    try:
        with _only_writer(order.out):
            _limit_memory(order.memory_limit_mb)
            result = run(
                order.spec,
                out=order.out,
                subject_dir=order.subject_dir,
                report=lambda event: channel.send(events.to_json(event)),
                should_stop=stop.is_set,
            )
        files = {name: str(Path(path).absolute()) for name, path in result.artifacts.items()}
        channel.send({"kind": "result", "result": result.to_json(), "artifacts": files})
    except errors.Interrupted:
        channel.send({"kind": "interrupted"})
    except Exception as error:
        channel.send(describe(error))
        with contextlib.suppress(OSError):  # the log may lie on the disk that is full
            traceback.print_exc()
        return 1
    return 0


def describe(error: Exception) -> dict[str, Any]:
    """The ``failed`` message of an exception; what is not known by its class is a bug of ours."""
    failure = next((name for kind, name in CLASSES if isinstance(error, kind)), "bug")
    if failure in {"bug", "infrastructure"} and any(word in str(error) for word in NO_MEMORY):
        failure = "out of memory"
    text = "".join(traceback.format_exception(error))
    return {"kind": "failed", "failure": failure, "message": f"{type(error).__name__}: {error}", "traceback": text}


def _die_at_end_of_input() -> None:
    sys.stdin.read()
    os._exit(1)


def _only_writer(out: Path) -> IO[str]:
    """Lock ``out`` for this process, and say in the lock whose it is.

    Raises:
        BlockingIOError: if another process still writes there.
    """
    out.mkdir(parents=True, exist_ok=True)
    lock = (out / ".lock").open("a+", encoding="utf-8")
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            lock.truncate(0)
            lock.write(identity())  # so that a successor on this machine can end us
            lock.flush()
            return lock
        except BlockingIOError:
            if time.monotonic() > deadline:
                lock.close()
                raise
            time.sleep(0.1)


def _limit_memory(megabytes: int) -> None:
    if megabytes:
        resource.setrlimit(resource.RLIMIT_DATA, (megabytes << 20, megabytes << 20))


if __name__ == "__main__":
    from rsavatar import experiment

    sys.exit(serve(experiment.run))
