"""Calls that go together: each gets its own answer, in few batches, and one refusal concerns nobody else."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

import pytest

from services.api.batches import MOST, Batches
from services.errors import QuotaError, RequestError
from services.store import audit, intake, jobs, owners
from services.store.owners import Owner
from services.store.session import Store
from tests.services.conftest import submission
from tests.services.test_audit import entry


class Doubling:
    """Takes a while for every batch, and remembers how large each was."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def __call__(self, items: Sequence[int]) -> list[int | Exception]:
        time.sleep(0.01)
        self.sizes.append(len(items))
        return [ValueError(item) if item % 10 == 7 else 2 * item for item in items]


def test_every_call_has_its_answer_and_few_batches_are_written() -> None:
    work = Doubling()

    async def run() -> list[int | BaseException]:
        batches: Batches[int, int] = Batches(work)
        return await asyncio.gather(*map(batches.ask, range(200)), return_exceptions=True)

    answers = asyncio.run(run())
    for item, answer in enumerate(answers):
        if item % 10 == 7:
            assert isinstance(answer, ValueError)
        else:
            assert answer == 2 * item
    assert sum(work.sizes) == 200
    assert max(work.sizes) == MOST
    assert len(work.sizes) <= 5


def test_a_call_alone_waits_for_nobody_and_a_broken_batch_tells_all() -> None:
    def broken(items: Sequence[int]) -> list[int | Exception]:
        raise OSError("disk")

    async def run() -> None:
        work = Doubling()
        alone: Batches[int, int] = Batches(work)
        assert [await alone.ask(1), await alone.ask(2)] == [2, 4]
        assert work.sizes == [1, 1]
        for answer in await asyncio.gather(*map(Batches(broken).ask, range(3)), return_exceptions=True):
            assert isinstance(answer, OSError)

    asyncio.run(run())


def test_a_client_that_leaves_disturbs_nobody() -> None:
    async def run() -> None:
        batches: Batches[int, int] = Batches(Doubling())
        leaving, staying = (asyncio.create_task(batches.ask(n)) for n in (1, 2))
        await asyncio.sleep(0)
        leaving.cancel()
        assert await staying == 4
        with pytest.raises(asyncio.CancelledError):
            await leaving

    asyncio.run(run())


def test_submissions_of_one_batch_have_their_own_outcomes(store: Store) -> None:
    owners.put(store, Owner("local", max_queued=3))
    first, is_new = intake.submit(store, submission(key="a"))
    assert is_new
    asked = [submission(key="a"), submission(key="b"), submission(key="b"), submission(key="a", request="other")]
    again, fresh, twice, refused, last, beyond = intake.submit_many(store, [*asked, submission(), submission()])
    assert again == (first, False)
    assert not isinstance(fresh, Exception)
    assert fresh[1]
    assert not isinstance(twice, Exception)
    assert (twice[0].id, twice[1]) == (fresh[0].id, False)
    assert isinstance(refused, RequestError)
    assert not isinstance(last, Exception)
    assert jobs.get(store, last[0].id) == last[0]
    assert isinstance(beyond, QuotaError)
    assert str(beyond) == "waiting jobs: expected at most 3 of local, got 3 and 1 more"
    assert jobs.count_by_state(store)["queued"] == 3


def test_entries_of_one_batch_are_chained(store: Store) -> None:
    single = audit.append(store, entry(0))
    first, second = audit.append_many(store, [entry(1), entry(2)])
    assert (first.previous_sha256, second.previous_sha256) == (single.sha256, first.sha256)
    assert (first.entry, second.entry) == (entry(1), entry(2))
    assert audit.verify(store) == audit.Verdict(3, second.sha256, None)
