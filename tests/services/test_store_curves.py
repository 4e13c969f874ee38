from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import insert, update

from services.errors import NotFoundError
from services.store.curves import of_jobs, thin
from services.store.session import Store
from services.store.tables import JobRow, PointRow
from tests.services.conftest import submit


def test_a_spike_stays_however_short_the_curve_becomes() -> None:
    curve = [(step, 1.0) for step in range(10_000)]
    curve[7_777] = (7_777, 99.0)
    curve[3_333] = (3_333, -99.0)
    drawn = thin(curve, 100)
    assert len(drawn) <= 100
    assert {(7_777, 99.0), (3_333, -99.0), curve[0], curve[-1]} <= set(drawn)


def test_a_short_curve_is_itself() -> None:
    curve = [(1, 2.0), (2, 1.0), (4, 3.0)]
    assert thin(curve, 4) == curve
    assert thin([], 4) == []


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), st.integers(4, 50))
def test_what_is_drawn_is_of_the_curve_in_its_order_and_as_high_and_low(values: list[float], points: int) -> None:
    curve = list(enumerate(values))
    drawn = thin(curve, points)
    assert len(drawn) <= points
    assert drawn == sorted(set(drawn))
    assert set(drawn) <= set(curve)
    assert (drawn[0], drawn[-1]) == (curve[0], curve[-1])
    assert max(v for _, v in drawn) == max(values)
    assert min(v for _, v in drawn) == min(values)


def test_curves_of_several_jobs_and_of_a_reused_result(store: Store) -> None:
    first, second, reusing, silent = (submit(store).id for _ in range(4))
    with store.write() as session:
        rows = [
            {"job_id": job, "key": key, "step": step, "value": step * scale}
            for job, scale in ((first, 1.0), (second, 2.0))
            for key in ("loss", "psnr")
            for step in range(50)
        ]
        session.execute(insert(PointRow), rows)
        session.execute(update(JobRow).where(JobRow.id == reusing).values(reused_from=second))
    found = of_jobs(store, [second, first, reusing, silent], ["loss"], points=10)
    assert list(found) == [second, first, reusing, silent]
    assert list(found[first]) == ["loss"]
    assert (found[first]["loss"][-1], found[second]["loss"][-1]) == ((49, 49.0), (49, 98.0))
    assert found[reusing] == found[second]
    assert found[silent] == {}
    assert max(map(len, found[first].values())) <= 10
    assert set(of_jobs(store, [first])[first]) == {"loss", "psnr"}
    with pytest.raises(NotFoundError, match="job: expected the id of a job, got nobody"):
        of_jobs(store, [first, "nobody"])
