"""A subject, as the store hands it out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class SubjectState(StrEnum):
    """States of a subject; one that was uploaded is looked at before jobs may name it."""

    UPLOADED = "uploaded"
    CHECKING = "checking"
    READY = "ready"
    REFUSED = "refused"


@dataclass(frozen=True)
class Subject:
    """A registered subject; ``path`` is none for one that the core makes itself."""

    name: str
    path: str | None
    kind: str
    info: Mapping[str, Any] = field(default_factory=dict)
    created_at: float = 0.0
    owner: str = "local"
    state: str = "ready"
    size: int | None = None
