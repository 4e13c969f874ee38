"""A worker's hold on a job while the database comes and goes.

A heartbeat that cannot be delivered is kept and sent with the next one. The child trains on meanwhile, for as long as
the lease can still be ours: after that another worker may have the job, so this one must stop. An ending is offered for
longer: nobody can have taken the job while the database was away, and if somebody has since, the fence refuses us.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from services.errors import FencedError
from services.settings import Settings
from services.store import leases
from services.store.records import Batch, Claim, Orders
from services.store.session import OUTAGES, Store

Found = TypeVar("Found")
LONGEST_PAUSE = 5.0

log = logging.getLogger(__name__)


class Tenure:
    """Heartbeats of one claim."""

    def __init__(self, settings: Settings, store: Store, claim: Claim) -> None:
        self._settings = settings
        self._store = store
        self._claim = claim
        self._kept = Batch()
        self._renewed = time.monotonic()

    def beat(self, batch: Batch) -> Orders:
        """Renew the lease and store ``batch``, or keep it for the next time.

        Raises:
            FencedError: if the job was given away, or may have been by now.
        """
        self._kept = joined(self._kept, batch)
        begun = time.monotonic()
        try:
            orders = leases.beat(self._store, self._claim, self._kept, self._settings.lease_seconds)
        except OUTAGES as error:
            silence = time.monotonic() - self._renewed
            log.warning("job %s: no heartbeat for %.0f s: %s", self._claim.job_id, silence, first_line(error))
            if silence > self._settings.lease_seconds:
                raise FencedError("lease", "a heartbeat in its time", f"none in {silence:.0f} s") from error
            return Orders(cancel=False, pause=False)
        self._kept, self._renewed = Batch(), begun
        return orders

    def flush(self, batch: Batch) -> None:
        """``beat`` at the end of an attempt.

        Raises:
            FencedError: if the job was given away.
            sqlalchemy.exc.OperationalError and its like: if the database is away; what was said is kept.
        """
        self._kept = joined(self._kept, batch)
        leases.beat(self._store, self._claim, self._kept, self._settings.lease_seconds)
        self._kept = Batch()

    def insist(self, action: Callable[[], Found]) -> Found:
        """Do ``action``, again and again while the database is away, for ``outage_seconds``.

        Raises:
            FencedError: if the job was given away.
        """
        deadline = time.monotonic() + self._settings.outage_seconds
        pause = 0.2
        while True:
            try:
                return action()
            except OUTAGES as error:
                if time.monotonic() + pause > deadline:
                    raise
                log.warning("job %s: the database is away: %s", self._claim.job_id, first_line(error))
            time.sleep(pause)
            pause = min(LONGEST_PAUSE, 2.0 * pause)


def joined(first: Batch, second: Batch) -> Batch:
    """Both, in order; of looks, sizes and checkpoints the newest."""
    return Batch(
        [*first.events, *second.events],
        [*first.points, *second.points],
        [*first.artifacts, *second.artifacts],
        second.look or first.look,
        first.rss_bytes if second.rss_bytes is None else second.rss_bytes,
        second.checkpoint or first.checkpoint,
    )


def first_line(error: Exception) -> str:
    """What a driver says, without the statement that SQLAlchemy repeats after it."""
    return str(error).partition("\n")[0]
