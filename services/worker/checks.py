"""Looks at uploaded subjects, each in a process of its own: what it reads came from somebody else.

The process is ``rsavatar data check``, whose readers run nothing that a pickle names; it may not grow beyond a limit of
memory and time, and whatever end it takes is a verdict.
"""

from __future__ import annotations

import json
import logging
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from sqlalchemy.exc import SQLAlchemyError

from services.process import identity, is_surely_dead, signal_group
from services.settings import ROOT, Settings
from services.store import subjects
from services.store.ids import new_id
from services.store.session import Store
from services.store.subject_records import Subject, SubjectState
from services.worker.launch import child_environment

EXAMINER = """
import sys
from services.process import die_with_parent
die_with_parent()
from rsavatar.cli import main
sys.exit(main(["data", "check", sys.argv[1], "--json"]))
"""
LOOK_SECONDS = 1.0
MARGIN_SECONDS = 30.0  # of the claim, beyond the time that a check may take
MEMORY_MB = 4096  # where the settings name no limit
LONGEST_REPORT = 1 << 20  # bytes
LONGEST_WORDS = 1000  # characters of a broken check's last words

log = logging.getLogger(__name__)

Report = Sequence[dict[str, str]]


def check_until(stopping: threading.Event, settings: Settings, store: Store) -> None:
    """Look at one subject after another until ``stopping`` is set."""
    while not stopping.wait(LOOK_SECONDS):
        try:
            while check_next(settings, store, stopping):
                pass
        except (SQLAlchemyError, OSError) as error:  # the database or disk may come back
            log.warning("check of subjects put off: %s", error)


def check_next(settings: Settings, store: Store, stopping: threading.Event) -> bool:
    """Look at the oldest uploaded subject; False if there is none."""
    claim = f"{new_id()} {identity()}"
    seconds = settings.check_seconds + MARGIN_SECONDS
    subject = subjects.claim_check(store, claim, seconds, lambda owner: is_surely_dead(owner.partition(" ")[2]))
    if subject is None:
        return False
    found = examine(settings, subject, stopping)
    if found is None:
        subjects.finish_check(store, subject.name, claim, SubjectState.UPLOADED, [])
        return False
    fit, report = found
    state = SubjectState.READY if fit else SubjectState.REFUSED
    subjects.finish_check(store, subject.name, claim, state, report)
    log.info("subject %s: %s", subject.name, state)
    return True


def examine(settings: Settings, subject: Subject, stopping: threading.Event) -> tuple[bool, Report] | None:
    """Whether a subject is fit for training, and all findings; None if this worker had to stop first."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(
            [sys.executable, "-c", EXAMINER, str(subject.path)],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=errors,
            env=child_environment(settings),
            cwd=ROOT,
            start_new_session=True,
        )
        limit_memory(child.pid, settings.memory_limit_mb or MEMORY_MB)
        try:
            ended = wait(child, settings.check_seconds, stopping)
        finally:
            signal_group(child, signal.SIGKILL)
            child.wait()
        if not ended and stopping.is_set():
            return None
        got = describe(child.returncode, errors) if ended else f"none in {settings.check_seconds:g} s"
        return verdict(read_tail(out, LONGEST_REPORT), Path(str(subject.path))) or (False, [broken(got)])


def wait(child: subprocess.Popen[bytes], seconds: float, stopping: threading.Event) -> bool:
    """Whether ``child`` has ended by itself."""
    deadline = time.monotonic() + seconds
    while child.poll() is None:
        if time.monotonic() > deadline or stopping.wait(0.05):
            return False
    return True


def limit_memory(pid: int, megabytes: int) -> None:
    """Limit the data of a process that has just started. Linux; elsewhere nothing."""
    if sys.platform == "linux":
        try:
            resource.prlimit(pid, resource.RLIMIT_DATA, (megabytes << 20, megabytes << 20))
        except ProcessLookupError:
            log.debug("process %d has ended already", pid)


def verdict(said: bytes, root: Path) -> tuple[bool, Report] | None:
    """What the check has said; none if it is no report. Places on this machine are left out."""
    try:
        answer: Any = json.loads(said.splitlines()[-1])
        report = [{str(k): str(v).replace(f"{root}/", "") for k, v in f.items()} for f in answer["findings"]]
        return bool(answer["ok"]), report
    except (ValueError, IndexError, KeyError, TypeError, AttributeError):
        return None


def broken(got: str) -> dict[str, str]:
    """The finding about a check that came to no end."""
    hint = "a file that no reader can bear?"
    return {"severity": "error", "what": "check", "expected": "a report", "got": got, "hint": hint}


def describe(status: int, errors: IO[bytes]) -> str:
    """How a check ended that gave no report."""
    words = read_tail(errors, LONGEST_WORDS).decode("utf-8", "replace").strip()
    end = f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"
    return f"{end}: {words.splitlines()[-1]}" if words else end


def read_tail(file: IO[bytes], most: int) -> bytes:
    """The last bytes of a file."""
    file.seek(max(0, file.seek(0, 2) - most))
    return file.read()
