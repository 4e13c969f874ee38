"""Processes of this host: who one is, whether another still lives, and how it is ended."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path

import psutil

PR_SET_PDEATHSIG = 1
M_ARENA_MAX = -8


def identity() -> str:
    """``place:pid:start`` names this process so that others there can prove it dead, even if its pid is reused."""
    return f"{place()}:{os.getpid()}:{_start(os.getpid())}"


@cache
def place() -> str:
    """Where pids mean the same: the host, since its last start, and the name space of its pids."""
    if sys.platform != "linux":
        return socket.gethostname()
    boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    return f"{socket.gethostname()}-{boot[:8]}-{Path('/proc/self/ns/pid').stat().st_ino}"


def _start(pid: int) -> str:
    """When a process began, on a clock that nobody sets: ticks since the machine's start.

    Raises:
        psutil.NoSuchProcess: if there is none.
    """
    if sys.platform != "linux":
        return f"{psutil.Process(pid).create_time():.2f}"
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        raise psutil.NoSuchProcess(pid) from None
    state, *fields = stat.rpartition(")")[2].split()  # what precedes is the name, which may hold anything
    if state in {"Z", "X"}:
        raise psutil.NoSuchProcess(pid)
    return fields[18]


def is_surely_dead(owner: str) -> bool:
    """Whether ``owner`` (an ``identity``) ran here and is gone; False when that cannot be known here."""
    return _known(owner) is False


def is_alive(owner: str) -> bool:
    """Whether ``owner`` (an ``identity``) runs here; False when that cannot be known here."""
    return _known(owner) is True


def _known(owner: str) -> bool | None:
    where, _, rest = owner.partition(":")
    pid, _, start = rest.partition(":")
    if where != place() or not pid.isdecimal():
        return None
    try:
        return _start(int(pid)) == start
    except psutil.NoSuchProcess:
        return False


def share_arenas() -> None:
    """Let all threads of this process allocate from two heaps. One each, glibc's way, keeps what any of them freed."""
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(M_ARENA_MAX, 2)


def die_with_parent(signum: int = signal.SIGKILL) -> None:
    """Ask the kernel to send this process ``signum`` when the thread that started it ends. Linux; elsewhere nothing."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, int(signum), 0, 0, 0)


def terminate_with_parent() -> None:
    """``die_with_parent`` by SIGTERM, for ``preexec_fn`` of a process that has one thread."""
    die_with_parent(signal.SIGTERM)


def signal_group(process: subprocess.Popen[bytes], signum: int) -> None:
    """Send ``signum`` to the session that ``process`` leads; nothing if it is gone."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signum)


def stop(process: subprocess.Popen[bytes], grace: float) -> None:
    """SIGTERM, wait ``grace`` seconds, SIGKILL."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(grace)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
