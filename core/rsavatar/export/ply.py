"""Gaussians as a ``.ply`` in the layout of 3D Gaussian splatting, which the common viewers and editors read.

Binary, little endian, one ``vertex`` of 62 floats per Gaussian: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..44 (the
higher harmonics of red, then of green, then of blue; zero where the avatar has none), opacity (a logit), scale_0..2
(natural logs of metres), rot_0..3 (a unit quaternion, w first). World axes and metres are the subject's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rsavatar.export.replay import Replay
from rsavatar.geometry.rotations import quaternion_to_matrix

HARMONICS = 16  # of degree 3, what the layout has room for
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * (HARMONICS - 1))),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
LEAST_SCALE = 1e-7  # metres: the log of a flat Gaussian's third axis stays finite


@dataclass(frozen=True)
class Cloud:
    """M Gaussians as they lie in space."""

    means: Tensor  # [M, 3] metres
    rotations: Tensor  # [M, 4] unit quaternions (w, x, y, z)
    scales: Tensor  # [M, 3] metres
    opacity_logits: Tensor  # [M]
    sh: Tensor  # [M, B, 3]


def canonical_cloud(replay: Replay) -> Cloud:
    """The Gaussians in the body's rest pose, as they are optimised."""
    avatar = replay.actor.avatar
    quaternions = torch.nn.functional.normalize(avatar.rotations.T, dim=1)
    return Cloud(avatar.means.T, quaternions, avatar.log_scales.T.exp(), avatar.opacity_logits, _sh(replay))


def posed_cloud(replay: Replay, time: float) -> Cloud:
    """The Gaussians at an instant, in the world: blended means, and the axes of B R diag(s) as rotation and scales.

    Linear blend skinning gives each Gaussian an affine map B, which also shears; a singular value decomposition brings
    the sheared ellipsoid back to one with a rotation and three scales, exactly.

    Raises:
        SpecError: if ``time`` is outside the sequence.
    """
    actor = replay.actor
    affine, means = posed(replay, time)
    axes = quaternion_to_matrix(actor.avatar.rotations.T.double()) * actor.avatar.log_scales.exp().T[:, None, :]
    frames, scales, _ = torch.linalg.svd(affine[:, :, :3].double() @ axes)
    frames[:, :, 2] *= torch.linalg.det(frames).sign()[:, None]
    turned = Rotation.from_matrix(frames.numpy()).as_quat()[:, [3, 0, 1, 2]]
    return Cloud(means, torch.from_numpy(turned), scales, actor.avatar.opacity_logits, _sh(replay))


def posed(replay: Replay, time: float) -> tuple[Tensor, Tensor]:
    """Blended skinning maps [M, 3, 4] and world means [M, 3] at an instant."""
    actor = replay.actor
    frame, offset = replay.place(time)
    transforms = actor.transforms(frame, torch.tensor([offset], dtype=torch.float64))[0]
    affine = torch.einsum("jm,jrc->mrc", replay.skin_weights, transforms)
    shaped = shaped_means(replay, frame)
    means = torch.einsum("mrc,cm->mr", affine[:, :, :3], shaped) + affine[:, :, 3]
    return affine, means


def shaped_means(replay: Replay, frame: int) -> Tensor:
    """Canonical means [3, M] with the shape's and the frame's blend shapes added."""
    actor = replay.actor
    offset = None if actor.pose_offsets is None else actor.pose_offsets[frame]
    return actor.avatar.shaped_means(actor.shapes - actor.avatar.surface.shapes, offset)


def _sh(replay: Replay) -> Tensor:
    avatar = replay.actor.avatar
    sh = avatar.sh_constant if replay.spec.sh_degree == 0 else torch.cat([avatar.sh_constant, avatar.sh_linear])
    return sh.permute(2, 0, 1)


def write_ply(cloud: Cloud) -> bytes:
    """The file."""
    count = len(cloud.means)
    rest = np.zeros((count, 3, HARMONICS - 1), np.float32)
    rest[:, :, : cloud.sh.shape[1] - 1] = _array(cloud.sh[:, 1:]).transpose(0, 2, 1)
    columns = (
        _array(cloud.means),
        np.zeros((count, 3), np.float32),
        _array(cloud.sh[:, 0]),
        rest.reshape(count, -1),
        _array(cloud.opacity_logits)[:, None],
        np.log(np.maximum(_array(cloud.scales), LEAST_SCALE)),
        _array(cloud.rotations),
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in PROPERTIES]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + np.concatenate(columns, 1).astype("<f4").tobytes()


def _array(tensor: Tensor) -> npt.NDArray[np.float32]:
    return tensor.detach().float().numpy()
