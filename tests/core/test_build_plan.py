"""The builder's numbers as the paper states them, and its windows."""

from __future__ import annotations

import numpy as np
import pytest

from rsavatar.data.build_plan import Clock, trigger_offsets
from rsavatar.errors import DataError

PAPER = {617: 55, 646: 57, 654: 58, 556: 49, 658: 58, 859: 77}  # source frames -> output frames a view


def test_the_papers_sequences_give_354_frames_a_view() -> None:
    counts = {length: len(Clock().mids(length)) for length in PAPER}
    assert counts == PAPER
    assert sum(counts.values()) == 354


def test_the_papers_instants_and_seam() -> None:
    clock = Clock(11, 1.0)
    assert clock.instants(4) == 177
    assert clock.seam(60, 4) == pytest.approx(0.34, abs=0.005)
    assert {clock.recursion(D) for D in (44, 45, 52, 60)} == {4}
    assert clock.recursion(43.9) == 3  # 43.9 / 88 is below half a pixel, 44 / 88 is not
    assert clock.recursion(0) == 0


def test_windows_are_centred_on_a_real_frame_and_fit() -> None:
    for period, gamma, length in ((11, 1.0, 617), (5, 1.0, 41), (4, 0.5, 30), (11, 0.8, 60), (1, 1.0, 5)):
        clock = Clock(period, gamma)
        mids = clock.mids(length)
        assert mids[0] == period + period // 2
        assert set(np.diff(mids)) <= {period}
        assert mids[0] - clock.readout / 2 >= 0
        assert mids[-1] + clock.readout / 2 <= length - 1
        following = mids[-1] + period
        assert following + clock.readout / 2 > length - 1 or following // period >= length // period


def test_the_first_group_does_not_fit() -> None:
    assert 5 - Clock().readout / 2 < 0  # n = 0 has its mid at 5: the window would begin before the sequence
    assert Clock().mids(22) == []  # n = 1 ends at 21.5, after the last frame, 21
    assert Clock().mids(23) == [16]


def test_row_times() -> None:
    times = Clock(11, 1.0).row_times(16.0, 1024)
    assert times[0] == 10.5
    assert times[512] == 16.0
    assert times[-1] == pytest.approx(21.5 - 11 / 1024)
    quantised = Clock(11, 1.0).row_times(16.0, 1024, 16)
    assert np.abs(quantised - times).max() <= 1 / 32
    assert len(np.unique(quantised)) == 177
    assert (Clock(11, 0.0).row_times(16.0, 8) == 16).all()


def test_windows_of_triggered_cameras_fit_too() -> None:
    mids = Clock().mids(100, [0.0, -2.5, 2.5])
    assert mids[0] - 5.5 - 2.5 >= 0
    assert mids[-1] + 5.5 + 2.5 <= 99
    assert len(mids) == len(Clock().mids(100)) - 1


def test_trigger_offsets() -> None:
    assert trigger_offsets("0", ["a", "b"], 11, 0) == {"a": 0.0, "b": 0.0}
    drawn = trigger_offsets("random", ["a", "b", "c"], 11, 3)
    assert drawn == trigger_offsets("random", ["a", "b", "c"], 11, 3)
    assert drawn != trigger_offsets("random", ["a", "b", "c"], 11, 4)
    assert all(0 < abs(value) <= 11 / 4 for value in drawn.values())
    assert trigger_offsets({"a": 1, "b": -0.5, "x": 9}, ["a", "b"], 11, 0) == {"a": 1.0, "b": -0.5}
    with pytest.raises(DataError, match=r"none for \['b'\]"):
        trigger_offsets({"a": 1}, ["a", "b"], 11, 0)
    with pytest.raises(DataError, match="0, random or a table"):
        trigger_offsets("late", ["a"], 11, 0)


@pytest.mark.parametrize(("period", "gamma"), [(0, 1.0), (11, 1.2), (11, -0.1)])
def test_impossible_clocks(period: int, gamma: float) -> None:
    with pytest.raises(DataError, match="K and gamma"):
        Clock(period, gamma)


@pytest.mark.parametrize("displacement", [-1.0, float("nan"), float("inf"), 1e5])
def test_impossible_displacements(displacement: float) -> None:
    with pytest.raises(DataError, match="displacement D"):
        Clock().recursion(displacement)
