"""What the service's benchmark finds: figures, targets, and what others were measured at. Units are in the names."""

from __future__ import annotations

import os
import platform
import sqlite3
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from services.settings import ROOT

PACKAGES = ("fastapi", "uvicorn", "sqlalchemy", "celery", "pydantic")


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Machine(_Record):
    """What figures depend on besides the code."""

    commit: str  # of the checkout; "+" where tracked files were changed
    processor: str
    cores: int
    load: float  # runnable processes in the minute before; much above 0 means that timings were disturbed
    python: str
    sqlite: str
    packages: dict[str, str]


class Figure(_Record):
    """One number and what it is of."""

    name: str
    value: float
    unit: str


class Target(_Record):
    """A promise, and whether this run kept it."""

    name: str
    bound: float
    sense: Literal["at most", "at least"]
    measured: float
    unit: str

    @property
    def met(self) -> bool:
        """Whether the measurement lies on the right side of the bound."""
        return self.measured <= self.bound if self.sense == "at most" else self.measured >= self.bound


class Other(_Record):
    """What another service was measured at, elsewhere; above 1, ``ratio`` is in our favour."""

    what: str
    who: str
    theirs: float
    ours: float
    unit: str
    source: str

    @property
    def ratio(self) -> float:
        """How many times better we are."""
        return self.ours / self.theirs if self.unit == "1/s" else self.theirs / self.ours


class ServiceResult(_Record):
    """``python -m services.bench``."""

    kind: Literal["service"] = "service"
    machine: Machine
    command: str
    figures: list[Figure]
    targets: list[Target]
    others: list[Other]


def machine() -> Machine:
    """The machine as it is now."""
    return Machine(
        commit=_commit(),
        processor=_processor(),
        cores=len(os.sched_getaffinity(0)),
        load=round(os.getloadavg()[0], 2),
        python=platform.python_version(),
        sqlite=sqlite3.sqlite_version,
        packages={name: version(name) for name in PACKAGES},
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.machine()
    named = dict(line.replace("\t", "").split(": ", 1) for line in lines if ": " in line)
    return named.get("model name", platform.machine())


def _commit() -> str:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "services", "core/rsavatar")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
