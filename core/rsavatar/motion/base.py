"""Body states, and what every motion can be asked.

**Convention**: times are in source frames. A frame's trajectory is a function of the offset from its mid time; frame
windows are ``period`` source frames long and centred on ``mid_frames``. Rotations are axis-angle vectors, radians.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[np.float64]
Continuity = Literal["paper", "aligned"]
JOINTS = 24
CHANNELS = JOINTS + 1  # Rh in slot 0, local rotations of joints 1..23, and Th in slot 24


@dataclass(frozen=True)
class BodyState:
    """Where a body is: ``x_world = R(Rh) smpl(rotations) + Th`` (EasyMocap's convention). Leading axes are free."""

    rotations: Tensor  # [..., 24, 3] local joint rotations; the root's are zero
    Rh: Tensor  # [..., 3]
    Th: Tensor  # [..., 3] metres


@dataclass(frozen=True)
class InitialMotion:
    """A body fit per frame and the frames' clock; where a motion starts from."""

    poses: Array  # [N, 72]; the first three columns are not used (the root's rotation is Rh)
    Rh: Array  # [N, 3]
    Th: Array  # [N, 3] metres
    mid_frames: Array  # [N] ascending
    period_frames: float  # from one frame's window to the next
    readout_frames: float  # from the first row to the last

    def stacked(self) -> Tensor:
        """[N, 25, 3] float64, each axis-angle vector the one of its rotation that is nearest to the frame before's.

        A linear combination of axis-angle vectors only means a rotation in between where the vectors are close.
        """
        joints = self.poses.reshape(-1, JOINTS, 3)[:, 1:]
        rotations = unwrap(np.concatenate([self.Rh[:, None], joints], axis=1))
        return torch.as_tensor(np.concatenate([rotations, self.Th[:, None]], axis=1), dtype=torch.float64)


class AbstractMotion(torch.nn.Module, ABC):
    """Pose as a function of time, one trajectory per frame.

    **Contract**: ``at(mid_frames[n] + offset)`` is ``state(n, offset)`` wherever frame n is the nearest; the root's
    rotation is zero; ``penalty`` is at least 0. All of it is differentiable in the module's parameters, ``state`` in
    ``offsets`` and ``at`` in ``times``, too. Parameters are contiguous: a checkpoint's are, and sums over other strides
    round differently.
    """

    mid_frames: Tensor  # [N] float64, source frames

    @abstractmethod
    def state(self, frame: int, offsets: Tensor) -> BodyState:
        """States [D] of frame index ``frame`` at ``offsets`` [D] source frames from its mid time."""

    @abstractmethod
    def at(self, times: Tensor) -> BodyState:
        """States at absolute ``times`` [...] in source frames, each by the trajectory of the nearest frame."""

    @abstractmethod
    def penalty(self, kind: Continuity) -> Tensor:
        """How far the trajectories of consecutive frames are from joining up (paper, eq. reg); a scalar."""

    def nearest(self, times: Tensor) -> Tensor:
        """Index of the frame whose mid time is nearest to each of ``times`` [...]; of two equally near, the later."""
        borders = (self.mid_frames[1:] + self.mid_frames[:-1]) / 2
        return torch.bucketize(times.detach().to(borders.dtype), borders, right=True)


def split(values: Tensor) -> BodyState:
    """A state from its stacked channels [..., 25, 3]."""
    rotations = torch.nn.functional.pad(values[..., 1:JOINTS, :], (0, 0, 1, 0))
    return BodyState(rotations, values[..., 0, :], values[..., JOINTS, :])


def unwrap(rotvecs: Array) -> Array:
    """The same rotations [N, ..., 3], each vector moved by a multiple of 2 pi along its axis, nearest to the last one.

    A zero rotation has no axis of its own and takes its predecessor's.
    """
    result = np.array(rotvecs, dtype=np.float64)
    for n in range(1, len(result)):
        previous, current = result[n - 1], result[n]
        angle = np.linalg.norm(current, axis=-1, keepdims=True)
        before = np.linalg.norm(previous, axis=-1, keepdims=True)
        own = angle > 1e-8
        axis = np.where(own, current, previous) / np.maximum(np.where(own, angle, before), 1e-8)
        turns = np.round(((axis * previous).sum(-1, keepdims=True) - angle) / (2 * np.pi))
        result[n] = current + 2 * np.pi * turns * axis
    return result
