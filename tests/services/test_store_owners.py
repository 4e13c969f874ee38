"""Whose turn it is, and how many jobs one owner may have."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.errors import QuotaError, RequestError
from services.settings import Settings
from services.store import jobs, leases, owners
from services.store.owners import Owner
from services.store.records import Failure, State, Submission
from services.store.session import Quota, Store
from tests.services.conftest import SPEC

ON_BOTH_DATABASES = True


def submit(store: Store, owner: str, **changes: object) -> str:
    job, _ = jobs.submit(store, Submission({**SPEC, **changes}, "a" * 64, "r", max_attempts=3, owner=owner))
    return job.id


def take(store: Store) -> str:
    claim = leases.claim(store, "worker", 60.0)
    assert claim is not None
    return jobs.get(store, claim.job_id).owner


def test_one_who_submits_many_delays_others_by_one_job(store: Store) -> None:
    for _ in range(6):
        submit(store, "many")
    submit(store, "few", priority=-10)
    submit(store, "few", priority=-10)
    assert [take(store) for _ in range(8)] == ["few", "many", "few", "many", "many", "many", "many", "many"]


def test_who_was_served_longest_ago_comes_first_among_equals(store: Store) -> None:
    for name in ("a", "b", "c"):
        submit(store, name)
        submit(store, name)
    served = []
    for _ in range(6):
        claim = leases.claim(store, "worker", 60.0)
        assert claim is not None
        served.append(jobs.get(store, claim.job_id).owner)
        leases.fail(store, claim, Failure.BUG, "over", 0.0)
    assert served == ["a", "b", "c", "a", "b", "c"]


def test_a_double_share_gets_two_workers_of_three(store: Store) -> None:
    owners.put(store, Owner("double", share=2.0))
    for _ in range(9):
        submit(store, "double")
        submit(store, "single")
    assert Counter(take(store) for _ in range(9)) == {"double": 6, "single": 3}


def test_a_running_quota_passes_the_turn_on(store: Store) -> None:
    owners.put(store, Owner("bounded", max_running=1))
    first = submit(store, "bounded")
    submit(store, "bounded")
    assert take(store) == "bounded"
    assert leases.claim(store, "worker", 60.0) is None
    submit(store, "other")
    assert take(store) == "other"
    claim = leases.Claim(first, 1, {}, "studio")
    leases.fail(store, claim, Failure.BUG, "over", 0.0)
    assert take(store) == "bounded"


def test_claims_at_once_keep_the_running_quota(store: Store) -> None:
    store.quota = Quota(queued=0, running=3)
    for _ in range(12):
        submit(store, "one")
    with ThreadPoolExecutor(8) as pool:
        claims = list(pool.map(lambda n: leases.claim(store, f"worker {n}", 60.0), range(12)))
    assert sum(claim is not None for claim in claims) == 3


def test_a_full_queue_refuses_and_an_ended_job_makes_room(store: Store) -> None:
    store.quota = Quota(queued=2, running=0)
    first = submit(store, "one")
    submit(store, "one")
    with pytest.raises(QuotaError, match="waiting jobs: expected at most 2 of one, got 2 and 1 more"):
        submit(store, "one")
    submit(store, "other")
    jobs.cancel(store, first)
    submit(store, "one")
    owners.put(store, Owner("one", max_queued=3))
    submit(store, "one")
    with pytest.raises(QuotaError, match="at most 3"):
        submit(store, "one")


def test_limits_that_make_no_sense_are_refused(store: Store) -> None:
    with pytest.raises(RequestError, match="max_running: expected 0 or more"):
        owners.put(store, Owner("one", max_running=-1))
    with pytest.raises(RequestError, match="share: expected a number above 0"):
        owners.put(store, Owner("one", share=0.0))
    assert owners.all_of(store) == []


def test_fifty_claimers_on_one_queue(settings: Settings, store: Store) -> None:
    waiting = {submit(store, f"owner {n % 3}", priority=n % 5) for n in range(60)}

    def work(number: int) -> list[str]:
        mine = Store(settings)  # connections of its own, as a process has
        claims = [leases.claim(mine, f"worker {number}", 60.0) for _ in range(2)]
        mine.close()
        return [claim.job_id for claim in claims if claim is not None]

    with ThreadPoolExecutor(50) as pool:
        taken = [job for some in pool.map(work, range(50)) for job in some]
    assert sorted(taken) == sorted(waiting)
    assert jobs.count_by_state(store)[State.RUNNING] == len(waiting)
