"""Joint angles to world transforms in one native call; the torch chain of ``skinning`` where there is no kernel."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.body.skinning import joint_transforms, world_transforms
from rsavatar.geometry.rotations import exp_so3


class _Body(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_void_p)
        for name in ("angles", "residuals", "root_rotation", "root_translation", "rest_joints", "parents")
    )


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parents: Tensor, *tensors: Tensor) -> Tensor:
        tensors = tuple(t.detach().contiguous() for t in tensors)
        transforms = torch.empty(*tensors[0].shape[:2], 3, 4)
        body = _Body(*(t.data_ptr() if t.numel() else None for t in tensors), parents.data_ptr())
        kernels.library().rs_pose(ctypes.byref(body), len(transforms), transforms.data_ptr())
        ctx.save_for_backward(parents, *tensors)
        return transforms

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        parents, *tensors = ctx.saved_tensors
        grad = upstream[0].contiguous()
        found = [torch.zeros_like(t) for t in tensors]
        body = _Body(*(t.data_ptr() if t.numel() else None for t in tensors), parents.data_ptr())
        pointers = (t.data_ptr() if t.numel() else None for t in found)
        kernels.library().rs_pose_backward(ctypes.byref(body), len(grad), grad.data_ptr(), *pointers)
        return (None, *found)


_apply: Callable[..., Tensor] = _Pose.apply  # torch leaves apply untyped


def pose(
    rotations: Tensor, residuals: Tensor | None, Rh: Tensor, Th: Tensor, rest_joints: Tensor, parents: Tensor
) -> Tensor:
    """Rest-to-world joint transforms: x_world = R(Rh) A_j x + Th with R_j = exp(rotation_j) exp(residual_j).

    Args:
        rotations: [B, 24, 3] axis-angle, radians; the root's is ignored.
        residuals: the same shape, or None for none.
        Rh: [B, 3] axis-angle, radians.
        Th: [B, 3] metres.
        rest_joints: [24, 3] metres.
        parents: [24] int32, -1 for the root, each before its children.

    Returns:
        [B, 24, 3, 4], differentiable in all but ``parents``.
    """
    if kernels.available() and rotations.dtype == torch.float32:
        extra = rotations.new_zeros(0) if residuals is None else residuals
        return _apply(parents, rotations, extra, Rh, Th, rest_joints)
    local = exp_so3(rotations * (parents >= 0)[:, None])
    if residuals is not None:
        local = local @ exp_so3(residuals * (parents >= 0)[:, None])
    return world_transforms(joint_transforms(local, rest_joints, tuple(parents.tolist())), exp_so3(Rh), Th)
