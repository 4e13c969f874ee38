"""One pose per frame: what a method that knows no sub-frame motion can learn."""

from __future__ import annotations

import torch
from torch import Tensor

from rsavatar.motion.base import AbstractMotion, BodyState, Continuity, InitialMotion, split


class StillPose(AbstractMotion):
    """A learnable pose per frame, the same at every instant of the frame; it has no ends that could join up."""

    def __init__(self, initial: InitialMotion) -> None:
        super().__init__()
        self.poses = torch.nn.Parameter(initial.stacked().float())  # [N, 25, 3]
        self.register_buffer("mid_frames", torch.as_tensor(initial.mid_frames, dtype=torch.float64), persistent=False)

    def state(self, frame: int, offsets: Tensor) -> BodyState:
        """Frame ``frame``'s pose, once per offset."""
        return split(self.poses[frame].expand(len(offsets), -1, -1))

    def at(self, times: Tensor) -> BodyState:
        """The pose of the frame nearest to each of ``times``."""
        return split(self.poses[self.nearest(times)])

    def penalty(self, kind: Continuity) -> Tensor:
        """0."""
        return self.poses.new_zeros(())
