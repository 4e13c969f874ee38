from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy.exc import SQLAlchemyError

from services.errors import FencedError
from services.store import artifacts, events, jobs, leases, metrics
from services.store import curves as thinned
from services.store.records import Batch, Claim, Event, Failure, Look, Outcome, Point, Score, State
from services.store.session import Store
from tests.services.conftest import submit

ON_BOTH_DATABASES = True

RESULT = Outcome({"psnr": 20.0}, {}, {}, {}, 5, 1.0, 1.0, (Score("01", 3, "psnr", 20.0),))


def take(store: Store, lease: float = 60.0, owner: str = "me") -> Claim:
    claim = leases.claim(store, owner, lease)
    assert claim is not None
    return claim


def test_claims_go_by_priority_then_age(store: Store) -> None:
    ids = [submit(store, priority=p).id for p in (0, 5, 5, -1)]
    assert [take(store).job_id for _ in ids] == [ids[1], ids[2], ids[0], ids[3]]
    assert leases.claim(store, "me", 60.0) is None


def test_many_claimants_get_every_job_once(store: Store) -> None:
    ids = {submit(store).id for _ in range(20)}
    with ThreadPoolExecutor(8) as pool:
        claims = list(pool.map(lambda n: leases.claim(store, f"worker {n}", 60.0), range(30)))
    taken = [claim.job_id for claim in claims if claim is not None]
    assert sorted(taken) == sorted(ids)


def test_a_silent_worker_loses_its_job_and_its_voice(store: Store) -> None:
    job = submit(store)
    old = take(store, lease=-1.0)
    assert leases.expire(store, 0.0) == [job.id]
    new = take(store)
    assert new.attempt == old.attempt + 1
    late = Batch([Event("note", {"text": "late"})], [Point("loss", 1, 9.0)])
    for write in (
        lambda: leases.beat(store, old, late, 60.0),
        lambda: leases.succeed(store, old, RESULT),
        lambda: leases.fail(store, old, Failure.BUG, "late", 0.0),
        lambda: leases.release(store, old),
    ):
        with pytest.raises(FencedError, match=job.id):
            write()
    assert jobs.get(store, job.id).state == "running"
    assert metrics.curves(store, job.id) == {}
    assert all(e.kind == "state" for e in events.after(store, 0, job.id))


def test_a_living_lease_is_left_alone(store: Store) -> None:
    submit(store)
    take(store)
    assert leases.expire(store, 0.0) == []


def test_heartbeat_renews_and_stores(store: Store) -> None:
    job = submit(store)
    claim = take(store, lease=-1.0)
    look = Look("train", 4, 10, 0.5, None, 77, 6.0)
    leases.beat(store, claim, Batch([Event("note", {"text": "hello"})], [Point("loss", 4, 0.5)], [], look), 60.0)
    leases.beat(store, claim, Batch(points=[Point("loss", 4, 0.25)]), 60.0)
    seen = jobs.get(store, job.id)
    assert (seen.step, seen.steps, seen.loss, seen.gaussians, seen.stage) == (4, 10, 0.5, 77, "train")
    assert metrics.curves(store, job.id) == {"loss": [(4, 0.25)]}
    assert leases.expire(store, 0.0) == []


def test_infrastructure_fails_again_and_again_then_dies_with_the_first_reason(store: Store) -> None:
    job = submit(store)
    states = [leases.fail(store, take(store), Failure.INFRASTRUCTURE, f"reason {n}", 0.0) for n in range(3)]
    assert states == [State.QUEUED, State.QUEUED, State.DEAD]
    dead = jobs.get(store, job.id)
    assert (dead.error, dead.failures, dead.lease_owner) == ("reason 0", 3, None)


@pytest.mark.parametrize("kind", [k for k in Failure if k is not Failure.INFRASTRUCTURE])
def test_what_would_fail_again_is_not_tried_again(store: Store, kind: Failure) -> None:
    job = submit(store)
    assert leases.fail(store, take(store), kind, "why", 0.0) is State.FAILED
    assert jobs.get(store, job.id).error_kind == kind


