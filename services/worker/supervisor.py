"""One attempt at one job: starts the process that trains, keeps the lease while it moves, ends it, records the end."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from services.errors import FencedError, ServiceError
from services.process import signal_group
from services.settings import ROOT, Settings
from services.store import artifacts, leases, subjects
from services.store.records import Claim, Failure, Outcome, Score, State
from services.store.session import Store
from services.worker.reporter import Reporter

ENDINGS = frozenset({"result", "failed", "interrupted"})
SECRETS = ("RSAVATAR_DATABASE_URL", "RSAVATAR_BROKER_URL")  # a job needs neither
LAST_WORDS_SECONDS = 5.0  # for the pipe to drain after the process has ended

log = logging.getLogger(__name__)


class Supervisor:
    """Runs one claimed job to one of its ends. ``stopping`` is set when the worker is to go."""

    def __init__(self, settings: Settings, store: Store, claim: Claim, stopping: threading.Event) -> None:
        self._settings = settings
        self._store = store
        self._claim = claim
        self._stopping = stopping
        self._messages: queue.Queue[Mapping[str, Any] | None] = queue.Queue()
        self._reporter = Reporter(store.artifacts_dir)
        self._ending: Mapping[str, Any] | None = None
        self._asked_at: float | None = None  # when the child was asked to stop
        self._stalled = False

    def run(self) -> State | None:
        """Train, and return the state that the job reached; None when it was given away meanwhile."""
        out = self._settings.job_dir(self._claim.job_id)
        out.mkdir(parents=True, exist_ok=True)
        try:
            with (out / "log.txt").open("ab") as log_file:
                child = self._start(out, log_file)
                patience = 0.0
                try:
                    self._watch(child)
                    patience = LAST_WORDS_SECONDS
                finally:
                    end(child, patience)
            return self._record(child.returncode)
        except FencedError as error:
            log.warning("stopped: %s", error)
            return None
        except (OSError, ServiceError) as error:
            log.exception("job %s", self._claim.job_id)
            return self._fail(Failure.INFRASTRUCTURE, f"{type(error).__name__}: {error}")

    def _start(self, out: Path, log_file: IO[bytes]) -> subprocess.Popen[bytes]:
        subject = subjects.get(self._store, self._claim.subject)
        child = subprocess.Popen(
            self._settings.child_command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log_file,
            env=child_environment(self._settings),
            cwd=ROOT,
            start_new_session=True,
        )
        order = {
            "spec": dict(self._claim.spec),
            "out": str(out),
            "subject_dir": subject.path,
            "memory_limit_mb": self._settings.memory_limit_mb,
        }
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            child.stdin.write(json.dumps(order).encode() + b"\n")
            child.stdin.flush()
        except BrokenPipeError:
            log.warning("job %s: its process ended before it read its order", self._claim.job_id)
        threading.Thread(target=self._listen, args=(child.stdout,), daemon=True).start()
        return child

    def _listen(self, stream: IO[bytes]) -> None:
        """Runs in a thread of its own: the pipe must be read while the database is slow."""
        with stream:
            for line in stream:
                try:
                    self._messages.put(json.loads(line, parse_constant=lambda _: None))  # NaN is no JSON
                except ValueError:
                    log.warning("job %s said something that is not JSON", self._claim.job_id)
        self._messages.put(None)

    def _watch(self, child: subprocess.Popen[bytes]) -> None:
        """Until the child's last words, or the end of its pipe."""
        next_beat = 0.0
        while self._ending is None:
            try:
                message = self._messages.get(timeout=max(0.01, min(0.2, next_beat - time.monotonic())))
            except queue.Empty:
                message = {}
            if message is None:
                return
            if message.get("kind") in ENDINGS:
                self._ending = message
            elif message:
                self._reporter.take(message)
            if time.monotonic() >= next_beat:
                next_beat = time.monotonic() + self._settings.heartbeat_seconds
                self._beat(child)
            self._mind(child)

    def _beat(self, child: subprocess.Popen[bytes]) -> None:
        orders = leases.beat(self._store, self._claim, self._reporter.flush(), self._settings.lease_seconds)
        if orders.cancel or orders.pause:
            self._ask(child)

    def _mind(self, child: subprocess.Popen[bytes]) -> None:
        now = time.monotonic()
        if self._stopping.is_set():
            self._ask(child)
        if now - self._reporter.moved_at > self._settings.stall_seconds:
            self._stalled = True
            signal_group(child, signal.SIGKILL)
        if self._asked_at is not None and now - self._asked_at > self._settings.grace_seconds:
            signal_group(child, signal.SIGKILL)

    def _ask(self, child: subprocess.Popen[bytes]) -> None:
        if self._asked_at is None and self._ending is None:
            self._asked_at = time.monotonic()
            signal_group(child, signal.SIGTERM)

    def _record(self, returncode: int) -> State:
        """Write the end of the attempt. A child that ended without last words was killed from outside."""
        batch = self._reporter.flush()
        leases.beat(self._store, self._claim, batch, self._settings.lease_seconds)
        ending = self._ending or {"kind": "died"}
        if ending["kind"] == "result":
            leases.succeed(self._store, self._claim, self._outcome(ending))
            return State.SUCCEEDED
        if ending["kind"] == "failed":
            return self._fail(Failure(ending["failure"]), f"{ending['message']}\n\n{ending['traceback']}")
        if self._stalled:
            return self._fail(Failure.INFRASTRUCTURE, f"no progress in {self._settings.stall_seconds:g} s")
        if ending["kind"] == "interrupted" or self._asked_at is not None:
            return leases.release(self._store, self._claim)
        return self._fail(Failure.INFRASTRUCTURE, describe_death(returncode))

    def _fail(self, kind: Failure, message: str) -> State:
        return leases.fail(self._store, self._claim, kind, message, self._settings.backoff_seconds)

    def _outcome(self, ending: Mapping[str, Any]) -> Outcome:
        found = ending["result"]
        root = self._store.artifacts_dir
        files = [artifacts.keep(root, name, Path(path)) for name, path in sorted(ending["artifacts"].items())]
        scores = [
            Score(s["camera"], s["frame"], metric, value)
            for s in found["scores"]
            for metric, value in s.items()
            if metric not in {"camera", "frame"}
        ]
        numbers = (found["gaussians"], found["train_seconds"], found["evaluate_seconds"])
        parts = (found["means"], found["per_camera"], found["protocol"], found["provenance"])
        return Outcome(*parts, *numbers, tuple(scores), tuple(files))


def end(child: subprocess.Popen[bytes], patience: float) -> None:
    """Wait ``patience`` seconds for ``child``, then leave no process of its session behind."""
    if child.stdin is not None:
        with contextlib.suppress(BrokenPipeError):
            child.stdin.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(patience)
    signal_group(child, signal.SIGKILL)
    child.wait()


def describe_death(returncode: int) -> str:
    """A sentence for a process that ended without a word."""
    if returncode < 0:
        return f"the job's process was killed by {signal.Signals(-returncode).name} from outside"
    return f"the job's process ended with status {returncode} and without a result; see its log"


def child_environment(settings: Settings) -> dict[str, str]:
    """Environment of a job. OpenMP and BLAS read theirs once, when the process starts, so it is set here."""
    threads = str(settings.threads)
    env = {key: value for key, value in os.environ.items() if key not in SECRETS}
    counts = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RSAVATAR_THREADS")
    env |= dict.fromkeys(counts, threads)
    return env | {"OMP_WAIT_POLICY": "passive", "MALLOC_ARENA_MAX": "2", "PYTHONUNBUFFERED": "1"}
