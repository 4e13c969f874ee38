"""The sweep: gives the jobs of dead workers back and wakes workers for jobs whose message was lost.

Every worker runs it in a thread; a lease in the database makes sure that one at a time does the duty.
"""

from __future__ import annotations

import logging
import socket
import threading
from pathlib import Path

from celery import Celery
from sqlalchemy.exc import SQLAlchemyError

from services import jobs
from services.process import is_surely_dead
from services.settings import Settings
from services.store import garbage, leases
from services.store.session import Store

DUTY, COLLECTION = "sweep", "gc"
MOST_WAKE_UPS = 100  # in one round

log = logging.getLogger(__name__)


def alive_file(settings: Settings) -> Path:
    """Touched by every round: its age says whether the worker of this host is alive, without asking the broker."""
    return settings.home / "run" / f"worker-{socket.gethostname()}.alive"


def sweep(settings: Settings, store: Store, app: Celery, owner: str) -> None:
    """One round. Does nothing while another worker has the duty."""
    dead = [other for other in leases.holders(store) if is_surely_dead(other)]
    if dead:  # needs no duty: the proof is local to this host, and taking back is fenced
        for job_id in leases.reclaim(store, dead):
            jobs.enqueue(app, job_id)
    if not leases.take_duty(store, DUTY, owner, 3.0 * settings.sweep_seconds + 5.0):
        return
    for job_id in leases.expire(store, settings.backoff_seconds):
        log.warning("job %s taken back from a silent worker", job_id)
    wake(settings, store, app)


def collect(settings: Settings, store: Store, owner: str) -> None:
    """Remove unnamed bytes, if no worker has for ``gc_hours``: the duty is kept until the next time."""
    if not settings.gc_hours or not leases.take_duty(store, COLLECTION, owner, 3600.0 * settings.gc_hours, renew=False):
        return
    found = garbage.collect(store, settings.home / "jobs", settings.gc_grace_seconds, dry_run=False)
    if found.blobs:
        log.info("removed %d blobs that nothing names, %.1f MB", found.blobs, found.bytes / 2**20)
    for sha256 in found.missing:
        log.warning("the bytes of artifact %s are gone", sha256)


def wake(settings: Settings, store: Store, app: Celery) -> None:
    """Send as many wake-ups as jobs wait beyond those that the broker holds: their number stays bounded."""
    waiting = leases.unclaimed(store, settings.unclaimed_seconds, MOST_WAKE_UPS)
    if not waiting:
        return
    try:
        missing = len(waiting) - jobs.backlog(app)
    except jobs.BROKER_ERRORS as error:
        log.warning("the broker is away: %s", error)
        return
    for job_id in waiting[: max(0, missing)]:
        jobs.enqueue(app, job_id)


def sweep_until(stopping: threading.Event, settings: Settings, store: Store, app: Celery, owner: str) -> None:
    """Sweep at once and then every ``sweep_seconds``, until ``stopping`` is set."""
    while True:
        try:
            alive_file(settings).touch()
            sweep(settings, store, app, owner)
            collect(settings, store, owner)
        except (SQLAlchemyError, OSError) as error:  # the database or disk may come back; the next round will see
            log.warning("sweep put off: %s", error)
        if stopping.wait(settings.sweep_seconds):
            return
