"""From accepted requests to rows and wake-ups, many at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from celery import Celery

from rsavatar.spec import JobSpec
from services import jobs as wake_up
from services.api.batches import Batches
from services.errors import NotFoundError, RequestError
from services.store import content, intake, subjects
from services.store.intake import Accepted
from services.store.records import State, Submission
from services.store.session import Store
from services.store.subject_records import Subject


@dataclass(frozen=True)
class Wish:
    """A job that somebody wants, before its subject has been looked at."""

    spec: JobSpec
    request_sha256: str
    owner: str
    key: str | None
    force: bool


class Intake:
    """Where requests hand their wishes in."""

    def __init__(self, store: Store, broker: Celery, max_attempts: int) -> None:
        self._store = store
        self._broker = broker
        self._max_attempts = max_attempts
        self._batches: Batches[Wish, Accepted] = Batches(self._write)
        self._wake_ups: Batches[str, None] = Batches(self._wake)
        self._sending: set[asyncio.Task[None]] = set()

    async def submit(self, wish: Wish) -> Accepted:
        """The job, and whether it is new.

        Raises:
            RequestError, QuotaError: as ``services.store.intake.submit``; RequestError for a subject that is unknown.
        """
        job, is_new = await self._batches.ask(wish)
        if is_new and job.state == State.QUEUED:  # nobody waits for the broker: what it loses, the sweeper sends again
            sending = asyncio.create_task(self._wake_ups.ask(job.id))
            self._sending.add(sending)
            sending.add_done_callback(self._sending.discard)
        return job, is_new

    def _wake(self, job_ids: Sequence[str]) -> list[None]:
        wake_up.enqueue_many(self._broker, job_ids)
        return [None] * len(job_ids)

    def _write(self, wishes: Sequence[Wish]) -> list[Accepted | Exception]:
        """Runs in a thread: it asks the database, and looks at files."""
        subjects_by_name: dict[str, Subject | RequestError] = {}
        answers: dict[int, Accepted | Exception] = {}
        ready: list[tuple[int, Submission]] = []
        for place, wish in enumerate(wishes):
            name = wish.spec.subject
            if name not in subjects_by_name:
                subjects_by_name[name] = self._subject(name)
            subject = subjects_by_name[name]
            if isinstance(subject, RequestError):
                answers[place] = subject
                continue
            try:
                ready.append((place, self._submission(wish, subject)))
            except RequestError as error:
                answers[place] = error
        outcomes = intake.submit_many(self._store, [submission for _, submission in ready])
        answers |= {place: outcome for (place, _), outcome in zip(ready, outcomes, strict=True)}
        return [answers[place] for place in range(len(wishes))]

    def _subject(self, name: str) -> Subject | RequestError:
        try:
            return subjects.get(self._store, name)
        except NotFoundError as error:
            return RequestError(error.name, error.expected, error.got)

    def _submission(self, wish: Wish, subject: Subject) -> Submission:
        return Submission(
            wish.spec.model_dump(mode="json", by_alias=True),
            spec_sha256=wish.spec.sha256(),
            request_sha256=wish.request_sha256,
            max_attempts=self._max_attempts,
            idempotency_key=wish.key,
            owner=wish.owner,
            content_sha256=content.content_sha256(self._store, wish.spec, subject),
            forced=wish.force,
        )
