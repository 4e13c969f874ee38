"""Processes of this host: who one is, whether another still lives, and how it is ended."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys

import psutil

PR_SET_PDEATHSIG = 1
START_TOLERANCE = 0.02  # seconds; the kernel counts a start in hundredths


def identity() -> str:
    """``host:pid:start`` names this process so that others on the host can prove it dead, even if its pid is reused."""
    return f"{socket.gethostname()}:{os.getpid()}:{psutil.Process().create_time():.2f}"


def is_surely_dead(owner: str) -> bool:
    """Whether ``owner`` (an ``identity``) ran on this host and is gone; False when that cannot be known here."""
    host, _, rest = owner.rpartition(":")[0].rpartition(":")
    start = owner.rpartition(":")[2]
    if host != socket.gethostname() or not rest.isdecimal():
        return False
    try:
        process = psutil.Process(int(rest))
        return process.status() == psutil.STATUS_ZOMBIE or abs(process.create_time() - float(start)) > START_TOLERANCE
    except psutil.NoSuchProcess:
        return True


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
