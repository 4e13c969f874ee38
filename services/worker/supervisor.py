"""One attempt at one job: starts the process that trains, keeps the lease while it moves, ends it, records the end."""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import signal
import subprocess
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import IO, Any

from rsavatar.spec import JobSpec
from services.errors import FencedError, RequestError, ServiceError
from services.process import signal_group
from services.settings import Settings
from services.store import artifacts, leases, subjects
from services.store.content import content_sha256
from services.store.records import Claim, Failure, Outcome, Score, State
from services.store.session import OUTAGES, Store
from services.worker import folder, memory
from services.worker.launch import describe_death, end, launch
from services.worker.limits import Fault, Limits
from services.worker.reporter import Reporter
from services.worker.tenure import Tenure, first_line

ENDINGS = frozenset({"result", "failed", "interrupted"})
PLAIN = json.JSONDecoder(parse_constant=lambda _: None)  # NaN is no JSON
LAST_WORDS_SECONDS = 5.0  # for the pipe to drain after the process has ended
FROZEN_SECONDS = 1.0  # longest time between two looks of a worker that runs
STACKS_SECONDS = 0.5  # for a process that hangs to write where, before it is killed

log = logging.getLogger(__name__)


class Supervisor:
    """Runs one claimed job to one of its ends. ``stopping`` is set when the worker is to go."""

    def __init__(self, settings: Settings, store: Store, claim: Claim, stopping: threading.Event) -> None:
        self._settings = settings
        self._store = store
        self._claim = claim
        self._stopping = stopping
        self._out = settings.job_dir(claim.job_id)
        self._limits = Limits.of(settings, claim)
        self._tenure = Tenure(settings, store, claim)
        self._messages: queue.Queue[Mapping[str, Any] | None] = queue.Queue()
        self._reporter = Reporter(partial(artifacts.keep, store))
        self._kills = memory.kernel_kills()
        self._largest = 0
        self._looked_at = time.monotonic()
        self._ending: Mapping[str, Any] | None = None
        self._asked_at: float | None = None  # when the child was asked to stop
        self._too_much = ""  # why the child was killed by us
        self._content: str | None = None

    def run(self) -> State | None:
        """Train, and return the state that the job reached; None when it was given away meanwhile."""
        try:
            return self._tenure.insist(self._guarded(self._attempt))
        except FencedError as error:
            log.warning("stopped: %s", error)
        except OUTAGES as error:
            log.error("job %s is left to its lease: %s", self._claim.job_id, first_line(error))
        return None

    def _guarded(self, part: Callable[[], Callable[[], State]]) -> Callable[[], State]:
        """The ending that ``part`` leads to; where this machine fails us, a failed attempt."""
        try:
            return part()
        except FencedError:
            raise
        except (OSError, ServiceError) as error:
            log.exception("job %s", self._claim.job_id)
            fault = Fault(Failure.INFRASTRUCTURE, f"{type(error).__name__}: {error}", traceback.format_exc())
            return partial(self._fail, fault)

    def _attempt(self) -> Callable[[], State]:
        for sentence in folder.prepare(self._store, self._claim.job_id, self._out):
            self._reporter.note(sentence)
        with (self._out / "log.txt").open("ab") as log_file:
            child = self._start(log_file)
            patience = 0.0
            try:
                self._watch(child)
                patience = LAST_WORDS_SECONDS
            finally:
                end(child, patience)
        return partial(self._record, child.returncode)

    def _start(self, log_file: IO[bytes]) -> subprocess.Popen[bytes]:
        subject = subjects.get(self._store, self._claim.subject)
        with contextlib.suppress(RequestError):  # a subject that cannot be read is the job's to explain
            self._content = content_sha256(self._store, JobSpec.model_validate(self._claim.spec), subject)
        order = {
            "spec": dict(self._claim.spec),
            "out": str(self._out),
            "subject_dir": subject.path,
            "memory_limit_mb": self._limits.memory >> 20,
        }
        child = launch(self._settings, order, log_file)
        assert child.stdout is not None
        threading.Thread(target=self._listen, args=(child.stdout,), daemon=True).start()
        return child

    def _listen(self, stream: IO[bytes]) -> None:
        """Runs in a thread of its own: the pipe must be read while the database is slow."""
        with stream:
            for line in stream:
                try:
                    self._messages.put(PLAIN.decode(line.decode()))
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
            self._mind(child)
            if time.monotonic() >= next_beat and not self._too_much:
                next_beat = time.monotonic() + self._settings.heartbeat_seconds
                self._beat(child)

    def _beat(self, child: subprocess.Popen[bytes]) -> None:
        orders = self._tenure.beat(self._reporter.flush(memory.resident(child.pid)))
        if orders.cancel or orders.pause:
            self._ask(child)

    def _mind(self, child: subprocess.Popen[bytes]) -> None:
        """Ask the child to stop, or kill it, where there is a reason; a killed child ends its pipe."""
        now = time.monotonic()
        if (
            gap := now - self._looked_at
        ) > FROZEN_SECONDS:  # we were stopped, or the database kept us: no fault of the child
            self._reporter.moved_at += gap
        if self._stopping.is_set():
            self._ask(child)
        self._largest = memory.resident(child.pid) or self._largest
        too_much = self._limits.broken(now - self._reporter.moved_at, self._largest)
        if too_much and not self._too_much:
            self._too_much = too_much
            child.send_signal(signal.SIGUSR1)  # its stacks go into the log
            time.sleep(STACKS_SECONDS)
            signal_group(child, signal.SIGKILL)
        if self._asked_at is not None and now - self._asked_at > self._settings.grace_seconds:
            signal_group(child, signal.SIGKILL)
        self._looked_at = time.monotonic()

    def _ask(self, child: subprocess.Popen[bytes]) -> None:
        if self._asked_at is None and self._ending is None:
            self._asked_at = time.monotonic()
            signal_group(child, signal.SIGTERM)

    def _record(self, returncode: int) -> State:
        """Write the end of the attempt. A child that ended without last words was killed from outside."""
        self._tenure.flush(self._reporter.flush())
        ending = self._ending or {"kind": "died"}
        if ending["kind"] == "result":
            return self._guarded(partial(self._success, ending))()
        if ending["kind"] == "failed":
            fault = Fault(
                Failure(ending["failure"]), f"{ending['message']}\n\n{ending['traceback']}", ending["traceback"]
            )
            return self._fail(fault)
        if not self._too_much and (ending["kind"] == "interrupted" or self._asked_at is not None):
            return leases.release(self._store, self._claim)
        return self._fail(self._death(returncode))

    def _success(self, ending: Mapping[str, Any]) -> Callable[[], State]:
        leases.succeed(self._store, self._claim, self._outcome(ending), self._content)
        return lambda: State.SUCCEEDED

    def _death(self, returncode: int) -> Fault:
        """Why the child ended without last words; the end of its log has its stacks, if it could write them."""
        last = folder.tail(self._out / "log.txt")
        words = self._too_much or describe_death(returncode)
        too_large = memory.was_too_large(
            returncode, self._largest, self._limits.memory, memory.kernel_kills() > self._kills, last
        )
        kind = Failure.OUT_OF_MEMORY if too_large or self._largest > self._limits.memory > 0 else Failure.INFRASTRUCTURE
        seen = f"{words}; last seen with {self._largest >> 20} MB of memory" if self._largest else words
        return Fault(kind, seen, last.decode("utf-8", "replace"))

    def _fail(self, fault: Fault) -> State:
        return leases.fail(
            self._store, self._claim, fault.kind, fault.message, self._settings.backoff_seconds, fault.traceback
        )

    def _outcome(self, ending: Mapping[str, Any]) -> Outcome:
        found = ending["result"]
        files = [artifacts.keep(self._store, name, Path(path)) for name, path in sorted(ending["artifacts"].items())]
        scores = [
            Score(s["camera"], s["frame"], metric, value)
            for s in found["scores"]
            for metric, value in s.items()
            if metric not in {"camera", "frame"}
        ]
        numbers = (found["gaussians"], found["train_seconds"], found["evaluate_seconds"])
        parts = (found["means"], found["per_camera"], found["protocol"], found["provenance"])
        return Outcome(*parts, *numbers, tuple(scores), tuple(files))
