"""Elapsed time of the parts of a job."""

from __future__ import annotations

import time
from typing import Self


class Stopwatch:
    """Wall-clock seconds spent inside ``with watch:`` blocks, added up; may be read while it runs."""

    def __init__(self) -> None:
        self._before = 0.0
        self._since: float | None = None

    def __enter__(self) -> Self:
        self._since = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._before, self._since = self.seconds, None

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self._before + (0.0 if self._since is None else time.perf_counter() - self._since)
