"""The process that trains one job: how it is started, and how nothing of it is left."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Mapping
from typing import IO, Any

from services.process import signal_group
from services.settings import ROOT, Settings, without_secrets


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


def launch(settings: Settings, order: Mapping[str, Any], log_file: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start the process that trains, in a session of its own, and hand it its order.

    Raises:
        OSError: if it cannot be started.
    """
    child = subprocess.Popen(
        settings.child_command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log_file,
        env=child_environment(settings),
        cwd=ROOT,
        start_new_session=True,
    )
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # it ended before it read: its exit status will say why
        child.stdin.write(json.dumps(order).encode() + b"\n")
        child.stdin.flush()
    return child


def child_environment(settings: Settings) -> dict[str, str]:
    """Environment of a job. OpenMP and BLAS read theirs once, when the process starts, so it is set here."""
    threads = str(settings.threads)
    env = without_secrets(os.environ)
    counts = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RSAVATAR_THREADS")
    env |= dict.fromkeys(counts, threads)
    return env | {"OMP_WAIT_POLICY": "passive", "MALLOC_ARENA_MAX": "2", "PYTHONUNBUFFERED": "1"}
