"""The spline's basis in closed form, its trajectories by scipy's B-splines, and what the continuity penalty sees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from torch import Tensor

from rsavatar import kernels
from rsavatar.geometry.rotations import exp_so3
from rsavatar.motion.base import InitialMotion, unwrap
from rsavatar.motion.continuity import gap
from rsavatar.motion.spline import POSITIVE_RANGE, ZERO_MEAN_DEVIATION, FrameSpline, basis_matrix
from rsavatar.motion.still import StillPose

PERIOD = 11.0
ORDERS = st.integers(2, 8)  # what a job may ask for


def initial(frames: int = 6, seed: int = 0, readout: float = PERIOD, scale: float = 0.3) -> InitialMotion:
    random = np.random.default_rng(seed)
    return InitialMotion(
        poses=scale * random.normal(size=(frames, 72)),
        Rh=random.normal(size=(frames, 3)),
        Th=random.normal(size=(frames, 3)),
        mid_frames=np.arange(5.0, 5 + PERIOD * frames, PERIOD),
        period_frames=PERIOD,
        readout_frames=readout,
    )


def with_control(control: Tensor, bands: int = 11) -> FrameSpline:
    """A float64 motion [N, P, 25, 3] made of the given control points."""
    motion = FrameSpline(initial(len(control)), bands, control.shape[1]).double()
    motion.control.data = control
    return motion


def shared_spline(frames: int, P: int) -> FrameSpline:
    """A motion that is truly continuous: all frames read one uniform B-spline's control points."""
    points = 0.3 * torch.randn(frames + P - 1, 25, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return with_control(torch.stack([points[n : n + P] for n in range(frames)]))


@pytest.mark.parametrize(
    ("P", "whole"),
    [
        (2, [[1, 0], [-1, 1]]),
        (3, [[1, 1, 0], [-2, 2, 0], [1, -2, 1]]),
        (4, [[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]),
    ],
)
def test_basis_in_closed_form(P: int, whole: list[list[int]]) -> None:
    factor = {2: 1, 3: 2, 4: 6}[P]  # (P - 1)!
    torch.testing.assert_close(factor * basis_matrix(P), torch.tensor(whole, dtype=torch.float64), atol=1e-15, rtol=0)


@settings(deadline=None)
@given(P=ORDERS, u=st.floats(0, 1, exclude_max=True))
def test_basis_is_the_uniform_b_splines(P: int, u: float) -> None:
    weights = u ** np.arange(P) @ basis_matrix(P).numpy()
    knots = np.arange(-P + 1, P + 1, dtype=float)  # [0, 1] is the one span on which all P basis functions live
    truth = [BSpline.basis_element(knots[j : j + P + 1], extrapolate=False)(u) for j in range(P)]
    np.testing.assert_allclose(weights, truth, atol=1e-12)


@settings(deadline=None)
@given(P=ORDERS, u=st.floats(-0.5, 1.5))
def test_weights_sum_to_one_inside_and_outside_the_window(P: int, u: float) -> None:
    assert float((u ** np.arange(P) @ basis_matrix(P).numpy()).sum()) == pytest.approx(1, abs=1e-12)


@settings(deadline=None, max_examples=20)
@given(P=ORDERS, offset=st.floats(-8, 8))
def test_equal_control_points_are_a_constant(P: int, offset: float) -> None:
    pose = torch.randn(2, 1, 25, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    state = with_control(pose.expand(2, P, 25, 3).clone()).state(1, torch.tensor([offset], dtype=torch.float64))
    torch.testing.assert_close(state.Th[0], pose[1, 0, 24], atol=1e-11, rtol=0)
    torch.testing.assert_close(state.Rh[0], pose[1, 0, 0], atol=1e-11, rtol=0)
    torch.testing.assert_close(state.rotations[0, 1:], pose[1, 0, 1:24], atol=1e-11, rtol=0)


def test_cubic_weights_at_the_middle_are_the_known_ones() -> None:
    points = torch.zeros(1, 4, 25, 3, dtype=torch.float64)
    points[0, :, 24, 0] = torch.tensor([48.0, 4800.0, 480000.0, 48000000.0])
    middle = with_control(points).state(0, torch.zeros(1)).Th[0, 0].detach()
    assert float(middle) == pytest.approx(1 + 2300 + 230000 + 1000000, rel=1e-12)  # (1, 23, 23, 1) / 48


def test_trajectory_is_differentiable_in_control_points_and_time() -> None:
    motion = with_control(torch.randn(2, 4, 25, 3, dtype=torch.float64))
    offsets = torch.tensor([-7.0, 0.0, 2.5], dtype=torch.float64, requires_grad=True)

    def channels(_: Tensor, offsets: Tensor) -> Tensor:
        state = motion.state(1, offsets)
        return torch.cat([state.rotations[:, ::6], state.Rh[:, None], state.Th[:, None]], 1)

    assert torch.autograd.gradcheck(channels, (motion.control, offsets))


@pytest.mark.parametrize("kind", ["paper", "aligned"])
def test_penalty_gradient(kind: str) -> None:
    motion = with_control(0.3 * torch.randn(3, 3, 25, 3, dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda _: motion.penalty(kind), (motion.control,))  # type: ignore[arg-type]


@pytest.mark.skipif(not kernels.available(), reason="needs the native kernels")
@pytest.mark.parametrize("translation", [False, True])
@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.5, 3.0, 30.0])
def test_native_gap_is_the_chains(translation: bool, size: float) -> None:
    """From equal control points to many turns, with a pair that does not count."""
    generator = torch.Generator().manual_seed(7)
    control = size * torch.randn(5, 4, 25, 3, generator=generator)
    ends = torch.rand(2, 4, generator=generator, dtype=torch.float64)
    meeting = torch.tensor([0.5, 0.0, 0.25, 0.25], dtype=torch.float64)
    found = []
    for points in (control, control.double()):
        points.requires_grad_()
        value = gap(points, ends, meeting, translation)
        (gradient,) = torch.autograd.grad(3 * value, points)
        found.append((value.detach().double(), gradient.double()))
    torch.testing.assert_close(found[0], found[1], rtol=2e-6, atol=2e-7)


@pytest.mark.parametrize("P", [2, 3, 4, 6])
def test_aligned_penalty_is_zero_for_continuous_motion_and_the_papers_is_not(P: int) -> None:
    motion = shared_spline(6, P)
    assert float(motion.penalty("aligned").detach()) < 1e-9  # two guards of 1e-10
    assert float(motion.penalty("paper").detach()) > 1e-3


def test_papers_penalty_is_the_motion_between_its_two_instants() -> None:
    """A body that turns about one axis by 0.2 rad a frame: the last and the next first band are 1 / T frame apart."""
    control = torch.zeros(5, 2, 25, 3, dtype=torch.float64)  # P = 2: c_1 is the start, c_2 the end of the window
    control[:, :, 0, 2] = 0.2 * torch.tensor([[n, n + 1.0] for n in range(5)], dtype=torch.float64)
    joints = 24  # Rh is one of the J joints of the mean
    assert float(with_control(control, bands=4).penalty("paper").detach()) == pytest.approx(0.2 / 4 / joints, abs=1e-9)
    assert float(with_control(control, bands=4).penalty("aligned").detach()) == pytest.approx(0, abs=1e-9)


def test_aligned_penalty_adds_the_translations_gap_in_metres() -> None:
    control = torch.zeros(3, 2, 25, 3, dtype=torch.float64)
    control[1, :, 24, 0] = 0.25  # frame 1 stands 25 cm beside frames 0 and 2
    assert float(with_control(control).penalty("aligned").detach()) == pytest.approx(0.25, abs=1e-9)
    assert float(with_control(control).penalty("paper").detach()) == pytest.approx(0, abs=1e-9)


def test_frames_whose_windows_do_not_meet_are_not_compared() -> None:
    start = initial(3)
    apart = InitialMotion(start.poses, start.Rh, start.Th, np.array([5.0, 16.0, 60.0]), PERIOD, PERIOD)
    near, far = FrameSpline(start, 11), FrameSpline(apart, 11)
    far.penalty("aligned").backward()
    assert far.control.grad is not None
    assert float(far.control.grad[2].abs().max()) == 0
    assert float(far.penalty("aligned").detach()) != float(near.penalty("aligned").detach())


@pytest.mark.parametrize("kind", ["paper", "aligned"])
def test_penalty_of_a_single_frame_is_zero(kind: str) -> None:
    motion = FrameSpline(initial(1), 11)
    penalty = motion.penalty(kind)  # type: ignore[arg-type]
    penalty.backward()
    assert float(penalty.detach()) == 0


def test_zero_mean_noise_has_its_deviation_and_leaves_the_middle_in_place() -> None:
    start = initial(80)
    noise = FrameSpline(start, 11).control.detach().double() - start.stacked()[:, None]
    count = noise.numel()
    assert float(noise.std()) == pytest.approx(ZERO_MEAN_DEVIATION, rel=5 / (2 * count) ** 0.5)
    assert abs(float(noise.mean())) < 5 * ZERO_MEAN_DEVIATION / count**0.5


def test_positive_noise_is_uniform_and_spares_the_first_control_point() -> None:
    start = initial(80)
    motion = FrameSpline(start, 11, perturbation="positive").double()
    noise = motion.control.detach() - start.stacked()[:, None]
    low, high = POSITIVE_RANGE
    rounding = 1e-6  # the parameters are float32, of order 1
    assert float(noise[:, 0].abs().max()) < rounding
    assert low - rounding <= float(noise[:, 1:].min()) < 1.1 * low
    assert 0.99 * high < float(noise[:, 1:].max()) <= high + rounding
    middle = torch.stack([motion.state(n, torch.zeros(1)).Th[0] for n in range(80)]).detach()
    bias = float((middle - torch.as_tensor(start.Th)).mean())
    assert bias == pytest.approx(47 / 48 * (low + high) / 2, rel=0.1)  # weights (1, 23, 23, 1) / 48: it is biased


def test_same_seed_same_noise() -> None:
    first, second, third = (FrameSpline(initial(), 11, seed=s).control for s in (7, 7, 8))
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


def test_unwrap_keeps_the_rotation_and_shortens_the_step() -> None:
    axis = np.array([0.0, 0.6, 0.8])
    angles = np.linspace(2.5, 4.0, 7)  # through pi, where a fit's axis-angle flips to the other end of its axis
    wrapped = np.where(angles > np.pi, angles - 2 * np.pi, angles)
    result = unwrap((wrapped[:, None] * axis)[:, None])
    np.testing.assert_allclose(result[:, 0], angles[:, None] * axis, atol=1e-14)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_unwrap_never_changes_a_rotation_and_never_lengthens_a_step(seed: int) -> None:
    rotvecs = np.random.default_rng(seed).normal(size=(5, 3, 3)) * 2
    rotvecs[2, 0] = 0.0
    result = unwrap(rotvecs)
    before, after = (exp_so3(torch.as_tensor(r)) for r in (rotvecs, result))
    torch.testing.assert_close(before, after, atol=1e-13, rtol=0)
    assert (
        np.linalg.norm(result[1:] - result[:-1], axis=-1) < np.linalg.norm(rotvecs[1:] - result[:-1], axis=-1) + 1e-9
    ).all()


def test_unwrap_of_no_rotation_follows_its_predecessor_round() -> None:
    full_turn = np.array([[[0.0, 0.0, 6.2]], [[0.0, 0.0, 0.0]]])
    np.testing.assert_allclose(unwrap(full_turn)[1, 0], [0, 0, 2 * np.pi], atol=1e-14)


def test_still_pose_starts_at_the_fit_and_is_learnable() -> None:
    start = initial()
    motion = StillPose(start)
    state = motion.state(2, torch.tensor([-5.0, 5.0]))
    np.testing.assert_allclose(state.Th.detach().numpy(), np.repeat(start.Th[2:3], 2, 0), rtol=1e-6)
    state.rotations.sum().backward()
    assert motion.poses.grad is not None
    assert float(motion.poses.grad[2, 1:24].min()) == 2.0  # two offsets
    assert float(motion.poses.grad[1].abs().max()) == 0.0
