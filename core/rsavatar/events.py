"""What a running job says of itself: small frozen records, torch-free, in the order they happen.

``report(event)`` is the only channel out of a job. The CLI turns events into a progress bar, the worker into
rows of the ``events`` table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Note:
    """A sentence for a person: which body was found, what was skipped and why."""

    text: str


@dataclass(frozen=True)
class Progress:
    """One look at a stage of work (``train`` or ``evaluate``); ``loss`` and ``gaussians`` are of training."""

    stage: str
    step: int
    steps: int
    seconds: float
    loss: float | None = None
    psnr: float | None = None
    gaussians: int | None = None
    work: Mapping[str, float] | None = None  # of training: what the steps since the last look drew, and left out

    @property
    def eta_seconds(self) -> float:
        """Seconds left at the mean speed so far; 0 before the first step."""
        return self.seconds * (self.steps - self.step) / self.step if self.step else 0.0


@dataclass(frozen=True)
class Checkpointed:
    """A checkpoint is safely on disk: ``path`` is absolute, ``sha256`` is of the file."""

    step: int
    path: str
    sha256: str


@dataclass(frozen=True)
class Preview:
    """A picture for people, absolute path of a PNG."""

    step: int
    path: str
    caption: str


Event = Note | Progress | Checkpointed | Preview
Report = Callable[[Event], None]


def to_json(event: Event) -> dict[str, Any]:
    """``{"kind": "progress", ...fields}``; the inverse is not needed, readers only look."""
    fields = asdict(event)
    if isinstance(event, Progress):
        fields["eta_seconds"] = event.eta_seconds
    return {"kind": type(event).__name__.lower(), **fields}


def silent(event: Event) -> None:
    """A report that nobody listens to."""
