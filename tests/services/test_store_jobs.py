from __future__ import annotations

import uuid
from collections.abc import Callable

import pytest

from services.errors import ConflictError, NotFoundError, RequestError
from services.store import events, jobs, leases
from services.store.ids import new_id
from services.store.records import Batch, Failure, Filters, Job, Outcome, State
from services.store.session import Store
from tests.services.conftest import submission, submit

RESULT = Outcome({"psnr": 20.0}, {}, {}, {}, 5, 1.0, 1.0)


def bring_to(store: Store, state: str) -> Job:
    """A job in ``state``, by the same calls that real life makes."""
    job = submit(store)
    if state == "paused":
        return jobs.pause(store, job.id)
    if state == "cancelled":
        return jobs.cancel(store, job.id)
    if state != "queued":
        claim = leases.claim(store, "owner", 60.0)
        assert claim is not None
        if state == "succeeded":
            leases.succeed(store, claim, RESULT)
        if state == "failed":
            leases.fail(store, claim, Failure.BUG, "broken", 0.0)
        while state == "dead" and leases.fail(store, claim, Failure.INFRASTRUCTURE, "died", 0.0) is not State.DEAD:
            claim = leases.claim(store, "owner", 60.0)
            assert claim is not None
    return jobs.get(store, job.id)


VERBS: dict[str, Callable[[Store, str], Job]] = {
    "cancel": jobs.cancel,
    "pause": jobs.pause,
    "resume": jobs.resume,
    "retry": jobs.retry,
}
AFTER = {  # (state, verb) -> state; what is missing is refused
    ("queued", "cancel"): "cancelled",
    ("queued", "pause"): "paused",
    ("running", "cancel"): "running",
    ("running", "pause"): "running",
    ("paused", "cancel"): "cancelled",
    ("paused", "pause"): "paused",
    ("paused", "resume"): "queued",
    ("cancelled", "cancel"): "cancelled",
    ("cancelled", "retry"): "queued",
    ("failed", "retry"): "queued",
    ("dead", "retry"): "queued",
}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("state", State)
def test_every_verb_in_every_state(store: Store, state: State, verb: str) -> None:
    job = bring_to(store, state)
    assert job.state == state
    wanted = AFTER.get((str(state), verb))
    if wanted is None:
        with pytest.raises(ConflictError, match=f"got {state}"):
            VERBS[verb](store, job.id)
        assert jobs.get(store, job.id).state == state
    else:
        assert VERBS[verb](store, job.id).state == wanted


def test_ids_are_version_7_and_rise() -> None:
    ids = [new_id() for _ in range(2000)]
    assert ids == sorted(set(ids))
    assert {uuid.UUID(i).version for i in ids} == {7}
    assert {uuid.UUID(i).variant for i in ids} == {uuid.RFC_4122}


def test_a_key_gives_one_job_and_refuses_another_request(store: Store) -> None:
    first, is_new = jobs.submit(store, submission(key="k"))
    again, is_new_again = jobs.submit(store, submission(key="k"))
    assert (is_new, is_new_again, again.id) == (True, False, first.id)
    with pytest.raises(RequestError, match="Idempotency-Key"):
        jobs.submit(store, submission(key="k", request="other"))


def test_pages_follow_each_other_without_gap_or_double(store: Store) -> None:
    ids = [submit(store, method="gauhuman" if n % 2 else "rs-avatar").id for n in range(7)]
    seen: list[str] = []
    cursor = None
    while page := jobs.page(store, Filters(), cursor, 3):
        seen += [job.id for job in page]
        cursor = seen[-1]
    assert seen == ids[::-1]
    assert len(jobs.page(store, Filters(method="rs-avatar", state="queued"), None, 50)) == 4


def test_retry_forgets_failures_but_never_the_attempt(store: Store) -> None:
    job = bring_to(store, "dead")
    fresh = jobs.retry(store, job.id)
    assert (job.failures, fresh.failures, fresh.error) == (3, 0, None)
    assert fresh.attempt == job.attempt


def test_events_tell_the_story_in_order(store: Store) -> None:
    job = bring_to(store, "succeeded")
    story = events.after(store, 0, job.id)
    assert [e.payload["state"] for e in story] == ["queued", "running", "succeeded"]
    assert [e.id for e in story] == sorted(e.id for e in story)
    assert events.after(store, story[0].id, job.id) == story[1:]
    assert events.newest_id(store) == story[-1].id


def test_orders_reach_the_worker_by_its_heartbeat(store: Store) -> None:
    submit(store)
    claim = leases.claim(store, "owner", 60.0)
    assert claim is not None
    assert not leases.beat(store, claim, Batch(), 60.0).cancel
    jobs.cancel(store, claim.job_id)
    assert leases.beat(store, claim, Batch(), 60.0).cancel
    assert leases.release(store, claim) is State.CANCELLED


def test_unknown_job(store: Store) -> None:
    with pytest.raises(NotFoundError, match="job: expected the id of a job"):
        jobs.get(store, "none")
