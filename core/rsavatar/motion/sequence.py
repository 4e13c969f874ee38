"""One spline over the whole sequence: continuity by construction, where per-frame splines need a penalty."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rsavatar.motion.base import AbstractMotion, BodyState, Continuity, InitialMotion, split
from rsavatar.motion.spline import basis_matrix

SMOOTHING = 1e-2  # weight of the second differences that decide control points which no frame does
ORDER = 4  # cubic: twice continuously differentiable


class SequenceSpline(AbstractMotion):
    """A uniform cubic B-spline in axis-angle components and translation, C2 over all frames.

    ``control`` [Q, 25, 3] float32 holds Rh in channel 0, joints 1..23, and Th in channel 24. Knots lie
    ``period / knots_per_frame`` source frames apart and reach one period beyond the first and the last mid time.
    It starts as the least-squares spline through the per-frame fit.
    """

    basis: Tensor  # [4, 4] float64

    def __init__(self, initial: InitialMotion, knots_per_frame: int = 1) -> None:
        super().__init__()
        self.spacing = initial.period_frames / knots_per_frame
        self.start = float(initial.mid_frames[0]) - initial.period_frames
        intervals = int(np.ceil((float(initial.mid_frames[-1]) + initial.period_frames - self.start) / self.spacing))
        self.register_buffer("basis", basis_matrix(ORDER), persistent=False)
        self.register_buffer("mid_frames", torch.as_tensor(initial.mid_frames, dtype=torch.float64), persistent=False)
        self.control = torch.nn.Parameter(self._through(initial.stacked(), intervals + ORDER - 1).float())

    def state(self, frame: int, offsets: Tensor) -> BodyState:
        """States [D] at ``offsets`` [D] source frames from the mid time of ``frame``."""
        return self.at(self.mid_frames[frame] + offsets)

    def at(self, times: Tensor) -> BodyState:
        """States at absolute ``times`` [...], source frames; beyond the last knots the outermost cubics go on."""
        first, weights = self._support(times, len(self.control))
        near = self.control[first[..., None] + torch.arange(ORDER)]
        return split(torch.einsum("...p,...pjc->...jc", weights.to(near), near))

    def penalty(self, kind: Continuity) -> Tensor:
        """0: the trajectory of one frame is that of the next."""
        return self.control.new_zeros(())

    def _support(self, times: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """First of the four control points at ``times`` [...], and their weights [..., 4] (paper, eq. spline)."""
        place = (times.double() - self.start) / self.spacing
        first = place.detach().floor().nan_to_num(0.0).clamp(0, count - ORDER)  # a NaN stays one in the weights
        powers = (place - first)[..., None] ** torch.arange(ORDER)
        return first.long(), powers @ self.basis

    def _through(self, values: Tensor, count: int) -> Tensor:
        """Control points [Q, 25, 3] of the smooth spline nearest to ``values`` [N, 25, 3] at the mid times."""
        first, weights = self._support(self.mid_frames, count)
        design = torch.zeros(len(values), count, dtype=torch.float64)
        design.scatter_(1, first[:, None] + torch.arange(ORDER), weights)
        slope = torch.diff(torch.eye(count, dtype=torch.float64), dim=0)
        bend = torch.diff(slope, dim=0)
        normal = design.T @ design + SMOOTHING * bend.T @ bend + 1e-9 * slope.T @ slope  # the last: one frame
        flat: Tensor = torch.linalg.solve(normal, design.T @ values.flatten(1))
        return flat.reshape(count, *values.shape[1:]).contiguous()  # solve's answer is column-major
