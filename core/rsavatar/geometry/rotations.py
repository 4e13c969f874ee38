"""Rotations: axis-angle vectors, matrices, quaternions, and the distance between two rotations.

**Convention**: matrices act on column vectors, ``x' = R x``; angles in radians; quaternions are (w, x, y, z). All
functions take any leading axes, keep the dtype, and have finite gradients everywhere, angles 0 and pi included.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Added to a squared length before its root: it turns 0/0 into a limit and lies far below the rounding of float32.
_TINY = 1e-20

# R - I in the products of a unit quaternion (w, x, y, z), numbered 0..3: (i, j) -> {(row, column): coefficient}.
_MATRIX_OF_PRODUCTS = {
    (1, 1): {(1, 1): -2.0, (2, 2): -2.0},
    (2, 2): {(0, 0): -2.0, (2, 2): -2.0},
    (3, 3): {(0, 0): -2.0, (1, 1): -2.0},
    (1, 2): {(0, 1): 2.0, (1, 0): 2.0},
    (1, 3): {(0, 2): 2.0, (2, 0): 2.0},
    (2, 3): {(1, 2): 2.0, (2, 1): 2.0},
    (0, 1): {(1, 2): -2.0, (2, 1): 2.0},
    (0, 2): {(0, 2): 2.0, (2, 0): -2.0},
    (0, 3): {(0, 1): -2.0, (1, 0): 2.0},
}


def _tables() -> tuple[Tensor, Tensor]:
    """[16, 9] with R - I = (q q^T) @ first, and [9, 16] with 4 q q^T - I = R @ second."""
    matrix = torch.zeros(4, 4, 3, 3, dtype=torch.float64)
    outer = torch.zeros(3, 3, 4, 4, dtype=torch.float64)
    for (i, j), entries in _MATRIX_OF_PRODUCTS.items():
        for (r, c), coefficient in entries.items():
            matrix[i, j, r, c] = coefficient
            if i != j:
                outer[r, c, i, j] = outer[r, c, j, i] = coefficient / 2
    for r in range(3):
        outer[r, r] = torch.diag(torch.tensor([1.0 if i in (0, r + 1) else -1.0 for i in range(4)]))
    return matrix.reshape(16, 9), outer.reshape(9, 16)


_TO_MATRIX, _TO_OUTER = _tables()


def exp_so3(rotvec: Tensor) -> Tensor:
    """Rotation matrix of an axis-angle vector (Rodrigues' formula), through half angles.

    With h = theta / 2, v = sin(h) a, c = cos(h) and a the unit axis: ``R = I + 2 (v v^T - v.v I) + 2 c [v]x``. Half
    angles keep full relative precision for small angles, where ``1 - cos(theta)`` cancels.

    Args:
        rotvec: [..., 3], radians; any length, multiples of 2 pi included.

    Returns:
        [..., 3, 3]; differentiable everywhere, with the generators of SO(3) as the derivative at 0.
    """
    return _from_unit_quaternion(torch.cat(_half_angles(rotvec), -1))


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrix [..., 3, 3] of a quaternion (w, x, y, z) [..., 4] of any length > 0.

    Differentiable in the unnormalised quaternion: the gradient has no part along it. Length 0 gives the identity.
    """
    return _from_unit_quaternion(torch.nn.functional.normalize(quaternion, dim=-1))


def log_so3(matrix: Tensor) -> Tensor:
    """Axis-angle vector [..., 3] of length at most pi of a rotation matrix [..., 3, 3]; inverse of ``exp_so3``.

    By the largest row of 4 q q^T, which is linear in the matrix, so it is as precise near pi as near 0. At exactly pi,
    where +axis and -axis are the same rotation, one of the two is returned, with that branch's gradient.
    """
    outer = _quaternion_outer(matrix)
    largest = outer.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    unit = row / row.norm(dim=-1, keepdim=True)
    unit = torch.where(unit[..., :1] < 0, -unit, unit)  # the shorter of the two ways round
    scalar, vector = unit[..., :1], unit[..., 1:]
    sine = ((vector * vector).sum(-1, keepdim=True) + _TINY).sqrt()
    return 2 * torch.atan2(sine, scalar) / sine * vector


def geodesic_distance(first: Tensor, second: Tensor) -> Tensor:
    """Angle in [0, pi] of ``first^T second``, radians: the geodesic distance on SO(3) (norm G of paper, eq. reg).

    As atan2 of sine and cosine: arccos of the trace loses half the digits near 0, and its gradient is infinite there.

    Args:
        first, second: [..., 3, 3], broadcast against each other.

    Returns:
        [...]; the gradient at equal rotations is 0, and of length 1 per radian elsewhere.
    """
    relative = first.transpose(-1, -2) @ second
    skew = relative - relative.transpose(-1, -2)
    squared_sine = 0.125 * (skew * skew).sum((-1, -2))
    cosine = 0.5 * (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    return torch.atan2((squared_sine + _TINY).sqrt(), cosine)


def rotvec_distance(first: Tensor, second: Tensor) -> Tensor:
    """``geodesic_distance(exp_so3(first), exp_so3(second))`` [...] of axis-angle vectors [..., 3], at half the price.

    Twice the angle between the two unit quaternions, from the sine and cosine of their relative rotation.
    """
    (c1, v1), (c2, v2) = _half_angles(first), _half_angles(second)
    vector = c1 * v2 - c2 * v1 - torch.cross(v1, v2, dim=-1)
    scalar = c1[..., 0] * c2[..., 0] + (v1 * v2).sum(-1)
    return 2 * torch.atan2(((vector * vector).sum(-1) + _TINY).sqrt(), scalar.abs())


def compose(first: Tensor, second: Tensor) -> Tensor:
    """Axis-angle vector [..., 3] of ``exp(first) exp(second)``: ``second`` acts first. Length at most pi."""
    return log_so3(exp_so3(first) @ exp_so3(second))


def _half_angles(rotvec: Tensor) -> tuple[Tensor, Tensor]:
    """The unit quaternion of an axis-angle vector [..., 3]: cos(h) [..., 1] and sin(h) a [..., 3], h half the angle."""
    half = (0.25 * (rotvec * rotvec).sum(-1, keepdim=True) + _TINY).sqrt()
    return half.cos(), rotvec * (0.5 * half.sin() / half)


def _from_unit_quaternion(unit: Tensor) -> Tensor:
    """I + 2 (v v^T - v.v I) + 2 c [v]x for a unit quaternion (c, v) [..., 4]: linear in its outer product."""
    outer = (unit[..., :, None] * unit[..., None, :]).flatten(-2)
    deviation = outer @ _TO_MATRIX.to(unit)
    return deviation.reshape(*unit.shape[:-1], 3, 3) + torch.eye(3, dtype=unit.dtype, device=unit.device)


def _quaternion_outer(matrix: Tensor) -> Tensor:
    """4 q q^T [..., 4, 4] of the unit quaternion q of a rotation matrix: affine in the matrix."""
    outer = matrix.flatten(-2) @ _TO_OUTER.to(matrix)
    return outer.reshape(*matrix.shape[:-2], 4, 4) + torch.eye(4, dtype=matrix.dtype, device=matrix.device)
