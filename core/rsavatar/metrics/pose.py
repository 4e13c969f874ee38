"""Pose metrics against a true motion: joints in millimetres, global rotations in degrees."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Array = npt.NDArray[np.float64]

UNSCORED_JOINTS = (10, 11, 22, 23)  # SMPL's feet and hands: leaves, whose rotation moves no joint


def joint_error_mm(joints: Array, truth: Array) -> float:
    """Mean distance between joints, over joints and frames.

    Args:
        joints: [N, J, 3] metres, world.
        truth: the same shape.

    Returns:
        Millimetres.

    Raises:
        DataError: if the shapes differ or a value is not finite.
    """
    _check("joints", joints, truth, (3,))
    return 1000.0 * float(np.linalg.norm(joints - truth, axis=-1).mean())


def rotation_error_deg(rotations: Array, truth: Array) -> float:
    """Mean geodesic distance on SO(3) between GLOBAL joint rotations, over the scored joints and frames.

    Args:
        rotations: [N, 24, 3, 3], joint to world (the body's global orientation included), SMPL's joint order.
        truth: the same shape.

    Returns:
        Degrees in [0, 180]; joints ``UNSCORED_JOINTS`` are left out.

    Raises:
        DataError: if the shapes differ, there are not 24 joints, or a value is not finite.
    """
    _check("rotations", rotations, truth, (24, 3, 3))
    scored = [j for j in range(24) if j not in UNSCORED_JOINTS]
    return float(np.degrees(_angles(np.swapaxes(truth, -1, -2) @ rotations)[:, scored].mean()))


def sub_frame_joint_error_mm(joints: Array, truth: Array) -> float:
    """Mean joint distance at S instants evenly spread over each readout, ends included.

    The truth's Q instants are spread the same way and interpolated linearly in between.

    Args:
        joints: [N, S, J, 3] metres, world, S >= 1.
        truth: [N, Q, J, 3].

    Returns:
        Millimetres.

    Raises:
        DataError: if frames or joints differ, an axis is empty, or a value is not finite.
    """
    if joints.ndim != 4 or truth.ndim != 4 or 0 in truth.shape[:2]:
        raise DataError(expected("sub-frame joints", "[N, S, J, 3]", f"{list(joints.shape)}, {list(truth.shape)}"))
    position = np.linspace(0.0, truth.shape[1] - 1.0, joints.shape[1])
    low = np.floor(position).astype(np.intp)
    high = np.minimum(low + 1, truth.shape[1] - 1)
    w = (position - low)[None, :, None, None]
    between = truth[:, low] * (1.0 - w) + truth[:, high] * w
    _check("sub-frame joints", joints, between, (3,))
    return 1000.0 * float(np.linalg.norm(joints - between, axis=-1).mean())


def _angles(R: Array) -> Array:
    """Rotation angle of matrices [..., 3, 3], radians; well conditioned at 0 and at pi, unlike acos of the trace."""
    axis = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    angles: Array = np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return angles


def _check(name: str, value: Array, truth: Array, tail: tuple[int, ...]) -> None:
    if value.shape != truth.shape or value.shape[-len(tail) :] != tail or 0 in value.shape:
        raise DataError(expected(name, f"{list(truth.shape)}, ending in {list(tail)}", list(value.shape)))
    if not (np.isfinite(value).all() and np.isfinite(truth).all()):
        raise DataError(expected(name, "finite numbers", "NaN or infinity"))