def test_back_off_holds_a_job_until_its_time(store: Store) -> None:
    job = submit(store)
    leases.fail(store, take(store), Failure.INFRASTRUCTURE, "why", 100.0)
    assert leases.claim(store, "me", 60.0) is None
    assert jobs.get(store, job.id).not_before > store.now() + 90.0


def test_result_and_state_come_together_or_not_at_all(store: Store) -> None:
    job = submit(store)
    claim = take(store)
    twice = (Score("01", 3, "psnr", 1.0), Score("01", 3, "psnr", 2.0))
    with pytest.raises(SQLAlchemyError):
        leases.succeed(store, claim, Outcome({}, {}, {}, {}, 5, 1.0, 1.0, twice))
    assert jobs.get(store, job.id).state == "running"
    leases.succeed(store, claim, RESULT)
    assert metrics.outcome_of(store, job.id).scores == RESULT.scores
    with pytest.raises(FencedError):
        leases.succeed(store, claim, RESULT)


def test_dead_owners_are_taken_back_at_once_and_others_are_not(store: Store) -> None:
    first, second = submit(store), submit(store)
    take(store, owner="dead")
    take(store, owner="alive")
    assert sorted(leases.holders(store)) == ["alive", "dead"]
    assert leases.reclaim(store, ["dead"]) == [first.id]
    assert jobs.get(store, second.id).state == "running"


def test_a_released_job_waits_again_without_a_failure(store: Store) -> None:
    job = submit(store)
    assert leases.release(store, take(store)) is State.QUEUED
    assert jobs.get(store, job.id).failures == 0
    jobs.pause(store, take(store).job_id)
    claim = Claim(job.id, jobs.get(store, job.id).attempt, {}, "studio")
    assert leases.release(store, claim) is State.PAUSED
    jobs.resume(store, job.id)
    assert not leases.beat(store, take(store), Batch(), 60.0).pause


def test_one_process_has_a_duty(store: Store) -> None:
    assert leases.take_duty(store, "sweep", "a", 60.0)
    assert not leases.take_duty(store, "sweep", "b", 60.0)
    assert leases.take_duty(store, "sweep", "a", -1.0)
    assert leases.take_duty(store, "sweep", "b", 60.0)


def test_unclaimed_jobs_are_found_by_age(store: Store) -> None:
    job = submit(store)
    assert leases.unclaimed(store, 60.0, 10) == []
    assert leases.unclaimed(store, 0.0, 10) == [job.id]


def test_curves_are_thinned_and_keep_their_ends(store: Store) -> None:
    job = submit(store)
    claim = take(store)
    leases.beat(store, claim, Batch(points=[Point("loss", n, 1.0 / n) for n in range(1, 5001)]), 60.0)
    curve = metrics.curves(store, job.id)["loss"]
    assert len(curve) <= thinned.POINTS
    assert (curve[0], curve[-1]) == ((1, 1.0), (5000, 1.0 / 5000))


def test_tables_see_the_newest_success_of_every_spec(store: Store) -> None:
    for spec_sha256, psnr in (("a" * 64, 10.0), ("b" * 64, 15.0), ("a" * 64, 20.0)):
        submit(store, spec_sha256=spec_sha256)
        leases.succeed(store, take(store), Outcome({"psnr": psnr}, {}, {}, {}, 5, 1.0, 1.0))
    submit(store)
    assert [entry.means["psnr"] for entry in metrics.table_entries(store)] == [15.0, 20.0]
    assert metrics.table_entries(store, "paper") == []


def test_artifacts_lie_under_their_hash(store: Store, tmp_path: Path) -> None:
    file = tmp_path / "picture.png"
    file.write_bytes(b"bytes")
    job = submit(store)
    first = artifacts.keep(store, "a", file)
    assert artifacts.keep(store, "b", file).sha256 == first.sha256
    leases.beat(store, take(store), Batch(artifacts=[first, first]), 60.0)
    found, path = artifacts.find(store, first.sha256)
    assert (found, path.read_bytes()) == (first, b"bytes")
    assert artifacts.of_job(store, job.id) == [first]
    assert len([p for p in store.artifacts_dir.rglob("*") if p.is_file()]) == 1
