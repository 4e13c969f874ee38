"""How much memory a job's process has, and whether want of memory ended it."""

from __future__ import annotations

import contextlib
import resource
import signal
from pathlib import Path

import psutil

PAGE = resource.getpagesize()
FULL = 0.9  # of the limit: a process this large that dies without a word died of it
WORDS = (b"bad_alloc", b"MemoryError", b"can't allocate memory", b"Cannot allocate memory", b"OutOfMemoryError")
SUDDEN = frozenset({-signal.SIGKILL, -signal.SIGABRT, -signal.SIGSEGV, -signal.SIGBUS})


def resident(pid: int) -> int | None:
    """Bytes that a process has in memory; None if it is gone. Cheap, for it is asked after every word of a job."""
    with contextlib.suppress(OSError, ValueError, IndexError):  # not Linux, or just gone
        return int(Path(f"/proc/{pid}/statm").read_bytes().split()[1]) * PAGE
    try:
        return int(psutil.Process(pid).memory_info().rss)
    except psutil.Error:
        return None


def kernel_kills(root: Path = Path("/")) -> int:
    """How often the kernel has ended a process for want of memory: in our control group, else on this machine."""
    for file in (root / "sys/fs/cgroup/memory.events", root / "proc/vmstat"):
        try:
            lines = file.read_text("ascii").splitlines()
        except OSError:
            continue
        found = [int(line.split()[1]) for line in lines if line.split()[0] == "oom_kill"]
        if found:
            return found[0]
    return 0


def was_too_large(returncode: int, largest: int, limit: int, killed_more: bool, log_tail: bytes) -> bool:
    """Whether a process that ended without last words ended for want of memory.

    Args:
        largest: bytes it was last seen with.
        limit: bytes it was allowed, 0 = any.
        killed_more: whether the kernel has ended processes for want of memory while it ran.
    """
    if returncode not in SUDDEN:
        return False
    if returncode == -signal.SIGKILL and killed_more:
        return True
    return (limit > 0 and largest > FULL * limit) or any(word in log_tail for word in WORDS)
