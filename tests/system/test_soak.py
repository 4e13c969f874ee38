"""The parts of the soak that need no service."""

from __future__ import annotations

import pytest

from rsavatar.grids.cells import expand
from services.store.records import Event
from tests.system import soak
from tests.system.checks import place_of
from tests.system.lives import life_of


def state(at: float, name: str, **details: object) -> Event:
    return Event("state", {"state": name, **details}, created_at=at)


def progress(at: float, fraction: float) -> Event:
    return Event("progress", {"fraction": fraction}, created_at=at)


def test_its_own_grid_has_a_thousand_jobs_of_twenty_results() -> None:
    cells = expand(soak.own_grid(soak.read([])))
    assert len(cells) == len({cell.spec.sha256() for cell in cells}) == 1000
    assert len({place_of({"place": cell.place}) for cell in cells}) == 20


def test_jobs_must_be_a_multiple_of_the_distinct_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        soak.read(["--jobs", "10", "--distinct", "4"])
    assert "expected a multiple of --distinct = 4, got 10" in capsys.readouterr().err


def test_a_loss_costs_the_time_until_the_job_is_where_it_was() -> None:
    told = [state(0, "queued"), state(1, "running"), progress(5, 0.0), progress(10, 0.5)]
    told += [state(12, "queued", reason="killed"), state(15, "running"), progress(20, 0.3), progress(25, 0.6)]
    life = life_of([*told, state(30, "succeeded")])
    assert (life.attempts, life.endings, life.waits, life.seconds_lost) == (2, ["succeeded"], [3.0], 15.0)


def test_losses_before_the_first_step_and_before_the_place_is_reached_again() -> None:
    loading = [state(1, "running"), state(4, "queued", reason="killed"), state(6, "running"), progress(9, 0.4)]
    assert life_of(loading).seconds_lost == 5.0
    twice = [state(10, "queued", reason="killed"), state(11, "running"), progress(14, 0.2)]
    twice += [state(15, "queued", reason="killed"), state(16, "running"), progress(22, 0.4), state(23, "succeeded")]
    assert life_of([*loading, *twice]).seconds_lost == 5.0 + 13.0
