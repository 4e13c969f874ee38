"""A motion that is given and not learned: the truth, for the oracle."""

from __future__ import annotations

import torch
from torch import Tensor

from rsavatar.motion.base import AbstractMotion, Array, BodyState, Continuity, split


class KnownMotion(AbstractMotion):
    """States at given instants, interpolated linearly in axis-angle components and translation.

    The instants of all frames form one ascending table, so a camera whose trigger lies off centre reads on into the
    neighbouring frame. Before the first instant and after the last, the nearest pair is extrapolated.
    """

    times: Tensor
    values: Tensor

    def __init__(self, times: Array, stacked: Tensor, mid_frames: Array) -> None:
        """``times`` [I] ascending source frames; ``stacked`` [I, 25, 3] unwrapped channels (``motion.base``)."""
        super().__init__()
        self.register_buffer("times", torch.as_tensor(times, dtype=torch.float64), persistent=False)
        self.register_buffer("values", stacked.float(), persistent=False)
        self.register_buffer("mid_frames", torch.as_tensor(mid_frames, dtype=torch.float64), persistent=False)

    def state(self, frame: int, offsets: Tensor) -> BodyState:
        """States [D] at ``offsets`` [D] source frames from the mid time of ``frame``."""
        return self.at(self.mid_frames[frame] + offsets)

    def at(self, times: Tensor) -> BodyState:
        """States at absolute ``times`` [...], source frames."""
        high = torch.searchsorted(self.times, times.detach().contiguous()).clamp(1, len(self.times) - 1)
        low = high - 1
        share = ((times - self.times[low]) / (self.times[high] - self.times[low])).to(self.values)
        return split(torch.lerp(self.values[low], self.values[high], share[..., None, None]))

    def penalty(self, kind: Continuity) -> Tensor:
        """0: there is nothing to move."""
        return self.values.new_zeros(())
