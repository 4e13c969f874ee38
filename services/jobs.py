"""The wake-up: a Celery application whose only message is a job's id. The database is the queue of record.

A message may be lost or delivered twice without harm: the worker claims a row, not a message, and the sweeper sends
a new message for rows that nobody claims. The pool is of threads, because a thread only watches a process of its own
that trains. Settings about processes of a pool are for those who choose another pool; ours has none.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from celery import Celery
from kombu import Queue
from kombu.exceptions import OperationalError
from redis import RedisError

from services.settings import Settings

QUEUE = "jobs"
TASK = "rsavatar.run_job"
VISIBILITY_SECONDS = 172_800  # longer than any job: the lease is in the database, never in the broker
BROKER_ERRORS = (OperationalError, RedisError, OSError)
PUBLISH_POLICY = {"max_retries": 2, "interval_start": 0.0, "interval_step": 0.2, "interval_max": 0.5}

log = logging.getLogger(__name__)


def make_app(settings: Settings) -> Celery:
    """A Celery application for ``settings``; it knows no task bodies."""
    app = Celery("rsavatar", broker=settings.broker)
    app.conf.update(
        task_serializer="json",
        result_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        task_acks_late=True,
        task_retry_on_worker_lost=True,
        task_reject_on_worker_lost=True,
        task_track_started=False,
        task_default_queue=QUEUE,
        task_queues=[Queue(QUEUE)],
        task_create_missing_queues=False,
        task_send_sent_event=False,
        worker_pool="threads",
        worker_concurrency=settings.worker_concurrency,
        worker_prefetch_multiplier=1,
        worker_max_tasks_per_child=1,
        worker_pool_start_method="spawn",
        worker_soft_shutdown_timeout=settings.grace_seconds,
        worker_hijack_root_logger=False,
        worker_enable_remote_control=False,  # orders go through the database
        worker_cancel_long_running_tasks_on_connection_loss=False,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        visibility_timeout=VISIBILITY_SECONDS,
        broker_transport_options=_transport(),
        result_backend_transport_options={"visibility_timeout": VISIBILITY_SECONDS},
    )
    return app


def _transport() -> dict[str, Any]:
    return {
        "visibility_timeout": VISIBILITY_SECONDS,
        "socket_timeout": 30,
        "socket_connect_timeout": 5,
        "socket_keepalive": True,
        "health_check_interval": 25,
        "retry_on_timeout": True,
        "global_keyprefix": "rsavatar:",
    }


def enqueue(app: Celery, job_id: str) -> bool:
    """Wake a worker up for ``job_id``. False when the broker is away: the sweeper will send it again."""
    try:
        app.send_task(TASK, kwargs={"job_id": job_id}, queue=QUEUE, retry=True, retry_policy=PUBLISH_POLICY)
    except BROKER_ERRORS as error:
        log.warning("wake-up of job %s not sent, the sweeper will: %s", job_id, error)
        return False
    return True


def enqueue_many(app: Celery, job_ids: Sequence[str]) -> bool:
    """Wake workers up for many jobs over one connection. False when the broker is away: the sweeper will send them."""
    try:
        with app.producer_pool.acquire(block=True) as producer:
            for job_id in job_ids:
                app.send_task(TASK, kwargs={"job_id": job_id}, queue=QUEUE, producer=producer, retry=False)
    except BROKER_ERRORS as error:
        log.warning("wake-ups of %d jobs not sent, the sweeper will: %s", len(job_ids), error)
        return False
    return True


def backlog(app: Celery) -> int:
    """Wake-ups that wait in the broker.

    Raises:
        kombu.exceptions.OperationalError, redis.RedisError, OSError: if the broker is away.
    """
    with app.connection_for_write() as connection:
        connection.ensure_connection(max_retries=1, interval_start=0.1)
        return int(Queue(QUEUE)(connection.default_channel).queue_declare(passive=False).message_count)


def is_reachable(app: Celery) -> bool:
    """Whether the broker answers."""
    try:
        backlog(app)
    except BROKER_ERRORS:
        return False
    return True
