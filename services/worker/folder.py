"""The folder of a job on this machine before an attempt begins: no predecessor writes in it, and it holds the newest
checkpoint that anybody has stored.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import signal
from pathlib import Path

from services.process import is_alive
from services.store import checkpoints
from services.store.blobs import copy_verified
from services.store.session import Store

LOCK = ".lock"  # held by the one process that writes; holds its identity
STORED = "checkpoint.stored"  # where rsavatar.checkpoint looks for a copy from elsewhere
TAIL = 8192  # bytes

log = logging.getLogger(__name__)


def prepare(store: Store, job_id: str, folder: Path) -> list[str]:
    """Make ``folder`` ready for an attempt; returns sentences for the job's log."""
    folder.mkdir(parents=True, exist_ok=True)
    said = []
    if (pid := end_predecessor(folder)) is not None:
        said.append(f"ended process {pid} of an earlier attempt, which had lost the job and still wrote")
    return said + fetch_checkpoint(store, job_id, folder)


def end_predecessor(folder: Path) -> int | None:
    """Kill the process of this machine that still writes into ``folder``, with its session; returns its pid.

    It belongs to an earlier attempt, whose worker is dead or stopped: whoever calls this holds the job.
    """
    try:
        lock = (folder / LOCK).open("r", encoding="utf-8")
    except FileNotFoundError:
        return None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return None
        except BlockingIOError:
            holder = lock.read()
    if not is_alive(holder):  # on another machine, where we can prove nothing: the lock keeps us apart
        return None
    pid = int(holder.split(":")[1])
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    log.warning("ended process %d of an earlier attempt in %s", pid, folder)
    return pid


def fetch_checkpoint(store: Store, job_id: str, folder: Path) -> list[str]:
    """Lay the newest stored checkpoint that is whole into ``folder``, unless it is there already."""
    stored = checkpoints.newest(store, job_id)
    if not stored:
        return []
    here = {sha256_of(path) for path in folder.glob("checkpoint*") if path.is_file()}
    said: list[str] = []
    for checkpoint in stored:
        if checkpoint.sha256 in here:
            return said
        path = store.blobs.path(checkpoint.sha256)
        if path is not None and copy_verified(path, folder / STORED, checkpoint.sha256):
            return [*said, f"fetched the checkpoint of step {checkpoint.step}"]
        said.append(f"the stored checkpoint of step {checkpoint.step} is lost or damaged; trying the one before")
    return said


def sha256_of(path: Path) -> str:
    """Hash of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tail(path: Path) -> bytes:
    """The end of a file; nothing where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            return file.read()
    except OSError:
        return b""
