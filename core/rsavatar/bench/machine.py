"""What a measurement was taken on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict

from rsavatar import kernels


class Machine(BaseModel):
    """Processor, software and load: what figures depend on besides the code."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    commit: str  # of the checkout; "+" where tracked files were changed; "unknown" for an installed package
    processor: str
    cores: int
    threads: int  # that the kernels used
    instructions: str  # build of the kernels: avx512, avx2 or generic
    lanes: int  # float32 values per vector
    load: float  # runnable processes in the minute before; much above 0 means that timings were disturbed
    python: str
    torch: str


def describe() -> Machine:
    """The machine as it is now, with the threads that the kernels use at the moment."""
    library = kernels.library()
    return Machine(
        commit=_commit(),
        processor=_processor(),
        cores=len(os.sched_getaffinity(0)),
        threads=kernels.threads(),
        instructions=Path(str(library._name)).stem.removeprefix("_kernels_"),
        lanes=int(library.rs_lanes()),
        load=round(os.getloadavg()[0], 2),
        python=platform.python_version(),
        torch=torch.__version__,
    )


def _processor() -> str:
    """The processor's name and model numbers; its architecture where the system does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    first = dict(line.replace("\t", "").split(": ", 1) for line in lines if ": " in line)
    name = first.get("model name", platform.machine())
    return f"{name} (family {first.get('cpu family', '?')}, model {first.get('model', '?')})"


def _commit() -> str:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "..", "../../native")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
