"""The worker process: a Celery worker with a pool of threads; the sweeper and the examiner of subjects beside it."""

from __future__ import annotations

import logging
import threading
from typing import Any

from celery import Celery, signals

from services import jobs
from services.process import identity
from services.settings import Settings
from services.store import schema
from services.store.session import Store
from services.worker.checks import check_until
from services.worker.sweep import sweep_until
from services.worker.tasks import Crew, register

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


def create_worker(settings: Settings) -> tuple[Celery, Crew]:
    """A Celery application that knows the task, and what its tasks share.

    Raises:
        SchemaError: if the database is not at the version of this code.
    """
    store = Store(settings)
    schema.require_head(store)
    crew = Crew(settings, store, identity(), threading.Event())
    app = jobs.make_app(settings)
    register(app, crew)
    return app, crew


def serve(settings: Settings) -> None:
    """Work until SIGTERM. Then running jobs are asked for a checkpoint, given back, and the process ends.

    Raises:
        SchemaError: if the database is not at the version of this code.
    """
    logging.basicConfig(level=logging.INFO, format=FORMAT)
    app, crew = create_worker(settings)
    sweeper = threading.Thread(target=sweep_until, args=(crew.stopping, settings, crew.store, app, crew.owner))

    examiner = threading.Thread(target=check_until, args=(crew.stopping, settings, crew.store))

    def start_sweeping(**_: Any) -> None:
        sweeper.start()
        examiner.start()

    def stop_jobs(**_: Any) -> None:
        crew.stopping.set()

    signals.worker_ready.connect(start_sweeping, weak=False)
    signals.worker_shutting_down.connect(stop_jobs, weak=False)
    try:
        quiet = ("--without-gossip", "--without-mingle", "--without-heartbeat")  # nobody listens
        app.worker_main(["worker", "--pool=threads", *quiet, "--loglevel=INFO"])
    finally:
        crew.stopping.set()
        for thread in (sweeper, examiner):
            if thread.ident is not None:
                thread.join()
        crew.store.close()
