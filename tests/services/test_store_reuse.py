"""The same spec on the same data and code is computed once."""

from __future__ import annotations

import pytest

from services.store import artifacts, jobs, leases, metrics
from services.store.records import Artifact, Claim, Failure, Job, Outcome, Score, State, Submission
from services.store.session import Store
from tests.services.conftest import SPEC

ON_BOTH_DATABASES = True

SAME, OTHER = "c" * 64, "d" * 64
FILE = Artifact("final", "e" * 64, "application/json", 3)
RESULT = Outcome({"psnr": 20.0}, {}, {}, {}, 5, 1.0, 1.0, (Score("01", 3, "psnr", 20.0),), (FILE,))


def submit(store: Store, content: str | None = SAME, **changes: object) -> Job:
    about = {"max_attempts": 3, "content_sha256": content, **changes}
    return jobs.submit(store, Submission(SPEC, "a" * 64, "r", **about))[0]  # type: ignore[arg-type]


def take(store: Store) -> Claim:
    claim = leases.claim(store, "worker", 60.0)
    assert claim is not None
    return claim


def test_a_finished_twin_gives_its_result_at_once(store: Store) -> None:
    first = submit(store)
    leases.succeed(store, take(store), RESULT)
    second = submit(store)
    assert (second.state, second.reused_from, second.attempt, second.psnr) == ("succeeded", first.id, 0, 20.0)
    assert second.finished_at is not None
    assert metrics.outcome_of(store, second.id).means == RESULT.means
    assert artifacts.of_job(store, second.id) == [FILE]
    assert leases.claim(store, "worker", 60.0) is None
    third = submit(store)
    assert third.reused_from == first.id  # the job that computed it, not the one that copied it


@pytest.mark.parametrize("changes", [{"content": OTHER}, {"content": None}, {"forced": True}])
def test_other_contents_unknown_ones_and_forced_jobs_run(store: Store, changes: dict[str, object]) -> None:
    submit(store)
    leases.succeed(store, take(store), RESULT)
    job = submit(store, **changes)  # type: ignore[arg-type]
    assert (job.state, job.reused_from) == ("queued", None)
    assert take(store).job_id == job.id


def test_twins_of_a_running_job_wait_and_end_with_it(store: Store) -> None:
    first, second, third = submit(store), submit(store, owner="other"), submit(store, forced=True)
    claim = take(store)
    assert claim.job_id == first.id
    assert take(store).job_id == third.id
    assert leases.claim(store, "worker", 60.0) is None
    leases.succeed(store, claim, RESULT)
    ended = jobs.get(store, second.id)
    assert (ended.state, ended.reused_from, ended.attempt) == ("succeeded", first.id, 0)


def test_when_the_running_twin_fails_the_next_one_runs(store: Store) -> None:
    submit(store)
    second = submit(store)
    leases.fail(store, take(store), Failure.BUG, "broken", 0.0)
    assert take(store).job_id == second.id


def test_a_result_known_between_submission_and_claim_is_taken(store: Store) -> None:
    first = submit(store)
    paused = submit(store)
    jobs.pause(store, paused.id)
    leases.succeed(store, take(store), RESULT)
    jobs.resume(store, paused.id)
    assert leases.claim(store, "worker", 60.0) is None
    assert jobs.get(store, paused.id).reused_from == first.id


def test_a_result_counts_for_the_content_that_was_really_used(store: Store) -> None:
    submit(store)
    leases.succeed(store, take(store), RESULT, content_sha256=OTHER)
    assert submit(store).state == State.QUEUED
    assert submit(store, OTHER).state == State.SUCCEEDED


def test_idempotency_keys_are_their_owners(store: Store) -> None:
    first = submit(store, idempotency_key="k")
    assert submit(store, idempotency_key="k").id == first.id
    assert submit(store, idempotency_key="k", owner="other").id != first.id


def test_the_first_traceback_stays_until_a_replay(store: Store) -> None:
    job = submit(store, content=None)
    for n in range(3):
        leases.fail(store, take(store), Failure.INFRASTRUCTURE, f"message {n}", 0.0, f"traceback {n}")
    dead = jobs.get(store, job.id)
    assert (dead.state, dead.error, dead.first_traceback) == ("dead", "message 0", "traceback 0")
    fresh = jobs.retry(store, job.id)
    assert (fresh.state, fresh.failures, fresh.first_traceback) == ("queued", 0, None)
