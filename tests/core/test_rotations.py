"""Rotations against scipy's, and their gradients against finite differences, at the angles where formulas break."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from rsavatar.geometry.rotations import (
    compose,
    exp_so3,
    geodesic_distance,
    log_so3,
    quaternion_to_matrix,
    rotvec_distance,
)

ROUNDING = 1e-14  # float64, a few dozen operations on numbers of order 1
ANGLES = [0.0, 1e-12, 1e-7, 1e-3, 1.0, math.pi - 1e-3, math.pi - 1e-8, math.pi, math.pi + 0.5, 2 * math.pi, 7.0]


def vectors(count: int, size: int = 3, seed: int = 0) -> Tensor:
    return torch.randn(count, size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def rotvecs(angle: float, count: int = 20) -> Tensor:
    return angle * torch.nn.functional.normalize(vectors(count), dim=-1)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_scipys(angle: float) -> None:
    r = rotvecs(angle)
    truth = torch.as_tensor(Rotation.from_rotvec(r.numpy()).as_matrix())
    torch.testing.assert_close(exp_so3(r), truth, atol=ROUNDING, rtol=0)


def test_exp_keeps_shape_dtype_and_small_angles_in_float32() -> None:
    r = torch.full((2, 5, 3), 1e-5)
    R = exp_so3(r)
    assert R.shape == (2, 5, 3, 3)
    assert R.dtype == torch.float32
    assert float(R[0, 0, 1, 0]) == pytest.approx(1e-5, rel=1e-5)  # 1 + tiny would have kept 2 digits


def test_exp_of_zero_is_the_identity() -> None:
    assert torch.equal(exp_so3(torch.zeros(3)), torch.eye(3))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_gradient(angle: float) -> None:
    assert torch.autograd.gradcheck(exp_so3, (rotvecs(angle, 3).requires_grad_(),))


def test_derivative_at_zero_is_the_generators() -> None:
    jacobian = torch.autograd.functional.jacobian(exp_so3, torch.zeros(3, dtype=torch.float64))
    along_z = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert torch.equal(jacobian[..., 2], along_z)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a < math.pi])
def test_log_inverts_exp(angle: float) -> None:
    r = rotvecs(angle)
    torch.testing.assert_close(log_so3(exp_so3(r)), r, atol=10 * ROUNDING, rtol=0)


def test_log_at_pi_is_the_axis_up_to_sign() -> None:
    r = rotvecs(math.pi)
    log = log_so3(exp_so3(r))
    torch.testing.assert_close(log * (log * r).sum(-1, keepdim=True).sign(), r, atol=1e-12, rtol=0)


def test_log_at_pi_about_each_coordinate_axis() -> None:
    for axis in range(3):
        matrix = -torch.eye(3, dtype=torch.float64)
        matrix[axis, axis] = 1
        expected = torch.zeros(3, dtype=torch.float64)
        expected[axis] = math.pi
        torch.testing.assert_close(log_so3(matrix).abs(), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-3, math.pi - 1e-5])
def test_log_gradient(angle: float) -> None:
    assert torch.autograd.gradcheck(lambda r: log_so3(exp_so3(r)), (rotvecs(angle, 3).requires_grad_(),))


@pytest.mark.parametrize("angle", ANGLES)
def test_no_gradient_is_infinite(angle: float) -> None:
    for dtype in (torch.float32, torch.float64):
        r = rotvecs(angle).to(dtype).requires_grad_()
        still = torch.zeros(3, dtype=dtype)
        total = compose(r, still).sum() + geodesic_distance(exp_so3(r), torch.eye(3, dtype=dtype)).sum()
        (gradient,) = torch.autograd.grad(total, r)
        assert gradient.isfinite().all()
        assert float(gradient.norm(dim=-1).max()) < 10


def test_quaternion_is_scipys_whatever_its_length() -> None:
    q = vectors(20, 4)
    truth = torch.as_tensor(Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix())
    torch.testing.assert_close(quaternion_to_matrix(q), truth, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(quaternion_to_matrix(-7 * q), truth, atol=ROUNDING, rtol=0)


def test_quaternion_gradient_is_right_and_has_no_part_along_it() -> None:
    q = vectors(4, 4).requires_grad_()
    assert torch.autograd.gradcheck(quaternion_to_matrix, (q,))
    (gradient,) = torch.autograd.grad((quaternion_to_matrix(q) * vectors(3)).sum(), q)
    torch.testing.assert_close((gradient * q).sum(-1), torch.zeros(4, dtype=torch.float64), atol=ROUNDING, rtol=0)


def test_zero_quaternion_stays_finite() -> None:
    q = torch.zeros(4, requires_grad=True)
    quaternion_to_matrix(q).sum().backward()
    assert q.grad is not None
    assert q.grad.isfinite().all()


@settings(deadline=None, max_examples=50)
@given(angle=st.floats(0, math.pi), seed=st.integers(0, 1000))
def test_distance_is_the_angle_between(angle: float, seed: int) -> None:
    axis = torch.nn.functional.normalize(vectors(1, seed=seed), dim=-1)
    first = exp_so3(vectors(1, seed=seed + 1))
    distance = geodesic_distance(first, first @ exp_so3(angle * axis))
    assert float(distance) == pytest.approx(angle, abs=2e-10)  # 1e-10 is the root of the guard at 0


def test_distance_gradient() -> None:
    a, b = vectors(4, seed=1).requires_grad_(), vectors(4, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: geodesic_distance(exp_so3(a), exp_so3(b)), (a, b))


def test_distance_of_equal_rotations_has_zero_gradient() -> None:
    a = vectors(4).requires_grad_()
    distance = geodesic_distance(exp_so3(a), exp_so3(a.detach()))
    (gradient,) = torch.autograd.grad(distance.sum(), a)
    assert float(distance.detach().max()) < 1e-9
    assert float(gradient.abs().max()) < 1e-5  # rounding, over the guard's 1e-10


def test_distance_of_vectors_is_the_distance_of_their_matrices() -> None:
    a, b = 2 * vectors(50, seed=1), 2 * vectors(50, seed=2)
    torch.testing.assert_close(rotvec_distance(a, b), geodesic_distance(exp_so3(a), exp_so3(b)), atol=1e-12, rtol=0)
    assert torch.autograd.gradcheck(rotvec_distance, (a[:3].requires_grad_(), b[:3].requires_grad_()))


def test_vectors_a_turn_apart_are_no_distance_apart_and_their_gradient_is_finite() -> None:
    a = rotvecs(0.5).requires_grad_()
    distance = rotvec_distance(a, rotvecs(0.5 - 2 * math.pi))
    (gradient,) = torch.autograd.grad(distance.sum() + rotvec_distance(a, a).sum(), a)
    assert float(distance.detach().max()) < 1e-9
    assert gradient.isfinite().all()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-7, 7), min_size=6, max_size=6))
def test_compose_is_scipys_product(numbers: list[float]) -> None:
    first, second = torch.tensor(numbers, dtype=torch.float64).split(3)
    truth = (Rotation.from_rotvec(first.numpy()) * Rotation.from_rotvec(second.numpy())).as_matrix()
    torch.testing.assert_close(exp_so3(compose(first, second)), torch.as_tensor(truth), atol=1e-13, rtol=0)


def test_compose_with_nothing_is_the_vector_itself() -> None:
    r = rotvecs(1.5)
    torch.testing.assert_close(compose(r, torch.zeros_like(r)), r, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(compose(torch.zeros_like(r), r), r, atol=ROUNDING, rtol=0)
