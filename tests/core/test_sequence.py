"""The spline over the whole sequence: what it reproduces, and that it never jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rsavatar.motion.base import InitialMotion
from rsavatar.motion.sequence import SequenceSpline

N, PERIOD = 6, 11.0
MIDS = 16.0 + PERIOD * np.arange(N)


def initial(values: np.ndarray) -> InitialMotion:
    """``values`` [N] in every channel."""
    spread = np.repeat(values[:, None], 72, 1)
    return InitialMotion(spread, spread[:, :3], spread[:, :3], MIDS, PERIOD, PERIOD)


@pytest.mark.parametrize("knots", [1, 2, 3])
def test_a_steady_motion_is_reproduced_at_every_instant(knots: int) -> None:
    motion = SequenceSpline(initial(0.02 * (MIDS - 16.0)), knots)
    times = torch.linspace(10.5, MIDS[-1] + 5.5, 50, dtype=torch.float64)
    torch.testing.assert_close(motion.at(times).Th[:, 0].double(), 0.02 * (times - 16.0), atol=1e-5, rtol=0)


def test_a_noisy_fit_is_followed_to_a_fraction_of_its_noise() -> None:
    noise = 0.05 * np.random.default_rng(0).normal(size=N)
    motion = SequenceSpline(initial(noise), 1)
    error = motion.at(torch.tensor(MIDS)).Th[:, 0].detach().numpy() - noise
    assert np.abs(error).max() < 0.02


def test_one_frame_ends_where_the_next_begins() -> None:
    motion = SequenceSpline(initial(np.random.default_rng(1).normal(size=N)), 2)
    ends = torch.tensor([PERIOD / 2], dtype=torch.float64)
    for frame in range(N - 1):
        assert motion.state(frame, ends).Th.equal(motion.state(frame + 1, -ends).Th)


def test_speed_is_continuous_across_knots() -> None:
    motion = SequenceSpline(initial(np.random.default_rng(2).normal(size=N)), 1).double()
    knots = torch.tensor([motion.start + motion.spacing * k for k in range(2, 6)], dtype=torch.float64)
    h = 1e-4
    before = (motion.at(knots).Th - motion.at(knots - h).Th) / h
    after = (motion.at(knots + h).Th - motion.at(knots).Th) / h
    torch.testing.assert_close(before, after, atol=1e-4, rtol=0)


def test_one_frame_is_enough() -> None:
    single = initial(np.zeros(N))
    one = replace(single, poses=single.poses[:1], Rh=single.Rh[:1], Th=single.Th[:1], mid_frames=MIDS[:1])
    state = SequenceSpline(one).state(0, torch.tensor([-5.5, 0.0, 5.5], dtype=torch.float64))
    assert torch.isfinite(state.Th).all()
