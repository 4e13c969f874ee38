"""What a job's process may use, and how an attempt ends badly."""

from __future__ import annotations

from dataclasses import dataclass

from services.settings import Settings
from services.store.records import Claim, Failure


@dataclass(frozen=True)
class Limits:
    """Of one job: its own where it has some, else the settings'."""

    memory: int  # bytes; 0 = any
    stall: float  # seconds without progress

    @classmethod
    def of(cls, settings: Settings, claim: Claim) -> Limits:
        """The limits of a claimed job."""
        spec = claim.spec
        megabytes = spec.get("memory_limit_mb") or settings.memory_limit_mb
        return cls(megabytes << 20, spec.get("stall_seconds") or settings.stall_seconds)

    def broken(self, idle: float, size: int) -> str:
        """A sentence for the limit that a process breaks; nothing while it keeps them.

        Args:
            idle: seconds since it got somewhere.
            size: bytes that it has in memory.
        """
        if self.memory and size > self.memory:
            return f"memory: expected at most {self.memory >> 20} MB, got {size >> 20} MB"
        return f"no progress in {self.stall:g} s" if idle > self.stall else ""


@dataclass(frozen=True)
class Fault:
    """A bad end: its kind, a sentence, and what shows where it happened."""

    kind: Failure
    message: str
    traceback: str = ""
