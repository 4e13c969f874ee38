"""What every motion in the catalogue promises (``AbstractMotion``)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from rsavatar.catalog import MOTIONS, load
from rsavatar.motion.base import AbstractMotion, BodyState, InitialMotion
from rsavatar.motion.sequence import SequenceSpline
from rsavatar.motion.spline import FrameSpline
from rsavatar.motion.still import StillPose

BUILD: dict[str, Callable[[InitialMotion], AbstractMotion]] = {
    "still": StillPose,
    "sequence-spline": SequenceSpline,
    "frame-spline": lambda initial: FrameSpline(initial, bands=11),
}
FRAMES, PERIOD = 4, 11.0


def test_every_motion_of_the_catalogue_is_under_contract() -> None:
    assert set(BUILD) == set(MOTIONS)
    assert {load(MOTIONS, name) for name in BUILD} == {StillPose, FrameSpline, SequenceSpline}


@pytest.fixture(params=sorted(BUILD))
def motion(request: pytest.FixtureRequest) -> AbstractMotion:
    random = np.random.default_rng(0)
    initial = InitialMotion(
        poses=0.3 * random.normal(size=(FRAMES, 72)),
        Rh=random.normal(size=(FRAMES, 3)),
        Th=random.normal(size=(FRAMES, 3)),
        mid_frames=np.arange(5.0, 5 + PERIOD * FRAMES, PERIOD),
        period_frames=PERIOD,
        readout_frames=PERIOD,
    )
    return BUILD[request.param](initial)


def fields(state: BodyState) -> tuple[torch.Tensor, ...]:
    return state.rotations, state.Rh, state.Th


class TestMotionContract:
    def test_shapes_follow_the_offsets(self, motion: AbstractMotion) -> None:
        for count in (1, 4):
            state = motion.state(0, torch.linspace(-5, 5, count))
            assert [tuple(f.shape) for f in fields(state)] == [(count, 24, 3), (count, 3), (count, 3)]
        assert motion.at(torch.zeros(2, 5)).rotations.shape == (2, 5, 24, 3)

    def test_parameters_are_contiguous_as_those_of_a_checkpoint(self, motion: AbstractMotion) -> None:
        assert all(parameter.is_contiguous() for parameter in motion.parameters())

    def test_root_rotation_is_zero(self, motion: AbstractMotion) -> None:
        assert float(motion.state(1, torch.linspace(-5, 5, 3)).rotations[:, 0].detach().abs().max()) == 0

    def test_absolute_times_read_the_nearest_frames_trajectory(self, motion: AbstractMotion) -> None:
        offsets = torch.tensor([-5.4, -1.0, 0.0, 5.4], dtype=torch.float64)
        for frame in range(FRAMES):
            by_frame, by_time = motion.state(frame, offsets), motion.at(offsets + 5 + PERIOD * frame)
            for left, right in zip(fields(by_frame), fields(by_time), strict=True):
                torch.testing.assert_close(left, right, atol=1e-6, rtol=0)  # float32 parameters

    def test_times_beyond_the_sequence_read_its_ends(self, motion: AbstractMotion) -> None:
        times = torch.tensor([4.0, 5 + PERIOD * FRAMES - PERIOD + 1], dtype=torch.float64)
        before, after = motion.state(0, times[:1] - 5), motion.state(FRAMES - 1, torch.ones(1))
        torch.testing.assert_close(motion.at(times).Th, torch.cat([before.Th, after.Th]), atol=1e-6, rtol=0)

    def test_starts_near_the_fit_and_in_float32(self, motion: AbstractMotion) -> None:
        state = motion.state(2, torch.zeros(1))
        assert all(f.dtype == torch.float32 for f in fields(state))
        truth = np.random.default_rng(0)
        poses = 0.3 * truth.normal(size=(FRAMES, 72))
        np.testing.assert_allclose(state.rotations[0, 1:].detach().reshape(-1), poses[2, 3:], atol=0.2)

    def test_every_channel_of_a_frame_is_learnable(self, motion: AbstractMotion) -> None:
        state = motion.state(1, torch.tensor([0.0]))
        (state.rotations.sum() + state.Rh.sum() + state.Th.sum()).backward()
        (parameter,) = motion.parameters()
        assert parameter.grad is not None
        assert float(parameter.grad.abs().reshape(-1, 25, 3).amax(0).min()) > 0

    @pytest.mark.parametrize("kind", ["paper", "aligned"])
    def test_penalty_is_a_scalar_of_at_least_zero(self, motion: AbstractMotion, kind: str) -> None:
        penalty = motion.penalty(kind)  # type: ignore[arg-type]
        assert penalty.shape == ()
        assert float(penalty.detach()) >= 0

    def test_a_copy_by_its_state_is_the_same_motion(self, motion: AbstractMotion) -> None:
        state = {name: value.clone() for name, value in motion.state_dict().items()}
        before = motion.state(1, torch.ones(1)).Rh.detach().clone()
        with torch.no_grad():
            for parameter in motion.parameters():
                parameter.zero_()
        motion.load_state_dict(state)
        assert torch.equal(motion.state(1, torch.ones(1)).Rh, before)
