"""The one task: on a wake-up, claim the most urgent job and supervise it to an end."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass

from celery import Celery

from services import jobs
from services.settings import Settings
from services.store import leases
from services.store.records import State
from services.store.session import Store
from services.worker.supervisor import Supervisor

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Crew:
    """What the tasks of one worker process share."""

    settings: Settings
    store: Store
    owner: str
    stopping: threading.Event


def register(app: Celery, crew: Crew) -> None:
    """Give ``app`` the body of the task."""

    @app.task(name=jobs.TASK)  # type: ignore[untyped-decorator]
    def run_job(job_id: str) -> None:
        """``job_id`` is a hint: a more urgent job may be taken, and its own wake-up will find this one."""
        work(app, crew)


def work(app: Celery, crew: Crew) -> State | None:
    """Claim and run one job. None when none waits (a duplicate wake-up), or when the job was given away."""
    if crew.stopping.is_set():
        return None
    claim = leases.claim(crew.store, crew.owner, crew.settings.lease_seconds)
    if claim is None:
        return None
    log.info("job %s, attempt %d", claim.job_id, claim.attempt)
    state = Supervisor(crew.settings, crew.store, claim, crew.stopping).run()
    log.info("job %s, attempt %d: %s", claim.job_id, claim.attempt, state or "given away")
    if state is State.QUEUED:
        jobs.enqueue(app, claim.job_id)
    return state
