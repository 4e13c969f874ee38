"""Job ids: UUID version 7 (RFC 9562), so that ids sort by creation and keyset pages need no second column."""

from __future__ import annotations

import secrets
import threading
import time
import uuid

_lock = threading.Lock()
_last = 0


def new_id() -> str:
    """A UUIDv7: 48 bits of milliseconds, 12 bits of their fraction, 62 random bits; rising within a process."""
    global _last  # noqa: PLW0603  (the clock of ids is one per process)
    with _lock:
        _last = max((time.time_ns() << 12) // 1_000_000, _last + 1)
        ticks = _last
    value = (ticks >> 12 & (1 << 48) - 1) << 80 | 0x7 << 76 | (ticks & 0xFFF) << 64
    return str(uuid.UUID(int=value | 0b10 << 62 | secrets.randbits(62)))
