"""Linear blend skinning (paper, eq. lbs): rotations of 24 joints to moved points. Differentiable in every tensor.

**Convention**: joint 0 is the root; a joint's rotation is relative to its parent, about its own rest position. The
world is reached as EasyMocap does it: x_world = R(Rh) x + Th, rotating about the origin and not about the pelvis.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rsavatar.body.base import Array, BodyModel
from rsavatar.geometry.rotations import exp_so3


@lru_cache(maxsize=16)
def _ancestors(parents: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Index [J] of the 1st, 2nd, 4th, ... ancestor of each joint, J standing for "above the root"."""
    joints = len(parents)
    table = torch.tensor([joints if parent < 0 else parent for parent in parents] + [joints])
    rounds = []
    while bool((table[:joints] < joints).any()):
        rounds.append(table[:joints].clone())
        table = table[table]
    return tuple(rounds)


def _local_transforms(rotations: Tensor, rest_joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    """[R_j | J_j - J_parent] as [B, 24, 4, 4]."""
    origin = rest_joints.new_zeros(*rest_joints.shape[:-2], 1, 3)
    with_root = torch.cat([rest_joints, origin], -2)
    offsets = rest_joints - with_root[..., list(parents), :]  # the root's parent, -1, is the origin
    offsets = offsets.expand(*rotations.shape[:-2], 3).unsqueeze(-1)
    bottom = rotations.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rotations.shape[:-2], 1, 4)
    return torch.cat([torch.cat([rotations, offsets], -1), bottom], -2)


def joint_transforms(rotations: Tensor, rest_joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Rest-to-posed transforms of the joints, the chain G_j = G_parent [R_j | J_j - J_parent] with J_j taken off.

    The chain is multiplied along all branches at once by doubling: round k joins every joint's product with that of
    its 2^k-th ancestor, so SMPL's 9 levels take 4 rounds.

    Args:
        rotations: [B, 24, 3, 3], relative to the parent.
        rest_joints: [24, 3] or [B, 24, 3], metres.
        parents: -1 for the root, each before its children.

    Returns:
        [B, 24, 3, 4]: a point x of the rest body bound to joint j goes to ``A[:, j, :, :3] x + A[:, j, :, 3]``.
    """
    chain = _local_transforms(rotations, rest_joints, parents)
    above_root = torch.eye(4, dtype=chain.dtype, device=chain.device).expand(*chain.shape[:-3], 1, 4, 4)
    for ancestors in _ancestors(parents):
        upper = torch.cat([chain, above_root], -3).index_select(-3, ancestors.to(chain.device))
        chain = upper @ chain
    turn, place = chain[..., :3, :3], chain[..., :3, 3:]
    return torch.cat([turn, place - turn @ rest_joints.unsqueeze(-1)], -1)


def world_transforms(transforms: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Joint transforms [B, 24, 3, 4] followed by x_world = R x + Th.

    Args:
        transforms: [B, 24, 3, 4] from ``joint_transforms``.
        rotation: R [B, 3, 3].
        translation: Th [B, 3], metres.

    Returns:
        [B, 24, 3, 4], rest body to world.
    """
    moved = rotation.unsqueeze(-3) @ transforms
    shift = torch.cat([moved.new_zeros(*translation.shape, 3), translation.unsqueeze(-1)], -1)
    return moved + shift.unsqueeze(-3)


def pose_feature(rotations: Tensor) -> Tensor:
    """The 207 numbers that drive SMPL's pose blend shapes: vec(R_j - I), row-major, joints 1..23.

    Args:
        rotations: [B, 24, 3, 3].

    Returns:
        [B, 207].
    """
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return (rotations[..., 1:, :, :] - identity).flatten(-3)


def skin(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Moves each point by the weighted mean of the joints' transforms (paper, eq. lbs).

    Args:
        points: [V, 3] rest points, the same for all B, or [B, V, 3]; metres.
        weights: [V, 24], rows summing to 1.
        transforms: [B, 24, 3, 4].

    Returns:
        [B, V, 3] metres.
    """
    blended = weights @ transforms.flatten(-2)
    blended = blended.reshape(*blended.shape[:-1], 3, 4)
    return (blended[..., :3] * points.unsqueeze(-2)).sum(-1) + blended[..., 3]


def easymocap_to_smplx(Rh: Tensor, Th: Tensor, pelvis: Tensor) -> tuple[Tensor, Tensor]:
    """EasyMocap's (Rh, Th) as smplx's (global_orient, transl): transl = Th + R p0 - p0.

    **Convention**: smplx turns the body about its pelvis, EasyMocap about the origin.

    Args:
        Rh: [..., 3] axis-angle, radians.
        Th: [..., 3] metres.
        pelvis: p0 [3], the rest pelvis of the shape at hand, metres.

    Returns:
        global_orient [..., 3] (equal to ``Rh``) and transl [..., 3].
    """
    return Rh, Th + exp_so3(Rh) @ pelvis - pelvis


def smplx_to_easymocap(global_orient: Tensor, transl: Tensor, pelvis: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of ``easymocap_to_smplx``: Th = transl + p0 - R p0. Shapes and units as there."""
    return global_orient, transl + pelvis - exp_so3(global_orient) @ pelvis


def _world_of(model: BodyModel, pose: Array, Rh: Array, Th: Array, shapes: Array) -> tuple[Tensor, Tensor]:
    """Rotations [1, 24, 3, 3] and rest-to-world transforms [1, 24, 3, 4] in float64."""
    rotations = exp_so3(torch.from_numpy(np.array(pose, np.float64).reshape(1, -1, 3)))
    local = joint_transforms(rotations, torch.from_numpy(model.rest_joints(shapes)), model.parents)
    turn = exp_so3(torch.from_numpy(np.array(Rh, np.float64).reshape(1, 3)))
    return rotations, world_transforms(local, turn, torch.from_numpy(np.array(Th, np.float64).reshape(1, 3)))


def posed_vertices(model: BodyModel, pose: Array, Rh: Array, Th: Array, shapes: Array) -> Array:
    """World vertices of one state, with shape and pose blend shapes: x_world = R(Rh) smpl(pose, shapes) + Th.

    Args:
        model: the body.
        pose: [72] axis-angle, radians; the first three belong to the root and are zero in EasyMocap's fits.
        Rh: [3] axis-angle, radians.
        Th: [3] metres.
        shapes: [10].

    Returns:
        [V, 3] metres.
    """
    rotations, transforms = _world_of(model, pose, Rh, Th, shapes)
    rest = torch.from_numpy(model.shaped(shapes))
    if model.pose_directions is not None:
        rest = rest + torch.from_numpy(model.pose_directions) @ pose_feature(rotations)[0]
    moved: Array = skin(rest, torch.from_numpy(model.weights), transforms)[0].numpy()
    return moved


def posed_joints(model: BodyModel, pose: Array, Rh: Array, Th: Array, shapes: Array) -> Array:
    """World joints [24, 3] of one state, metres. Arguments as for ``posed_vertices``."""
    _, transforms = _world_of(model, pose, Rh, Th, shapes)
    rest = torch.from_numpy(model.rest_joints(shapes)).unsqueeze(-1)
    joints: Array = (transforms[0, ..., :3] @ rest + transforms[0, ..., 3:]).squeeze(-1).numpy()
    return joints
